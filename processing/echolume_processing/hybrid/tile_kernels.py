"""The loops over tiles: their spectra, and least squares within bounds."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray


def warm_up() -> None:
    """Compile or load the kernels of this module."""
    cells = 2
    plate_slope = np.zeros((cells, cells, 2))
    flat, slope = np.zeros((cells, cells)), np.zeros((cells, cells, 2), dtype=np.float32)
    elements_mm, axis = np.array([[0.0, 0.0, 100.0], [15.0, 0.0, 100.0]]), np.array([0.0, 0.0, -1.0])
    table, weights = np.ones((8, 1), dtype=np.float32), np.ones((1, 2), dtype=np.float32)
    corners, wave = np.zeros((1, 2), dtype=np.int64), np.array([0.8, 0.9])
    tile_spectra(
        corners, cells, True, flat, slope, flat, plate_slope, 0.0, 0.0, 1.0, elements_mm, axis, table, weights, wave
    )  # fmt: skip
    solve_box(np.eye(2), np.ones(2), np.zeros(2), np.ones(2), 1)


@numba.njit(cache=True)
def solve_box(
    gram: NDArray[np.float64],
    right: NDArray[np.float64],
    low: NDArray[np.float64],
    high: NDArray[np.float64],
    sweeps: int,
) -> NDArray[np.float64]:
    """Minimise x'Gx/2 - b'x over low <= x <= high by projected Gauss-Seidel, from 0."""
    n = right.size
    x = np.zeros(n)
    for _ in range(sweeps):
        for t in range(n):
            if gram[t, t] <= 0:
                continue
            step = (right[t] - np.dot(gram[t], x)) / gram[t, t]
            x[t] = min(high[t], max(low[t], x[t] + step))
    return x


@numba.njit(cache=True, fastmath=True)
def tile_spectra(
    corners: NDArray[np.int64],
    cells: int,
    returns: bool,
    height_mm: NDArray[np.float64],
    slope: NDArray[np.float32],
    plate_mm: NDArray[np.float64],
    plate_slope: NDArray[np.float64],
    x0_mm: float,
    y0_mm: float,
    cell_mm: float,
    elements_mm: NDArray[np.float64],
    axis: NDArray[np.float64],
    table: NDArray[np.float32],
    weights: NDArray[np.float32],
    wave: NDArray[np.float64],
) -> NDArray[np.complex64]:
    """Plate (if it returns anything) minus base for each tile, per receiver and bin, without the factor jk."""
    receivers, bins = elements_mm.shape[0] - 1, wave.size
    out = np.zeros((corners.shape[0], receivers, bins), dtype=np.complex64)
    first, step = wave[0], wave[1] - wave[0]
    area = cell_mm * cell_mm / (4 * np.pi)
    lobes = np.empty((receivers, bins), dtype=np.float32)
    for t in range(corners.shape[0]):
        for layer in range(0 if returns else 1, 2):
            _lobes(
                lobes, corners[t], cells, plate_mm if layer == 0 else height_mm, x0_mm, y0_mm, cell_mm,
                elements_mm, axis, table, weights,
            )  # fmt: skip
            for jj in range(cells):
                for ii in range(cells):
                    j, i = corners[t, 0] + jj, corners[t, 1] + ii
                    if j >= height_mm.shape[0] or i >= height_mm.shape[1]:
                        continue
                    x, y = x0_mm + (i + 0.5) * cell_mm, y0_mm + (j + 0.5) * cell_mm
                    z, gx, gy, sign = plate_mm[j, i], plate_slope[j, i, 0], plate_slope[j, i, 1], 1.0
                    if layer == 1:
                        z, gx, gy, sign = height_mm[j, i], slope[j, i, 0], slope[j, i, 1], -1.0
                    ex, ey, ez = elements_mm[0, 0] - x, elements_mm[0, 1] - y, elements_mm[0, 2] - z
                    r1 = np.sqrt(ex * ex + ey * ey + ez * ez)
                    lit1 = max(0.0, (ez - gx * ex - gy * ey) / r1)
                    for c in range(receivers):
                        rx, ry, rz = elements_mm[c + 1, 0] - x, elements_mm[c + 1, 1] - y, elements_mm[c + 1, 2] - z
                        r2 = np.sqrt(rx * rx + ry * ry + rz * rz)
                        lit2 = max(0.0, (rz - gx * rx - gy * ry) / r2)
                        path = r1 + r2
                        phasor = np.complex64(sign * area * (lit1 + lit2) / (r1 * r2) * np.exp(-1j * first * path))
                        turn = np.complex64(np.exp(-1j * step * path))
                        for f in range(bins):
                            out[t, c, f] += lobes[c, f] * phasor
                            phasor *= turn
    return out


@numba.njit(cache=True, fastmath=True)
def _lobes(
    out: NDArray[np.float32],
    corner: NDArray[np.int64],
    cells: int,
    height_mm: NDArray[np.float64],
    x0_mm: float,
    y0_mm: float,
    cell_mm: float,
    elements_mm: NDArray[np.float64],
    axis: NDArray[np.float64],
    table: NDArray[np.float32],
    weights: NDArray[np.float32],
) -> None:
    """Directivity both ways at the middle of a tile, per receiver and bin."""
    j = min(corner[0] + cells // 2, height_mm.shape[0] - 1)
    i = min(corner[1] + cells // 2, height_mm.shape[1] - 1)
    x, y, z = x0_mm + (i + 0.5) * cell_mm, y0_mm + (j + 0.5) * cell_mm, height_mm[j, i]
    emitted = table[0]
    for c in range(elements_mm.shape[0]):
        vx, vy, vz = elements_mm[c, 0] - x, elements_mm[c, 1] - y, elements_mm[c, 2] - z
        cosine = -(vx * axis[0] + vy * axis[1] + vz * axis[2]) / np.sqrt(vx * vx + vy * vy + vz * vz)
        lobe = table[int((1 - min(1.0, max(0.0, cosine)) ** 2) * (table.shape[0] - 1))]
        if c == 0:
            emitted = lobe
            continue
        for f in range(weights.shape[1]):
            total = np.float32(0)
            for m in range(weights.shape[0]):
                total += weights[m, f] * emitted[m] * lobe[m]
            out[c - 1, f] = total
