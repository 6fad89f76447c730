"""Inner loops of the echo predictor: each facet's contribution is laid down at its delay."""

from __future__ import annotations

import numba
import numpy as np
from numpy.typing import NDArray

ANGLES = 512
"""Entries of the directivity table, over sin^2 of the angle to the axis."""
WALL_STEP_MM = 2.0


@numba.njit(cache=True, fastmath=True, inline="always")
def _shadowed(horizon: NDArray[np.float32], dx: float, dy: float, dz: float) -> bool:
    """Whether the horizon of a facet hides what lies in the direction (dx, dy, dz)."""
    azimuths = horizon.size
    azimuth = int(np.floor(np.arctan2(dy, dx) * (azimuths / (2 * np.pi)) + 0.5)) % azimuths
    tangent = horizon[azimuth]
    return tangent > 0 and dz * dz < tangent * tangent * (dx * dx + dy * dy)


@numba.njit(cache=True, fastmath=True, inline="always")
def _lay(
    out: NDArray[np.float32], channel: int, weight: float, at: float, de: NDArray[np.float32], dr: NDArray[np.float32]
) -> None:
    """Add a contribution to the two bins around its delay, weighted by the directivity at each node frequency."""
    k = int(at)
    if k < 0 or k + 1 >= out.shape[2]:
        return
    part = np.float32(at - k)
    for m in range(out.shape[1]):
        value = np.float32(weight) * de[m] * dr[m]
        out[channel, m, k] += value * (np.float32(1) - part)
        out[channel, m, k + 1] += value * part


@numba.njit(cache=True, fastmath=True, nogil=True)
def lay_facets(
    out: NDArray[np.float32],
    height_mm: NDArray[np.float64],
    slope: NDArray[np.float32],
    horizon: NDArray[np.float32],
    x0_mm: float,
    y0_mm: float,
    cell_mm: float,
    elements_mm: NDArray[np.float64],
    axis: NDArray[np.float64],
    table: NDArray[np.float32],
    bins_per_mm: float,
    first_bin: float,
    reach_mm: float,
) -> None:
    """Kirchhoff sum over the facets of a heightfield.

    `out` (receivers, nodes, bins) is added to; `elements_mm` (1 + receivers, 3) holds the emitter first; `table`
    (ANGLES, nodes) is the directivity; the outer third of `reach_mm` around the foot of the axis is tapered off,
    or its rim would echo.
    """
    count = elements_mm.shape[0]
    centre = elements_mm[0]
    foot_x = centre[0] - axis[0] / axis[2] * centre[2]
    foot_y = centre[1] - axis[1] / axis[2] * centre[2]
    rows, columns = height_mm.shape
    j0, j1 = int((foot_y - reach_mm - y0_mm) / cell_mm), int((foot_y + reach_mm - y0_mm) / cell_mm) + 1
    i0, i1 = int((foot_x - reach_mm - x0_mm) / cell_mm), int((foot_x + reach_mm - x0_mm) / cell_mm) + 1
    inner = 0.67 * reach_mm
    for j in range(max(0, j0), min(rows, j1)):
        y = y0_mm + (j + 0.5) * cell_mm
        for i in range(max(0, i0), min(columns, i1)):
            x = x0_mm + (i + 0.5) * cell_mm
            rho = np.sqrt((x - foot_x) ** 2 + (y - foot_y) ** 2)
            if rho >= reach_mm:
                continue
            area = cell_mm * cell_mm / (4 * np.pi)
            if rho > inner:
                area *= 0.5 + 0.5 * np.cos(np.pi * (rho - inner) / (reach_mm - inner))
            z = height_mm[j, i]
            gx, gy = slope[j, i, 0], slope[j, i, 1]
            ex, ey, ez = centre[0] - x, centre[1] - y, centre[2] - z
            if _shadowed(horizon[j, i], ex, ey, ez):
                continue
            r1 = np.sqrt(ex * ex + ey * ey + ez * ez)
            cos1 = -(ex * axis[0] + ey * axis[1] + ez * axis[2]) / r1
            lit1 = (ez - gx * ex - gy * ey) / r1
            if cos1 <= 0 or lit1 <= 0:
                continue
            de = table[int((1 - cos1 * cos1) * (ANGLES - 1))]
            for c in range(1, count):
                rx, ry, rz = elements_mm[c, 0] - x, elements_mm[c, 1] - y, elements_mm[c, 2] - z
                if _shadowed(horizon[j, i], rx, ry, rz):
                    continue
                r2 = np.sqrt(rx * rx + ry * ry + rz * rz)
                cos2 = -(rx * axis[0] + ry * axis[1] + rz * axis[2]) / r2
                lit2 = (rz - gx * rx - gy * ry) / r2
                if cos2 <= 0 or lit2 <= 0:
                    continue
                dr = table[int((1 - cos2 * cos2) * (ANGLES - 1))]
                _lay(out, c - 1, area * (lit1 + lit2) / (r1 * r2), (r1 + r2) * bins_per_mm - first_bin, de, dr)


@numba.njit(cache=True, fastmath=True, nogil=True)
def lay_walls(
    out: NDArray[np.float32],
    walls: NDArray[np.float64],
    cell_mm: float,
    elements_mm: NDArray[np.float64],
    axis: NDArray[np.float64],
    table: NDArray[np.float32],
    bins_per_mm: float,
    first_bin: float,
    reach_mm: float,
) -> None:
    """Floor-wall double bounce: each upright face seen once directly and once in the floor at its foot."""
    count = elements_mm.shape[0]
    centre = elements_mm[0]
    leg = np.empty((2, count))
    cosine = np.empty((2, count))
    for w in range(walls.shape[0]):
        x, y, low, high, nx, ny = walls[w]
        ex, ey = centre[0] - x, centre[1] - y
        if ex * nx + ey * ny <= 0 or ex * ex + ey * ey > reach_mm * reach_mm:
            continue
        steps = max(1, int(np.ceil((high - low) / WALL_STEP_MM)))
        dz = (high - low) / steps
        area = cell_mm * dz / (4 * np.pi)
        for s in range(steps):
            up = (s + 0.5) * dz
            for mirror in range(2):
                z = low - up if mirror == 1 else low + up
                for c in range(count):
                    vx, vy, vz = elements_mm[c, 0] - x, elements_mm[c, 1] - y, elements_mm[c, 2] - z
                    leg[mirror, c] = np.sqrt(vx * vx + vy * vy + vz * vz)
                    cosine[mirror, c] = -(vx * axis[0] + vy * axis[1] + vz * axis[2]) / leg[mirror, c]
            for c in range(1, count):
                across = (elements_mm[c, 0] - x) * nx + (elements_mm[c, 1] - y) * ny
                if across <= 0:
                    continue
                for way in range(2):
                    r1, r2 = leg[way, 0], leg[1 - way, c]
                    cos1, cos2 = cosine[way, 0], cosine[1 - way, c]
                    if cos1 <= 0 or cos2 <= 0:
                        continue
                    lit = (ex * nx + ey * ny) / r1 + across / r2
                    _lay(
                        out,
                        c - 1,
                        area * lit / (r1 * r2),
                        (r1 + r2) * bins_per_mm - first_bin,
                        table[int((1 - cos1 * cos1) * (ANGLES - 1))],
                        table[int((1 - cos2 * cos2) * (ANGLES - 1))],
                    )
