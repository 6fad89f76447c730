"""Which candidate of each row is the stripe, from one camera alone: the line that leads through the rows."""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_processing.optical.stripe import Stripe

STEP_PX = 1.5
"""Change of column from row to row that costs one unit."""
JUMP = 4.0
"""Largest cost between rows: a step in depth is one jump, clutter of a few rows is two."""
STRANGE = 2.0
"""Cost of a candidate whose width is twice the usual one, or half of it."""
WEAK = 1.0
"""Cost of a candidate whose response is ever smaller than the row's best."""


@njit(cache=True, nogil=True)
def _best_path(columns: NDArray[Any], costs: NDArray[Any]) -> NDArray[np.int64]:
    """Viterbi's path: the candidate of each row, -1 where a row has none."""
    rows, candidates = columns.shape
    total = np.zeros((rows, candidates))
    came = np.full((rows, candidates), -1, np.int64)
    choice = np.full(rows, -1, np.int64)
    before = -1
    for y in range(rows):
        any_seen = False
        for k in range(candidates):
            if np.isnan(columns[y, k]):
                continue
            any_seen = True
            best = 0.0
            if before >= 0:
                best = np.inf
                allowed = STEP_PX * (y - before)
                for j in range(candidates):
                    if np.isnan(columns[before, j]):
                        continue
                    cost = total[before, j] + min(abs(columns[y, k] - columns[before, j]) / allowed, JUMP)
                    if cost < best:
                        best = cost
                        came[y, k] = j
            total[y, k] = best + costs[y, k]
        if any_seen:
            before = y
    at = -1
    for y in range(rows - 1, -1, -1):
        if at < 0:
            least = np.inf
            for k in range(candidates):
                if not np.isnan(columns[y, k]) and total[y, k] < least:
                    least = total[y, k]
                    at = k
            if at < 0:
                continue
        elif np.isnan(columns[y]).all():
            continue
        choice[y] = at
        at = came[y, at]
        if at < 0:
            break
    return choice


def trace(found: Stripe) -> NDArray[np.int64]:
    """Choose the stripe's candidate in each row.

    Parameters
    ----------
    found : Stripe
        Several candidates a row.

    Returns
    -------
    (rows,) int64
        Index of the candidate, -1 where the row has none.

    Notes
    -----
    The path through all rows costs what its columns jump, what its widths differ from the usual one and what its
    amplitudes fall short of the row's largest. A secondary stripe longer and smoother than the true one wins: only
    the laser plane and the other camera tell those apart.

    References
    ----------
    A. J. Viterbi, doi:10.1109/TIT.1967.1054010.
    """
    width, amplitude = found.width_px, found.amplitude_dn
    seen = np.isfinite(found.column_px)
    if not seen.any():
        return np.full(len(found.column_px), -1, dtype=np.int64)
    usual_px = float(np.median(width[:, 0][seen[:, 0]])) if seen[:, 0].any() else float(np.nanmedian(width))
    strange = STRANGE * np.abs(np.log2(np.where(seen, width, usual_px) / usual_px))
    height = np.where(seen, amplitude, 0.0)
    weak = WEAK * (1 - height / np.maximum(height.max(axis=1, keepdims=True), 1e-9))
    return _best_path(found.column_px, np.minimum(strange, JUMP) + weak)
