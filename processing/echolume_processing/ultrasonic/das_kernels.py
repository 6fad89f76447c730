"""Inner loops of delay-and-sum."""

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


@numba.njit(cache=True, fastmath=True, nogil=True)
def lay_poses(
    out: NDArray[np.float32],
    iq: NDArray[np.float64],
    emitters: NDArray[np.float64],
    receivers: NDArray[np.float64],
    axes: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    scale: NDArray[np.float64],
    weights: NDArray[np.float32],
    min_cosine: float,
    with_power: bool,
) -> None:
    """Add some poses to real part, imaginary part, power and number of echoes of columns of voxels, all in mm.

    `out` is (4, ny, nx, nz). A sample is read as one 64-bit word (`iq` views complex64 as float64), and reading is a
    loop of its own: compilers then keep the arithmetic before and after it in vector registers.
    """
    poses, channels, samples = iq.shape
    depth = z.size
    leg, part, turn = np.empty(depth, np.float32), np.empty(depth, np.float32), np.empty(depth, np.float32)
    heights = z.astype(np.float32)
    at = np.empty(depth, np.int32)
    words = np.empty((2, depth), np.float64)
    low_word, high_word = words[0], words[1]
    floats = words.view(np.float32)
    low, high = floats[0], floats[1]
    per_mm, first, turns = np.float32(scale[0]), np.float32(scale[1]), np.float32(scale[2])
    top, nought, half = np.float32(samples - 2), np.float32(0), np.float32(0.5)
    c0, c1, c2, c3, c4, c5 = weights[0]
    s0, s1, s2, s3, s4, s5 = weights[1]
    limited = min_cosine > -1
    for p in range(poses):
        for iy in range(y.size):
            for ix in range(x.size):
                dx, dy = x[ix] - emitters[p, 0], y[iy] - emitters[p, 1]
                rho, up = np.float32(dx * dx + dy * dy), np.float32(emitters[p, 2])
                for k in range(depth):
                    dz = heights[k] - up
                    leg[k] = math.sqrt(rho + dz * dz) * per_mm - first
                if limited:
                    side, ahead = np.float32(dx * axes[p, 0] + dy * axes[p, 1]), np.float32(axes[p, 2])
                    least = np.float32(min_cosine) / per_mm
                    count = out[3, iy, ix]
                    for k in range(depth):
                        seen = side + (heights[k] - up) * ahead >= least * (leg[k] + first)
                        count[k] += np.float32(channels) if seen else nought
                        leg[k] = leg[k] if seen else np.float32(-1e6)
                real, imaginary, power = out[0, iy, ix], out[1, iy, ix], out[2, iy, ix]
                for c in range(channels):
                    dx, dy = x[ix] - receivers[p, c, 0], y[iy] - receivers[p, c, 1]
                    rho, up = np.float32(dx * dx + dy * dy), np.float32(receivers[p, c, 2])
                    for k in range(depth):
                        dz = heights[k] - up
                        u = leg[k] + math.sqrt(rho + dz * dz) * per_mm
                        u = min(max(u, nought), top)
                        j = np.int32(u)
                        at[k] = j
                        part[k] = u - np.float32(j)
                        u *= turns
                        turn[k] = u - math.floor(u + half)
                    row = iq[p, c]
                    for k in range(depth):
                        n = np.uint32(at[k])
                        low_word[k] = row[n]
                        high_word[k] = row[n + np.uint32(1)]
                    for k in range(depth):
                        f, t = part[k], turn[k]
                        h = t * t
                        cosine = c0 + h * (c1 + h * (c2 + h * (c3 + h * (c4 + h * c5))))
                        sine = t * (s0 + h * (s1 + h * (s2 + h * (s3 + h * (s4 + h * s5)))))
                        a, b = low[2 * k], low[2 * k + 1]
                        a += f * (high[2 * k] - a)
                        b += f * (high[2 * k + 1] - b)
                        real[k] += a * cosine - b * sine
                        imaginary[k] += a * sine + b * cosine
                    if with_power:
                        for k in range(depth):
                            f = part[k]
                            a = low[2 * k] + f * (high[2 * k] - low[2 * k])
                            b = low[2 * k + 1] + f * (high[2 * k + 1] - low[2 * k + 1])
                            power[k] += a * a + b * b
    if not limited:
        out[3] += np.float32(poses * channels)
