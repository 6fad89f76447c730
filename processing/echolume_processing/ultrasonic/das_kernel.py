"""Inner loops of delay-and-sum by convolution."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, fastmath=True, nogil=True)
def lay_kernel(
    out: NDArray[np.complex64],
    table: NDArray[np.complex64],
    x_mm: NDArray[np.float32],
    y_mm: NDArray[np.float32],
    drop_mm: np.float32,
    offset_mm: NDArray[np.float32],
    per_mm: np.float32,
    start: np.float32,
    axis: NDArray[np.float32],
    min_cosine: np.float32,
) -> None:
    """Lay functions of the path over the differences between voxels and poses.

    `out` is (functions, phases y, phases x, ly, lx); `table` (entries, functions) holds each function `per_mm` entries
    per mm of path from `start` on, its first and its last two entries 0: paths outside read them.
    """
    functions, phases_y, phases_x, rows, columns = out.shape
    top = np.float32(len(table) - 2)
    nought = np.float32(0)
    limited = min_cosine > -1
    at, part = np.empty(columns, np.int32), np.empty(columns, np.float32)
    down = drop_mm * drop_mm
    drop_r = drop_mm - offset_mm[2]
    for py in range(phases_y):
        for px in range(phases_x):
            for row in range(rows):
                dy = y_mm[py, row]
                ry = dy - offset_mm[1]
                flat, flat_r = dy * dy + down, ry * ry + drop_r * drop_r
                for k in range(columns):
                    dx = x_mm[px, k]
                    rx = dx - offset_mm[0]
                    there = math.sqrt(dx * dx + flat)
                    u = (there + math.sqrt(rx * rx + flat_r)) * per_mm - start
                    if limited and dx * axis[0] + dy * axis[1] + drop_mm * axis[2] < min_cosine * there:
                        u = nought
                    u = min(max(u, nought), top)
                    j = np.int32(u)
                    at[k] = j
                    part[k] = u - np.float32(j)
                for k in range(columns):
                    f = part[k]
                    low, high = table[np.uint32(at[k])], table[np.uint32(at[k]) + np.uint32(1)]
                    for m in range(functions):
                        out[m, py, px, row, k] = low[m] + f * (high[m] - low[m])


@numba.njit(cache=True, fastmath=True, nogil=True)
def multiply_add(
    total: NDArray[np.complex64], kernel: NDArray[np.complex64], coefficients: NDArray[np.complex64]
) -> None:
    """Add the products of spectra to `total` (py, px, ly, lx): of the kernel (functions, py, px, ly, lx) with the
    coefficients (functions, ly, lx).
    """
    functions, phases_y, phases_x, rows, columns = kernel.shape
    for py in range(phases_y):
        for px in range(phases_x):
            for m in range(functions):
                for row in range(rows):
                    out, a, b = total[py, px, row], kernel[m, py, px, row], coefficients[m, row]
                    for k in range(columns):
                        out[k] += a[k] * b[k]
