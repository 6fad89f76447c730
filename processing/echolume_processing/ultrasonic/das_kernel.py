"""Inner loops of delay-and-sum by convolution."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray


@numba.njit(cache=True, fastmath=True, nogil=True)
def lay_kernel(
    out: NDArray[np.float64],
    table: NDArray[np.float32],
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

    `out` is (functions, ly, lx), complex64 viewed as float64, so that a value moves as one word; `table`
    (entries, 2 functions) holds real and imaginary part of each function `per_mm` entries per mm of path from `start`
    on, its first and its last two entries 0: paths outside read them.
    """
    functions, rows, columns = out.shape
    top = np.float32(len(table) - 2)
    nought = np.float32(0)
    limited = min_cosine > -1
    at, part = np.empty(columns, np.int32), np.empty(columns, np.float32)
    words = np.empty((columns, functions), np.float64)
    between = words.view(np.float32)
    drop_r = drop_mm - offset_mm[2]
    for row in range(rows):
        dy = y_mm[row]
        ry = dy - offset_mm[1]
        flat, flat_r = dy * dy + drop_mm * drop_mm, ry * ry + drop_r * drop_r
        for k in range(columns):
            dx = x_mm[k]
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
            f, n = part[k], np.uint32(at[k])
            low, high, to = table[n], table[n + np.uint32(1)], between[k]
            for m in range(2 * functions):
                to[m] = low[m] + f * (high[m] - low[m])
        for m in range(functions):
            to_row = out[m, row]
            for k in range(columns):
                to_row[k] = words[k, m]


@numba.njit(cache=True, fastmath=True, nogil=True)
def multiply_add(
    total: NDArray[np.complex64], kernel: NDArray[np.complex64], coefficients: NDArray[np.complex64]
) -> None:
    """Add the products of spectra to `total` (ly, lx): of kernel and coefficients, both (functions, ly, lx)."""
    functions, rows, columns = kernel.shape
    for row in range(rows):
        out = total[row]
        for m in range(functions):
            a, b = kernel[m, row], coefficients[m, row]
            for k in range(columns):
                out[k] += a[k] * b[k]
