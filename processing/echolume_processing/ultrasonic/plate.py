"""The array's delays, receivers, pose and speed of sound from pings at many poses over the reference plate (z = 0).

All unknowns are fitted at once to all paths (`plate_problem`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import cast

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, Points3, require_shape
from echolume_processing.ultrasonic.leave_out import left_out
from echolume_processing.ultrasonic.observability import MISSING_POSES, loose_directions, poses_to_add
from echolume_processing.ultrasonic.plate_model import Levels, plate_paths
from echolume_processing.ultrasonic.plate_problem import (
    FIXED,
    NAMES,
    PLACEMENT_SIGMA_MM,
    POSE,
    RADIUS,
    RADIUS_SIGMA,
    SPEED,
    PlateData,
    PlateProblem,
)
from echolume_processing.ultrasonic.suspicion import Suspicion, strongest_suspicion

__all__ = ["Levels", "PlateFit", "fit_plate", "plate_paths"]

SLIP_MM = 1.0
"""A path this far from its ping's others has slipped a cycle and is left out."""
SLIP_ROUNDS = 4
DETERMINED = 0.5
"""A parameter whose sigma the data did not bring below this share of its mounting sigma is undetermined."""
LIMITS = {
    "flange_from_array x": 0.3,
    "flange_from_array y": 0.3,
    "flange_from_array rx": float(np.radians(0.3)),
    "flange_from_array ry": float(np.radians(0.3)),
    "flange_from_array yaw": float(np.radians(0.3)),
    "rig_from_robot rx": float(np.radians(0.1)),
    "rig_from_robot ry": float(np.radians(0.1)),
    "speed of sound": 0.5,
}
"""mm, rad and m/s: what a scan can do with. A parameter with a larger sigma is undetermined, too. The heights are not
among them: they trade against each other and the channels' common delay, and only their sum enters a measurement."""
MAX_SUSPICION_MM = 0.15
SURE = 0.25
"""A cause that explains this share of all chi-squared is believed; a few slipped paths are nobody's fault."""
MAX_RMS_MM = 0.2
MAX_SLIPS = 0.2
"""Share of the paths."""


