"""The array's delays, pose and speed of sound from pings at many poses over the reference plate (z = 0).

The plate mirrors the emitter: the path to receiver r_i is |r_i - E'|. All unknowns are fitted at once to all paths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, Points3, robot_from_flange, rotation_from_vector, transform
from echolume_processing.ultrasonic.acoustics import directivity
from echolume_processing.ultrasonic.air import ZERO_CELSIUS_K, speed_of_sound_mps

CHANNEL_SIGMA_MM = 0.02
"""What a channel's path scatters by itself."""
COMMON_SIGMA_MM = 0.05
"""What all paths of a ping share: the robot's repeatability and the air."""
MOUNTING_SIGMA_MM = 1.0
MOUNTING_SIGMA_RAD = float(np.radians(1.0))
"""How well the array and the robot are mounted by hand: the nominal values are believed this far."""
SPEED_SIGMA = 0.01
LEVEL_SIGMA = 0.015
"""Of the natural logarithm of a ping's amplitude, averaged over its channels: air, and scatter of the plate."""
RADIUS_SIGMA = 0.05
SLIP_MM = 1.0
"""A path this far from its ping's others has slipped a cycle and is left out."""
SLIP_ROUNDS = 4
DIRECT_SIGMA_MM = 0.5
"""How far the direct sound, which leaves the piston sideways, is believed to come from its centre."""

NAMES = (
    "flange_from_array x",
    "flange_from_array y",
    "flange_from_array z",
    "flange_from_array rx",
    "flange_from_array ry",
    "flange_from_array yaw",
    "rig_from_robot z",
    "rig_from_robot rx",
    "rig_from_robot ry",
    "speed of sound",
)
DETERMINED = 0.5
"""A parameter whose sigma the data did not bring below this share of its mounting sigma is undetermined."""
FREE = {"flange_from_array z", "rig_from_robot z"}
"""Heights trade against the channels' common delay; only their sum enters a measurement, and that is determined."""


@dataclass(frozen=True)
class PlateFit:
    """Result of the fit over the plate."""

    flange_from_array: Matrix
    rig_from_robot: Matrix
    speed_mps: float
    """At `temperature_c`."""
    temperature_c: float
    delays_s: NDArray[np.float64]
    radius_mm: float
    """Effective radius of the transducers, from how the echo weakens with tilt."""
    path_rms_mm: float
    level_rms: float
    """Of the logarithm of the amplitude."""
    sigmas: dict[str, float]
    """Standard deviation by name: mm, rad, and m/s."""
    residuals_mm: NDArray[np.float64]
    """Measured minus modelled path, (pings, receivers)."""


def _poses(offsets: NDArray[np.float64], nominal: Matrix) -> tuple[Matrix, Matrix]:
    flange = nominal @ transform(rotation_from_vector(offsets[3:6]), offsets[:3])
    robot = transform(
        rotation_from_vector(np.array([offsets[7], offsets[8], 0.0])), np.array([0.0, 0.0, float(offsets[6])])
    )
    return flange, robot


def plate_paths(rig_from_array: NDArray[np.float64], emitter_mm: NDArray[np.float64], receivers_mm: Points3) -> Points3:
    """Path lengths (pings, receivers) over the plate z = 0 at array poses (pings, 4, 4)."""
    emitter = rig_from_array[:, :3, :3] @ emitter_mm + rig_from_array[:, :3, 3]
    image = emitter * np.array([1.0, 1.0, -1.0])
    receivers = np.einsum("pij,rj->pri", rig_from_array[:, :3, :3], receivers_mm) + rig_from_array[:, None, :3, 3]
    return np.linalg.norm(receivers - image[:, None, :], axis=2)


@dataclass(frozen=True)
class Levels:
    """Amplitude of each ping relative to the reference plate, and over which frequencies it was taken."""

    amplitudes: NDArray[np.float64]  # (pings, receivers)
    frequency_hz: NDArray[np.float64]  # (m,)
    weights: NDArray[np.float64]  # (m,), their sum is 1
    radius_mm: float
    """Nominal."""


