"""Which candidates are believed: both cameras agree, or nothing contradicts and the neighbours agree."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numba import njit
from numpy.typing import NDArray

Values = NDArray[np.float64]
WIDTH_LOG = 0.45
"""Largest |log| of a lone candidate's width over the usual width."""
CONTINUITY_MM = 0.8
"""Heights of one surface differ by less from row to row."""


@njit(cache=True, nogil=True)
def _run_length(z: Values, kept: NDArray[np.bool_], limit: float) -> NDArray[np.int64]:
    """Length of the continuous run that each kept candidate belongs to, at most one candidate a row."""
    rows = z.shape[0]
    height = np.full(rows, np.nan)
    for row in range(rows):
        for k in range(z.shape[1]):
            if kept[row, k]:
                height[row] = z[row, k]
    length = np.zeros(rows, np.int64)
    start = 0
    for row in range(rows + 1):
        if row in (rows, start) or not abs(height[row] - height[row - 1]) < limit:
            for i in range(start, min(row, rows)):
                length[i] = row - start if np.isfinite(height[i]) else 0
            if row > start:
                start = row
    return length


def _strongest(amplitude: Values, allowed: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Keep at most one candidate a row: the allowed one of largest amplitude."""
    score = np.where(allowed, amplitude, -np.inf)
    best = np.argmax(score, axis=1)
    out = np.zeros_like(allowed)
    rows = np.nonzero(allowed.any(axis=1))[0]
    out[rows, best[rows]] = True
    return out


def _near(flags: NDArray[np.bool_], rows: Values) -> NDArray[np.bool_]:
    """Whether a flag (rows,) stands on the image row nearest to each value, (rows, k); nan gives False."""
    index = np.clip(np.nan_to_num(np.rint(rows), nan=0.0).astype(np.int64), 0, len(flags) - 1)
    return np.where(np.isfinite(rows), flags[index], False)


def choose(
    z_mm: Sequence[Values],
    amplitude: Sequence[Values],
    width_px: Sequence[Values],
    partner: Sequence[NDArray[np.int64]],
    rows_in_other: Sequence[Values],
    run_rows: int,
) -> tuple[NDArray[np.bool_], NDArray[np.bool_]]:
    """Choose at most one candidate a row in each camera.

    Parameters
    ----------
    z_mm : two of (rows, k)
        Heights of the active points, left and right; nan where a gate closed.
    amplitude : two of (rows, k)
        Stripe amplitudes.
    width_px : two of (rows, k)
        Stripe widths; alone, a candidate must be about as wide as those that both cameras agree on.
    partner : two of (rows, k) int
        Matched candidate in the other camera, -1 where there is none.
    rows_in_other : two of (rows, k)
        Row of the other image at which the point would appear; nan outside that image.
    run_rows : int
        Rows that must agree where the other camera gives no support.

    Returns
    -------
    two of (rows, k) bool
        The believed candidates.

    Notes
    -----
    Laser ray and image row of a point nearly coincide in the laser plane, so a row holds one lit point: where both
    cameras agree on a point of that row, every other candidate of the row, in either camera, is a reflection.
    """
    agreed = [_strongest(amplitude[i], np.isfinite(z_mm[i]) & (partner[i] >= 0)) for i in (0, 1)]
    rows_agreed = [np.asarray(a.any(axis=1), dtype=np.bool_) for a in agreed]
    alone: list[NDArray[np.bool_]] = []
    for i in (0, 1):
        usual_px = float(np.median(width_px[i][agreed[i]])) if agreed[i].any() else np.nan
        odd = np.abs(np.log(width_px[i] / usual_px)) > WIDTH_LOG  # nothing is odd while no width is known
        free = np.isfinite(z_mm[i]) & ~odd & ~rows_agreed[i][:, None] & ~_near(rows_agreed[1 - i], rows_in_other[i])
        alone.append(_strongest(amplitude[i], free))
    kept: list[NDArray[np.bool_]] = []
    for i in (0, 1):
        # The other camera's lone candidate on the same row tells another height: the clearly stronger one stays.
        index = np.clip(np.nan_to_num(np.rint(rows_in_other[i]), nan=0.0).astype(np.int64), 0, len(alone[1 - i]) - 1)
        rival = np.where(alone[1 - i], amplitude[1 - i], 0.0).max(axis=1)  # (rows,)
        beaten = np.isfinite(rows_in_other[i]) & (amplitude[i] < 2.0 * rival[index])
        both = agreed[i] | (alone[i] & ~beaten)
        length = _run_length(z_mm[i], both, CONTINUITY_MM)
        kept.append(agreed[i] | (both & (length >= run_rows)[:, None]))
    return kept[0], kept[1]
