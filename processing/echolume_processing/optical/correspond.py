"""Which stripe candidate of one camera is which of the other: the plane predicts, the epipolar line decides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix

Values = NDArray[np.float64]

TOLERANCE_PX = 2.5
"""How far the other camera's stripe may lie from where the laser plane predicts it."""
MAX_STEP_PX = 2.5
"""Neighbouring rows of one stripe differ by less."""
REACH_ROWS = 3
"""Rows searched on both sides of the predicted one."""


@dataclass(frozen=True)
class Side:
    """One camera's stripe: candidates (rows, k), their undistorted points and active points.

    Attributes
    ----------
    points_px : (rows, k, 2) float64
        Undistorted image points; nan where there is no candidate.
    active_mm : (rows, k, 3) float64
        Points on the laser plane; nan where there is no candidate or a gate closed.
    """

    points_px: NDArray[np.float64]
    active_mm: NDArray[np.float64]


@njit(cache=True, nogil=True)
def _crossing(points: Values, row: int, line: Values, predicted: float, tolerance: float, out: Values) -> int:
    """Where the other stripe between `row` and the next one meets the epipolar line; the partner's index or -1.

    `out` receives the point (u, v); the answer is the candidate of the row nearer to the crossing, coded
    row * k + candidate.
    """
    candidates = points.shape[1]
    best = tolerance
    found = -1
    for i in range(candidates):
        ua, va = points[row, i, 0], points[row, i, 1]
        if not abs(ua - predicted) < tolerance + MAX_STEP_PX:
            continue
        ea = line[0] * ua + line[1] * va + line[2]
        for j in range(candidates):
            ub, vb = points[row + 1, j, 0], points[row + 1, j, 1]
            if not abs(ub - ua) < MAX_STEP_PX:
                continue
            eb = line[0] * ub + line[1] * vb + line[2]
            if (ea > 0) == (eb > 0):
                continue
            part = ea / (ea - eb)
            u = ua + part * (ub - ua)
            if abs(u - predicted) < best:
                best = abs(u - predicted)
                out[0] = u
                out[1] = va + part * (vb - va)
                found = row * candidates + i if part < 0.5 else (row + 1) * candidates + j
    return found


@njit(cache=True, nogil=True)
def _walk(
    points: Values,
    active: Values,
    other: Values,
    to_other: Matrix,
    other_row: Values,
    f: Matrix,
    tolerance: float,
    partner: NDArray[np.int64],
    match: Values,
) -> None:
    rows, candidates = points.shape[0], points.shape[1]
    line = np.empty(3)
    for row in range(rows):
        for k in range(candidates):
            x, y, z = active[row, k, 0], active[row, k, 1], active[row, k, 2]
            if not np.isfinite(z):
                continue
            depth = to_other[2, 0] * x + to_other[2, 1] * y + to_other[2, 2] * z + to_other[2, 3]
            predicted = (to_other[0, 0] * x + to_other[0, 1] * y + to_other[0, 2] * z + to_other[0, 3]) / depth
            for i in range(3):
                line[i] = f[i, 0] * points[row, k, 0] + f[i, 1] * points[row, k, 1] + f[i, 2]
            if not np.isfinite(other_row[row, k]):
                continue
            start = int(np.floor(other_row[row, k]))
            for step in range(2 * REACH_ROWS + 1):
                # 0, 1, -1, 2, -2, ...: the crossing is nearly always in the predicted row.
                at = start + ((step + 1) // 2 if step % 2 else -(step // 2))
                if at < 0 or at + 1 >= other.shape[0]:
                    continue
                found = _crossing(other, at, line, predicted, tolerance, match[row, k])
                if found >= 0:
                    partner[row, k] = found
                    break


def walk(
    side: Side, other: Side, to_other: Matrix, other_row: NDArray[np.float64], f: Matrix
) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Match each candidate to the other camera's stripe by an epipolar walk with linear interpolation.

    Parameters
    ----------
    side, other : Side
        The stripe in this camera and in the other one.
    to_other : (3, 4)
        The other camera's projection matrix.
    other_row : (rows, k)
        Row of the other camera's (distorted) image at which each active point should appear.
    f : (3, 3)
        Fundamental matrix, ``other_h^T f this_h = 0``.

    Returns
    -------
    partner : (rows, k) int64
        Flat index of the matched candidate in the other camera, -1 where there is none.
    match_px : (rows, k, 2) float64
        The other camera's undistorted point on the epipolar line, between two rows of its stripe.
    """
    partner = np.full(side.points_px.shape[:2], -1, dtype=np.int64)
    match_px = np.full(side.points_px.shape, np.nan)
    _walk(
        side.points_px, side.active_mm, other.points_px, to_other, other_row, f, TOLERANCE_PX, partner, match_px
    )  # fmt: skip
    return partner, match_px
