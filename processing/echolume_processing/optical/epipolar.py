"""The compiled epipolar walk from one camera's stripe to the other one's."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_processing.optical.candidates import Candidates

Matrix = NDArray[np.float64]
Values = NDArray[np.float64]
Indices = NDArray[np.int64]

MAX_STEP_PX = 2.5
"""Neighbouring rows of one stripe differ by less."""
REACH_ROWS = 3
"""Rows searched on both sides of the predicted one."""


class Match(NamedTuple):
    """What the other camera says to each of n candidates."""

    partner: Indices
    """Matched candidate of the other camera, -1 where there is none; (n,)."""
    points_px: Values
    """The other camera's undistorted point on the epipolar line, between two rows of its stripe; (2, n)."""
    off_px: Values
    """Distance of that point from the column that the laser plane predicts, (n,)."""
    gain: Values
    """Variance of that point along the line, over the variance of the partner's column; (n,)."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _usual(
    points: Values, expected: Values, start: Indices, other: Values, f: Matrix, tolerance_px: float, found: Values
) -> None:
    """Try the strongest candidates of the predicted row and of the next: nearly always they are it.

    Fills `found` (5, n): partner, point u, v, distance from the prediction, gain. The loop has neither branches nor
    more than one result, so that the compiler takes several candidates at once.
    """
    last_row, last = len(start) - 3, other.shape[1] - 1
    f00, f01, f02, f10, f11, f12 = f[0, 0], f[0, 1], f[0, 2], f[1, 0], f[1, 1], f[1, 2]
    f20, f21, f22 = f[2, 0], f[2, 1], f[2, 2]
    for n in range(points.shape[1]):
        column, row = expected[0, n], expected[1, n]
        inside = (row >= 0.0) & (row < last_row + 1.0)
        at = np.int64(row if inside else 0.0)
        # Unsigned: an index that may be negative would be tested.
        first, second, third = start[np.uint64(at)], start[np.uint64(at + 1)], start[np.uint64(at + 2)]
        i, j = min(first, last), min(second, last)
        u, v = points[0, n], points[1, n]
        a, b, c = f00 * u + f01 * v + f02, f10 * u + f11 * v + f12, f20 * u + f21 * v + f22
        ua, va = other[0, np.uint64(i)], other[1, np.uint64(i)]
        ub, vb = other[0, np.uint64(j)], other[1, np.uint64(j)]
        ea, eb = a * ua + b * va + c, a * ub + b * vb + c
        scale = 1.0 / (ea - eb)
        part = ea * scale
        mu = ua + part * (ub - ua)
        slant = 1.0 + a * (ub - ua) * scale
        good = inside & (first < second) & (second < third) & (ea * eb <= 0.0)
        good &= (abs(ub - ua) < MAX_STEP_PX) & (abs(mu - column) < tolerance_px)
        found[0, n] = (float(i) if part < 0.5 else float(j)) if good else -1.0
        found[1, n] = mu if good else np.nan
        found[2, n] = va + part * (vb - va) if good else np.nan
        found[3, n] = mu - column if good else np.nan
        found[4, n] = slant * slant * (1.0 - 2.0 * part * (1.0 - part)) if good else np.nan


@njit(cache=True, nogil=True, error_model="numpy")
def _others(
    points: Values, expected: Values, start: Indices, other: Values, f: Matrix, tolerance_px: float,
    partner: Indices, match: Values, off: Values, gain: Values,
) -> None:  # fmt: skip
    """Try all candidates of the rows around the predicted one, for those that have no partner yet."""
    height = len(start) - 1
    for n in range(points.shape[1]):
        column, row = expected[0, n], expected[1, n]
        if partner[n] >= 0 or not -REACH_ROWS < row < height + REACH_ROWS:
            continue
        u, v = points[0, n], points[1, n]
        a = f[0, 0] * u + f[0, 1] * v + f[0, 2]
        b = f[1, 0] * u + f[1, 1] * v + f[1, 2]
        c = f[2, 0] * u + f[2, 1] * v + f[2, 2]
        best = tolerance_px
        for step in range(2 * REACH_ROWS + 1):
            # 0, 1, -1, 2, -2, ...
            at = int(np.floor(row)) + ((step + 1) // 2 if step % 2 else -(step // 2))
            if at < 0 or at + 1 >= height:
                continue
            for i in range(start[at], start[at + 1]):
                ua, va = other[0, i], other[1, i]
                if not abs(ua - column) < tolerance_px + MAX_STEP_PX:
                    continue
                ea = a * ua + b * va + c
                for j in range(start[at + 1], start[at + 2]):
                    ub, vb = other[0, j], other[1, j]
                    eb = a * ub + b * vb + c
                    if not (abs(ub - ua) < MAX_STEP_PX and ea * eb <= 0.0):
                        continue
                    scale = 1.0 / (ea - eb)
                    part = ea * scale
                    mu = ua + part * (ub - ua)
                    if abs(mu - column) < best:
                        best = abs(mu - column)
                        slant = 1.0 + a * (ub - ua) * scale
                        match[0, n], match[1, n], off[n] = mu, va + part * (vb - va), mu - column
                        gain[n] = slant * slant * (1.0 - 2.0 * part * (1.0 - part))
                        partner[n] = i if part < 0.5 else j
            if partner[n] >= 0:
                break


@njit(cache=True, nogil=True)
def walk(side: Candidates, other: Candidates, f: Matrix, tolerance_px: float) -> Match:
    """See `correspond.walk`."""
    n = len(side.row)
    partner, found = np.empty(n, np.int64), np.empty((5, n))
    if len(other.row) == 0 or len(other.start) < 3:
        partner[:] = -1
        found[:] = np.nan
        return Match(partner, found[1:3], found[3], found[4])
    _usual(side.points_px, side.expected_px, other.start, other.points_px, f, tolerance_px, found)
    for i in range(n):
        partner[i] = np.int64(found[0, i])
    match, off, gain = found[1:3], found[3], found[4]
    _others(side.points_px, side.expected_px, other.start, other.points_px, f, tolerance_px, partner, match, off, gain)
    return Match(partner, match, off, gain)
