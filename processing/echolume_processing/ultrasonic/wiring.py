"""What is wired or counted the wrong way round, told from paths over the plate before anything is fitted."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Points3, require_shape

NEAR_MM = 3.0
"""Receivers that seem this near to their places sit there."""
MIN_SPREAD = 0.05
"""Root mean square of the paths' slopes that tells places: tilts of 3 degrees."""
UPRIGHT_SCALE = 0.1
"""How far off the robot's heights may be before their axis is called wrong."""
TRIM = 3

TURNS = {
    ((1, 0), (0, -1)): "the robot's rx runs the other way round (or the array is built on mirrored)",
    ((-1, 0), (0, 1)): "the robot's ry runs the other way round (or the array is built on mirrored)",
    ((-1, 0), (0, -1)): "rx and ry run the other way round, or the array is mounted turned by 180 degrees",
    ((0, -1), (1, 0)): "the array is mounted turned by 90 degrees about its axis",
    ((0, 1), (-1, 0)): "the array is mounted turned by -90 degrees about its axis",
    ((0, 1), (1, 0)): "rx and ry are exchanged",
    ((0, -1), (-1, 0)): "rx and ry are exchanged, and both run the other way round",
}


def apparent_places(paths_mm: NDArray[np.float64], slopes: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Where each channel's receiver seems to sit in the array's plane, less the channels' mean place.

    Parameters
    ----------
    paths_mm : (pings, receivers) float64
        Each channel's unknown delay included; not a number where there is none.
    slopes : (pings, 2) float64
        How a path grows with its receiver's x and y: the plate's upward normal in the array frame.

    Returns
    -------
    (receivers, 2) float64, mm; None where the tilts do not tell.
    """
    require_shape("slopes", slopes, (len(paths_mm), 2))
    centred = slopes - slopes.mean(axis=0)
    if np.linalg.eigvalsh(centred.T @ centred / len(slopes))[0] < MIN_SPREAD**2:
        return None
    whole = np.isfinite(paths_mm).all(axis=1)
    if np.count_nonzero(whole) < 5:
        return None
    apart = paths_mm[whole] - paths_mm[whole].mean(axis=1, keepdims=True)
    columns = np.column_stack([slopes[whole], np.ones(int(whole.sum()))])
    weights = np.ones(len(columns))
    found = np.zeros((3, paths_mm.shape[1]))
    for _ in range(TRIM):
        found = np.linalg.lstsq(columns * weights[:, None], apart * weights[:, None], rcond=None)[0]
        left = np.linalg.norm(apart - columns @ found, axis=1)
        weights = 1 / np.maximum(left, 0.5 * float(np.median(left)) + 1e-6)
    return found[:2].T


def require_wiring(paths_mm: NDArray[np.float64], slopes: NDArray[np.float64], receivers_mm: Points3) -> None:
    """Refuse an array whose channels are crossed, or that tilts the other way than the robot says.

    Raises
    ------
    CalibrationRejectedError
        Naming the receivers that are crossed, or the axis.

    Notes
    -----
    Over a plate, a tilt shortens the paths on one side. Each channel thus tells where its receiver sits, to about a
    tenth of a millimetre. Places that fit the drawing mirrored or turned speak for an axis, places that are exchanged
    for crossed wires. Plans without tilts about both axes tell nothing, and pass.
    """
    seen = apparent_places(paths_mm, slopes)
    if seen is None:
        return
    drawn = receivers_mm[:, :2] - receivers_mm[:, :2].mean(axis=0)

    def rms(expected: NDArray[np.float64]) -> float:
        return float(np.sqrt(np.mean(np.sum((seen - expected) ** 2, axis=1))))

    if rms(drawn) < NEAR_MM:
        return
    for turn, words in TURNS.items():
        if rms(drawn @ np.array(turn, dtype=np.float64).T) < NEAR_MM:
            raise CalibrationRejectedError(
                f"array calibration: over the tilted plate the paths change as if {words}; correct the rig file or the "
                "robot's direction, and calibrate again"
            )
    cost = np.linalg.norm(seen[:, None] - drawn[None], axis=2)
    _, place = linear_sum_assignment(cost)
    moved = np.flatnonzero(place != np.arange(len(place)))
    if moved.size and rms(drawn[place]) < NEAR_MM:
        where = "; ".join(f"channel {k} hears at receiver {int(place[k])}'s place" for k in moved.tolist())
        raise CalibrationRejectedError(f"array calibration: receivers {moved.tolist()} are wired crosswise: {where}")


def require_heights(paths_mm: NDArray[np.float64], heights_mm: NDArray[np.float64]) -> None:
    """Refuse a robot whose height does not go with the echo's path over the plate.

    Parameters
    ----------
    paths_mm : (pings,) float64
        Of upright pings: their mean over the channels; not a number where there is none.
    heights_mm : (pings,) float64
        What the robot says.

    Raises
    ------
    CalibrationRejectedError
        If the path does not grow by 2 mm with each mm of height.
    """
    known = np.isfinite(paths_mm)
    if np.count_nonzero(known) < 3 or np.ptp(heights_mm[known]) < 20:
        return
    first, second = np.triu_indices(int(known.sum()), 1)
    rise, grown = (v[known][second] - v[known][first] for v in (heights_mm, paths_mm))
    apart = np.abs(rise) > 5
    growth = float(np.median(grown[apart] / rise[apart]))
    if abs(growth - 2) > 2 * UPRIGHT_SCALE:
        reason = "its z axis runs the other way" if growth < -1 else "its z axis is off, or the bench is not bare"
        raise CalibrationRejectedError(
            f"array calibration: over the plate the echo's path grows by {growth:.2f} mm for each mm that the robot "
            f"says it rises, 2 are expected: {reason}"
        )