def plate_levels(
    rig_from_array: NDArray[np.float64],
    emitter_mm: NDArray[np.float64],
    receivers_mm: Points3,
    wavenumbers: NDArray[np.float64],
    weights: NDArray[np.float64],
    radius_mm: float,
) -> NDArray[np.float64]:
    """Directivity both ways over path, of the plate z = 0 at array poses (pings, 4, 4): (pings, receivers), 1/mm."""
    mirror = np.array([1.0, 1.0, -1.0])
    rotation = rig_from_array[:, :3, :3]
    emitter = rotation @ emitter_mm + rig_from_array[:, :3, 3]
    receivers = np.einsum("pij,rj->pri", rotation, receivers_mm) + rig_from_array[:, None, :3, 3]
    way = receivers - (emitter * mirror)[:, None, :]
    path = np.linalg.norm(way, axis=2)
    axis = rotation[:, :, 2]
    out = np.zeros(path.shape)
    cosines = [np.einsum("pri,pi->pr", w, axis) / path for w in (way, way * mirror)]
    sines = [np.sqrt(np.maximum(1 - c**2, 0.0)) for c in cosines]
    for wavenumber, weight in zip(wavenumbers.tolist(), weights.tolist(), strict=True):
        ka = wavenumber * radius_mm
        out += weight * directivity(ka * sines[0]) * directivity(ka * sines[1])
    return out / path


