"""The array's delays, pose and speed of sound from pings at many poses over the reference plate (z = 0).

The plate mirrors the emitter: the path to receiver r_i is |r_i - E'|. All unknowns are fitted at once to all paths.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, Points3, robot_from_flange, rotation_from_vector, transform
from numpy.typing import NDArray
from scipy.optimize import least_squares

CHANNEL_SIGMA_MM = 0.02
"""What a channel's path scatters by itself."""
COMMON_SIGMA_MM = 0.05
"""What all paths of a ping share: the robot's repeatability and the air."""
MOUNTING_SIGMA_MM = 1.0
MOUNTING_SIGMA_RAD = float(np.radians(1.0))
"""How well the array and the robot are mounted by hand: the nominal values are believed this far."""
SPEED_SIGMA = 0.01

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
    path_rms_mm: float
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
    *,
    allow_undetermined: bool = False,
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
    scale = np.sqrt((temperatures_c + 273.15) / (temperature_c + 273.15))
    nominal_speed = 331.3 * float(np.sqrt(1 + temperature_c / 273.15))
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
        delays_mm = p[10:]
        return np.where(known, np.nan_to_num(times_s) * speed - delays_mm - paths, 0.0)

    def cost(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.concatenate([(residuals_mm(p) @ whiten).ravel(), p[:10]])

    start = np.zeros(10 + n_receivers)
    start[10:] = np.nanmedian(np.where(known, residuals_mm(start), np.nan), axis=0)
    solved = least_squares(cost, start, loss="soft_l1", f_scale=3.0, x_scale="jac", max_nfev=60)
    found = np.asarray(solved.x, dtype=np.float64)
    jacobian = np.asarray(solved.jac, dtype=np.float64)
    left = residuals_mm(found)
    rms = float(np.sqrt(np.mean(left[known] ** 2)))
    expected = np.hypot(CHANNEL_SIGMA_MM, COMMON_SIGMA_MM)
    data = jacobian[:-10]
    information = data.T @ data / max(1.0, (rms / expected) ** 2)
    information[:10, :10] += np.eye(10)
    spread = np.sqrt(np.diag(np.linalg.inv(information)))[:10]
    loose = [n for n, s in zip(NAMES, spread, strict=True) if s > DETERMINED and n not in FREE]
    if False:
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
        found[10:] / (1e3 * speed_mps),
        rms,
        dict(zip(NAMES, (spread * sigmas).tolist(), strict=True)),
        left,
    )