@dataclass(frozen=True)
class PlateFit:
    """Result of the fit over the plate."""

    flange_from_array: Matrix
    rig_from_robot: Matrix
    speed_mps: float
    """At `temperature_c`."""
    temperature_c: float
    delays_s: NDArray[np.float64]
    delay_covariance_s2: NDArray[np.float64]
    """(receivers, receivers)."""
    receivers_mm: Points3
    receivers_sigma_mm: Points3
    """Of the places among each other: the array frame is the one in which they share neither shift nor turn."""
    receivers_undetermined: tuple[str, ...]
    """Axes along which the pings hardly tell where the receivers sit: there they stay nominal, with that sigma."""
    radius_mm: float
    """Effective radius of the transducers, from how the echo weakens with tilt."""
    radius_sigma_mm: float
    path_rms_mm: float
    level_rms: float
    """Of the logarithm of the amplitude."""
    sigmas: dict[str, float]
    """Standard deviation by name: mm, rad, and m/s."""
    pose_covariance: NDArray[np.float64]
    """(9, 9) of the first nine `plate_problem.NAMES`, mm and rad."""
    residuals_mm: NDArray[np.float64]
    """Measured minus modelled path, (pings, receivers)."""
    undetermined: tuple[str, ...]
    """Directions of the unknowns that stay as uncertain as the mounting, in words."""
    suspicion: Suspicion | None
    """A small unevenness of the bench or shift of the robot that the paths speak for, too small to refuse them."""
    left_out: NDArray[np.float64]
    """How well all others predict each ping: chi-squared per path, (pings,); 1 is as well as the sigmas say."""


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
        Nominal places. The emitter is where it is drawn: it defines the array frame.
    nominal_flange_from_array : (4, 4) float64
    direct_s : (receivers,) float64, optional
        Arrival of the direct sound emitter -> receiver; it tells the channels' common delay, which the plate alone
        hardly separates from the height. Not a number where unknown.
    levels : Levels, optional
        Amplitudes; they tell the array's tilt, which paths hardly separate from the channels' delays, and the radius.

    Raises
    ------
    CalibrationRejectedError
        If the poses leave a parameter undetermined; the message names it, and the poses that would determine it.

    Notes
    -----
    x, y and yaw of ``rig_from_robot`` do not enter: the plate looks the same everywhere. See `block.fit_block`.
    A receiver's place enters through the tilt: -n.r_i, n the plate's normal in the array frame. In the array's plane
    tilts of 18 degrees tell it to some 0.02 mm; across the plane it trades against the channel's delay.
    """
    n = len(receivers_mm)
    require_shape("poses", poses, (None, 6))
    require_shape("times_s", times_s, (len(poses), n))
    direct = np.full(n, np.nan) if direct_s is None else direct_s
    data = PlateData(poses, times_s, temperatures_c, direct, levels)
    whole = PlateProblem(data, emitter_mm, receivers_mm, nominal_flange_from_array)
    problem, found = _solved(whole)
    suspicion = strongest_suspicion(whole, found, _covariance(whole, found, 1.0))
    rms = float(np.sqrt(np.mean(problem.paths_left_mm(found)[problem.known] ** 2)))
    slips = 1 - np.count_nonzero(problem.known) / max(1, np.count_nonzero(whole.known))
    _require_consistent(suspicion, rms, slips)
    covariance = _covariance(problem, found, problem.scatter(found))
    spread = np.sqrt(np.diag(covariance))
    _require_determined(spread, problem.sigmas, len(poses))
    left = np.where(problem.known, problem.paths_left_mm(found), np.nan)
    flange, rig = problem.transforms(found)
    speed, radius = problem.speed_mps(found), problem.radius_mm(found)
    placed = problem.basis @ covariance[FIXED : problem.priors, FIXED : problem.priors] @ problem.basis.T
    receivers_sigma = np.sqrt(np.diag(placed)).reshape(-1, 3)
    loose = _loose_axes(receivers_sigma)
    nominal = np.array([axis in loose for axis in "xyz"])
    delays_s, delay_covariance = _delays(problem, found, covariance, nominal)
    level = problem.level_left(found)
    scale = problem.sigmas[:POSE]
    return PlateFit(
        flange_from_array=flange,
        rig_from_robot=rig,
        speed_mps=speed,
        temperature_c=problem.temperature_c,
        delays_s=delays_s,
        delay_covariance_s2=delay_covariance,
        receivers_mm=np.where(nominal, receivers_mm, problem.receivers_mm(found)),
        receivers_sigma_mm=receivers_sigma,
        receivers_undetermined=loose,
        radius_mm=radius,
        radius_sigma_mm=problem.radius_mm(np.zeros(problem.size)) * RADIUS_SIGMA * float(spread[RADIUS]),
        path_rms_mm=rms,
        level_rms=float(np.sqrt(np.mean(level**2))) if level.size else 0.0,
        sigmas=dict(zip(NAMES, (spread[:10] * problem.sigmas).tolist(), strict=True)),
        pose_covariance=covariance[:POSE, :POSE] * np.outer(scale, scale),
        residuals_mm=left,
        undetermined=_loose_directions(covariance),
        suspicion=suspicion,
        left_out=left_out(problem, found, covariance),
    )


def _solved(problem: PlateProblem) -> tuple[PlateProblem, NDArray[np.float64]]:
    """The problem less the paths that slipped, and its solution."""
    found = problem.start()
    for _ in range(SLIP_ROUNDS):
        solved = least_squares(
            problem.residuals,
            found,
            jac=cast("str", problem.jacobian),  # scipy's stubs know the names of its own ways only
            loss="soft_l1",
            f_scale=3.0,
            x_scale="jac",
            max_nfev=60,
        )
        found = np.asarray(solved.x, dtype=np.float64)
        left = problem.paths_left_mm(found)
        middle = _row_medians(left, problem.known)
        slipped = problem.known & ((np.abs(left - middle) > SLIP_MM) | (np.abs(left) > 2 * SLIP_MM))
        if not slipped.any():
            break
        if not (problem.known & ~slipped).any(axis=0).all():
            raise CalibrationRejectedError(
                f"array calibration: paths over the plate contradict each other by {float(np.abs(left).max()):.1f} mm; "
                "is the bench bare and flat, and the nominal mounting of the array right?"
            )
        problem = problem.without(slipped)
    return problem, found


def _covariance(problem: PlateProblem, found: NDArray[np.float64], worse: float) -> NDArray[np.float64]:
    """Covariance of the unknowns in the problem's units, where the paths scatter `worse` times their sigma."""
    measured = problem.jacobian(found)[: -problem.priors] / worse
    prior = np.zeros(problem.size)
    prior[: problem.priors] = 1.0
    return np.asarray(np.linalg.inv(measured.T @ measured + np.diag(prior)), dtype=np.float64)