def _row_means(values: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the finite values of each row, not a number where there are none, (rows,)."""
    finite = np.isfinite(values)
    count = finite.sum(axis=1)
    return np.where(count > 0, np.where(finite, values, 0.0).sum(axis=1) / np.maximum(count, 1), np.nan)


def _row_medians(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Median of what is known in each row, 0 where nothing is, (rows, 1)."""
    return np.array([[float(np.median(row[k])) if k.any() else 0.0] for row, k in zip(values, known, strict=True)])


def _whitening(n: int) -> NDArray[np.float64]:
    covariance = CHANNEL_SIGMA_MM**2 * np.eye(n) + COMMON_SIGMA_MM**2 * np.ones((n, n))
    values, vectors = np.linalg.eigh(covariance)
    return (vectors / np.sqrt(values)) @ vectors.T


def fit_plate(
    poses: NDArray[np.float64],
    times_s: NDArray[np.float64],
    temperatures_c: NDArray[np.float64],
    emitter_mm: NDArray[np.float64],
    receivers_mm: Points3,
    nominal_flange_from_array: Matrix,
    direct_s: NDArray[np.float64] | None = None,
    levels: Levels | None = None,
) -> PlateFit:
    """Fit everything that pings over the reference plate can tell.

    Parameters
    ----------
    poses : (pings, 6) float64
        Robot axes, mm and rad.
    times_s : (pings, receivers) float64
        Arrival times after the emission, each channel's unknown delay included; not a number where there is none.
    temperatures_c : (pings,) float64
    emitter_mm, receivers_mm : (3,), (receivers, 3) float64
    nominal_flange_from_array : (4, 4) float64
    direct_s : (receivers,) float64, optional
        Arrival of the direct sound emitter -> receiver; it tells the channels' common delay, which the plate alone
        hardly separates from the height. Not a number where unknown.
    levels : Levels, optional
        Amplitudes; they tell the array's tilt, which paths hardly separate from the channels' delays, and the radius.

    Raises
    ------
    CalibrationRejectedError
        If the poses leave a parameter undetermined; the message names it.

    Notes
    -----
    x, y and yaw of ``rig_from_robot`` do not enter: the plate looks the same everywhere. See `block.fit_block`.
    """
    n_receivers = len(receivers_mm)
    temperature_c = float(np.mean(temperatures_c))
    scale = np.sqrt((temperatures_c + ZERO_CELSIUS_K) / (temperature_c + ZERO_CELSIUS_K))
    nominal_speed = speed_of_sound_mps(temperature_c)
    robot = np.array([robot_from_flange(p) for p in poses])
    known = np.isfinite(times_s)
    whiten = _whitening(n_receivers)
    sigmas = np.array(
        [MOUNTING_SIGMA_MM] * 3 + [MOUNTING_SIGMA_RAD] * 3 + [MOUNTING_SIGMA_MM] + [MOUNTING_SIGMA_RAD] * 2
    )
    sigmas = np.append(sigmas, SPEED_SIGMA * nominal_speed)

    def residuals_mm(p: NDArray[np.float64]) -> NDArray[np.float64]:
        flange, rig = _poses(p[:9] * sigmas[:9], nominal_flange_from_array)
        speed = (nominal_speed + p[9] * sigmas[9]) * scale[:, None] * 1e3
        paths = plate_paths(rig @ robot @ flange, emitter_mm, receivers_mm)
        delays_mm = p[11:]
        return np.where(known, np.nan_to_num(times_s) * speed - delays_mm - paths, 0.0)

    direct = np.full(n_receivers, np.nan) if direct_s is None else direct_s
    heard = np.isfinite(direct)
    apart_mm = np.linalg.norm(receivers_mm - emitter_mm, axis=1)

    def common_mm(p: NDArray[np.float64]) -> float:
        if not heard.any():
            return 0.0
        speed = (nominal_speed + p[9] * sigmas[9]) * 1e3
        return float(np.mean((direct * speed - apart_mm - p[11:])[heard]))

    heights = np.full(len(poses), np.nan) if levels is None else np.log(_row_means(levels.amplitudes))
    loud = np.isfinite(heights)

    def level_residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        if levels is None:
            return np.zeros(0)
        flange, rig = _poses(p[:9] * sigmas[:9], nominal_flange_from_array)
        model = plate_levels(
            (rig @ robot @ flange)[loud],
            emitter_mm,
            receivers_mm,
            2e-3 * np.pi * levels.frequency_hz / nominal_speed,
            levels.weights,
            levels.radius_mm * (1 + RADIUS_SIGMA * float(p[10])),
        )
        difference = heights[loud] - np.log(model.mean(axis=1))
        return difference - np.median(difference)

    def cost(p: NDArray[np.float64]) -> NDArray[np.float64]:
        paths = (residuals_mm(p) @ whiten).ravel()
        return np.concatenate([paths, level_residuals(p) / LEVEL_SIGMA, [common_mm(p) / DIRECT_SIGMA_MM], p[:11]])

    start = np.zeros(11 + n_receivers)
    start[11:] = np.nanmedian(np.where(known, residuals_mm(start), np.nan), axis=0)
    found, jacobian, left = start, np.zeros((0, len(start))), residuals_mm(start)
    for _ in range(SLIP_ROUNDS):
        solved = least_squares(cost, found, loss="soft_l1", f_scale=3.0, x_scale="jac", max_nfev=60)
        found = np.asarray(solved.x, dtype=np.float64)
        jacobian = np.asarray(solved.jac, dtype=np.float64)
        left = residuals_mm(found)
        middle = _row_medians(left, known)
        slipped = known & ((np.abs(left - middle) > SLIP_MM) | (np.abs(left) > 2 * SLIP_MM))
        if not slipped.any():
            break
        known &= ~slipped
        if not known.any(axis=0).all():
            raise CalibrationRejectedError(
                f"array calibration: paths over the plate contradict each other by {float(np.abs(left).max()):.1f} mm; "
                "is the bench bare and flat, and the nominal mounting of the array right?"
            )
    left = np.where(known, residuals_mm(found), np.nan)
    rms = float(np.sqrt(np.mean(left[known] ** 2)))
    expected = np.hypot(CHANNEL_SIGMA_MM, COMMON_SIGMA_MM)
    data = jacobian[:-11]
    information = data.T @ data / max(1.0, (rms / expected) ** 2)
    information[:11, :11] += np.eye(11)
    spread = np.sqrt(np.diag(np.linalg.inv(information)))[:10]
    loose = [n for n, s in zip(NAMES, spread, strict=True) if s > DETERMINED and n not in FREE]
    if loose:
        raise CalibrationRejectedError(
            f"array calibration: {len(poses)} pings over the plate leave undetermined: {', '.join(loose)}; "
            "add poses tilted by 5 to 12 degrees about both axes, at several heights and places"
        )
    flange, rig = _poses(found[:9] * sigmas[:9], nominal_flange_from_array)
    speed_mps = nominal_speed + float(found[9] * sigmas[9])
    return PlateFit(
        flange,
        rig,
        speed_mps,
        temperature_c,
        found[11:] / (1e3 * speed_mps),
        (levels.radius_mm if levels is not None else 0.0) * (1 + RADIUS_SIGMA * float(found[10])),
        rms,
        float(np.sqrt(np.mean(level_residuals(found) ** 2))) if levels is not None else 0.0,
        dict(zip(NAMES, (spread * sigmas).tolist(), strict=True)),
        left,
    )