def _row_medians(values: NDArray[np.float64], known: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Median of what is known in each row, 0 where nothing is, (rows, 1)."""
    return np.array([[float(np.median(row[k])) if k.any() else 0.0] for row, k in zip(values, known, strict=True)])


def _require_consistent(suspicion: Suspicion | None, rms_mm: float, slips: float) -> None:
    """Refuse paths that contradict each other, with the likeliest cause."""
    bad = rms_mm > MAX_RMS_MM or slips > MAX_SLIPS
    sure = suspicion is not None and suspicion.share > SURE and suspicion.amount_mm > MAX_SUSPICION_MM
    if not bad and not sure:
        return
    scatter = f"they scatter by {rms_mm:.2f} mm rms, {slips:.0%} of them slipped"
    cause = f"as if {suspicion.words}" if suspicion is not None else "without one cause for all"
    raise CalibrationRejectedError(
        f"array calibration: paths over the plate contradict each other, {cause}; {scatter}; is the bench bare and "
        "flat, and the rig untouched since the first ping? Repeat all passes"
    )


def _require_determined(spread: NDArray[np.float64], sigmas: NDArray[np.float64], pings: int) -> None:
    loose = [
        name
        for name, share, sigma in zip(NAMES, spread[:10].tolist(), (spread[:10] * sigmas).tolist(), strict=True)
        if name in LIMITS and (share > DETERMINED or sigma > LIMITS[name])
    ]
    if loose:
        raise CalibrationRejectedError(
            f"array calibration: {pings} pings over the plate leave undetermined: {', '.join(loose)}; "
            f"add poses: {'; '.join(poses_to_add(loose)) or MISSING_POSES}"
        )


def _loose_directions(covariance: NDArray[np.float64]) -> tuple[str, ...]:
    number = len(NAMES)
    information = np.asarray(np.linalg.inv(covariance[:number, :number]), dtype=np.float64)
    return tuple(words for _, words in loose_directions(information, NAMES, DETERMINED**-2))


def _loose_axes(receivers_sigma_mm: Points3) -> tuple[str, ...]:
    """Axes along which the receivers' places are hardly better known than from the drawing."""
    share = np.sqrt(np.mean(receivers_sigma_mm**2, axis=0)) / np.array(PLACEMENT_SIGMA_MM)
    return tuple(axis for axis, s in zip("xyz", share.tolist(), strict=True) if s > DETERMINED)


def _delays(
    problem: PlateProblem, found: NDArray[np.float64], covariance: NDArray[np.float64], nominal: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Delays in s and their covariance, with what the receivers' places add along the axes that stay nominal."""
    n, speed = problem.receivers, 1e3 * problem.speed_mps(found)
    slopes = np.zeros((n, problem.size))
    slopes[:, problem.priors : -1] = np.eye(n)
    ways = problem.basis.reshape(n, 3, -1) * nominal[:, None]
    slopes[:, FIXED : problem.priors] = np.einsum("ri,rik->rk", problem.delay_by_place(found), ways)
    delays_s = slopes @ found / speed
    slopes[:, SPEED] = -delays_s * 1e3 * problem.sigmas[SPEED]
    return delays_s, slopes @ covariance @ slopes.T / speed**2
