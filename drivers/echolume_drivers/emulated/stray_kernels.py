"""Compiled loops of light that goes astray: glint of edges and of glass, and the stripe's light on walls beside it."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.stripe_kernels import GLASS, TOP, cell_of, height_at, material_at, trace

Floats = NDArray[np.float64]
Ids = NDArray[np.int64]

BEVEL_MM = 0.3
"""Width of a worn edge; its normals turn from the top to the side."""
BEVEL_EXPONENT = 40.0
STEP_MM = 0.5
"""A smaller step has no edge and is no wall."""
REACH_MM = 6.0
"""Walls further beside the stripe than this get too little of its light to be seen."""
PIECES = 4
"""One in so many pieces of the stripe sends light to walls, for all of them; an edge has so many pieces a cell."""
OFF_MM = 1e-6
"""Rays start so far off the surface."""


@numba.njit(cache=True, nogil=True)
def _chips(ix: int, iy: int) -> float:
    """How much brighter than the mean the edge at a cell shines: exponentially distributed, the same at each visit."""
    z = np.uint64(ix * 73856093 + 19349663) ^ np.uint64(iy * 83492791 + 12345)
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    z = z ^ (z >> np.uint64(31))
    return -math.log((float(z >> np.uint64(11)) + 0.5) / 9007199254740992.0)


@numba.njit(cache=True, nogil=True)
def _bevel(sx: float, sy: float, x: float, y: float, z: float, head: Floats, eye: Floats) -> float:
    """Mirror lobe at (x, y, z) of an edge whose normals turn from straight up to the side (sx, sy)."""
    lx, ly, lz = head[0] - x, head[1] - y, head[2] - z
    ex, ey, ez = eye[0] - x, eye[1] - y, eye[2] - z
    l_mm, e_mm = math.sqrt(lx * lx + ly * ly + lz * lz), math.sqrt(ex * ex + ey * ey + ez * ez)
    hx, hy, hz = lx / l_mm + ex / e_mm, ly / l_mm + ey / e_mm, lz / l_mm + ez / e_mm
    length = math.sqrt(hx * hx + hy * hy + hz * hz)
    aside = max(0.0, hx * sx + hy * sy)
    return (math.sqrt(aside * aside + hz * hz) / length) ** BEVEL_EXPONENT * head[2] / l_mm


@numba.njit(cache=True, nogil=True)
def _clear(
    optical: Floats, front: Floats, material: NDArray[np.uint8], grid: Floats, start: Floats, head: Floats,
    eye: Floats, top_mm: float,
) -> bool:  # fmt: skip
    return (
        trace(optical, front, material, grid, start, head, top_mm) >= 0
        and trace(optical, front, material, grid, start, eye, top_mm) >= 0
    )


@numba.njit(cache=True, nogil=True)
def glints(
    optical: Floats,
    front: Floats,
    material: NDArray[np.uint8],
    grid: Floats,
    plane: Floats,
    head: Floats,
    eye: Floats,
    edge: Floats,
    glass: Floats,
    line_mm: float,
    top_mm: float,
) -> tuple[Floats, Floats, Floats]:
    """What shines where the laser meets worn edges and the glass's own surface.

    `edge` is the strength of a worn edge by material, `glass` is haze, mirror strength and its exponent, `line_mm`
    the standard deviation of the laser line's width.

    Returns
    -------
    spans
        Their two ends in mm, shape (n, 6).
    brightness
        Shape (n,), in terms of white under the line's crest.
    width
        Standard deviation in mm across the span, shape (n,).
    """
    rows, columns = front.shape
    lean_mm = -plane[2] / plane[0] * top_mm
    across = math.ceil((6 * line_mm + abs(lean_mm)) / grid[2]) + 4
    spans = np.empty((rows * (2 * PIECES * across + 4), 6))
    brightness, width = np.empty(len(spans)), np.empty(len(spans))
    start = np.empty(3)
    n = 0
    for iy in range(rows):
        y = grid[1] + (iy + 0.5) * grid[2]
        x_low = (plane[3] - plane[1] * y) / plane[0]
        for ix in range(
            max(0, cell_of(x_low + min(lean_mm, 0.0) - 3 * line_mm, grid[0], grid[2]) - 1),
            min(columns, cell_of(x_low + max(lean_mm, 0.0) + 3 * line_mm, grid[0], grid[2]) + 2),
        ):
            z, kind = front[iy, ix], material_at(material, ix, iy)
            x_left, y_low = grid[0] + ix * grid[2], grid[1] + iy * grid[2]
            x_plane = x_low - plane[2] / plane[0] * z
            start[2] = z + OFF_MM
            crossed = cell_of(x_plane, grid[0], grid[2]) == ix
            if crossed and kind == GLASS and glass[0] + glass[1] > 0:
                start[0], start[1] = x_plane, y
                lx, ly, lz = head[0] - x_plane, head[1] - y, head[2] - z
                ex, ey, ez = eye[0] - x_plane, eye[1] - y, eye[2] - z
                l_mm, e_mm = math.sqrt(lx * lx + ly * ly + lz * lz), math.sqrt(ex * ex + ey * ey + ez * ez)
                hx, hy, hz = lx / l_mm + ex / e_mm, ly / l_mm + ey / e_mm, lz / l_mm + ez / e_mm
                half = hz / math.sqrt(hx * hx + hy * hy + hz * hz)
                fresnel = 0.04 + 0.96 * (1 - lz / l_mm) ** 5
                shine = glass[0] * lz / l_mm + fresnel * glass[1] * half ** glass[2]
                if shine > 0 and _clear(optical, front, material, grid, start, head, eye, top_mm):
                    spans[n, 0], spans[n, 1], spans[n, 2] = x_plane, y_low, z
                    spans[n, 3], spans[n, 4], spans[n, 5] = x_plane, y_low + grid[2], z
                    brightness[n], width[n] = shine * head[2] / l_mm, line_mm
                    n += 1
            if edge[kind] <= 0:
                continue
            for side in (-1, 1):
                if crossed and z - height_at(front, ix, iy + side) > STEP_MM:
                    y_edge = y + 0.5 * side * grid[2]
                    start[0], start[1] = x_plane, y_edge - side * OFF_MM
                    shine = edge[kind] * _chips(ix, iy) * _bevel(0.0, side, x_plane, y_edge, z, head, eye)
                    if _clear(optical, front, material, grid, start, head, eye, top_mm):
                        spans[n, 0], spans[n, 1], spans[n, 2] = x_plane, y_edge - 0.5 * BEVEL_MM, z
                        spans[n, 3], spans[n, 4], spans[n, 5] = x_plane, y_edge + 0.5 * BEVEL_MM, z
                        brightness[n], width[n] = shine, line_mm
                        n += 1
                if z - height_at(front, ix + side, iy) > STEP_MM:
                    x_edge = x_left + (grid[2] if side > 0 else 0.0)
                    off = (x_edge - x_plane) / line_mm
                    if abs(off) > 3:
                        continue
                    start[0], start[1] = x_edge - side * OFF_MM, y
                    shine = edge[kind] * _chips(ix, iy) * _bevel(side, 0.0, x_edge, y, z, head, eye)
                    if _clear(optical, front, material, grid, start, head, eye, top_mm):
                        for k in range(PIECES):
                            spans[n, 0], spans[n, 1], spans[n, 2] = x_edge, y_low + k * grid[2] / PIECES, z
                            spans[n, 3], spans[n, 4], spans[n, 5] = x_edge, y_low + (k + 1) * grid[2] / PIECES, z
                            brightness[n], width[n] = shine * math.exp(-0.5 * off * off), BEVEL_MM / math.sqrt(12.0)
                            n += 1
    return spans[:n], brightness[:n], width[:n]


@numba.njit(cache=True, nogil=True)
def _wall(optical: Floats, grid: Floats, x: float, iy: int, z: float, side: int) -> tuple[float, float, int]:
    """The nearest wall beside (x, z): distance, height above z (0: none), and the column of the cell behind it."""
    here = cell_of(x, grid[0], grid[2])
    for k in range(1, math.ceil(REACH_MM / grid[2]) + 1):
        ix = here + side * k
        rise = height_at(optical, ix, iy) - z
        if rise > STEP_MM:
            face = grid[0] + (ix + (0 if side > 0 else 1)) * grid[2]
            return abs(face - x), rise, ix
        if rise < -STEP_MM:
            break
    return 0.0, 0.0, 0


@numba.njit(cache=True, nogil=True)
def second_stripes(
    optical: Floats,
    front: Floats,
    material: NDArray[np.uint8],
    grid: Floats,
    spans: Floats,
    kinds: Ids,
    head: Floats,
    eye: Floats,
    walls: Floats,
    line_mm: float,
    top_mm: float,
) -> tuple[Floats, Floats, Floats]:
    """Where walls that face the stripe sideways show it again: lit by it, and mirroring it.

    `walls` has a row per material: the diffuse albedo of a lit stripe on it, that of a wall times the strength of
    the effect, and the share that the wall mirrors. Spans, brightness and width are as of `glints`.

    Notes
    -----
    A line of width w lies on the ground at distance D from the foot of a wall. Both Lambertian, the wall at height
    h is lit to albedo * w D h / (2 r^3) of the line's own brightness, r^2 = D^2 + h^2: a ridge with its crest at
    h = D / sqrt(2), about 1.9 D wide at half its height. It is drawn as a Gaussian. The mirrored stripe lies behind
    the wall, as far as the stripe lies before it, and is seen only through the wall's face.
    """
    out = np.empty((4 * (len(spans) // PIECES + 1), 6))
    brightness, width = np.empty(len(out)), np.empty(len(out))
    line_width_mm = line_mm * math.sqrt(2 * math.pi)
    start = np.empty(3)
    n = 0
    for i in range(PIECES // 2, len(spans), PIECES):
        if kinds[i, 0] != TOP or walls[kinds[i, 2], 0] <= 0:
            continue
        x, y, z = (
            0.5 * (spans[i, 0] + spans[i, 3]),
            0.5 * (spans[i, 1] + spans[i, 4]),
            0.5 * (spans[i, 2] + spans[i, 5]),
        )
        iy = cell_of(y, grid[1], grid[2])
        half_mm = 0.5 * PIECES * (spans[i, 4] - spans[i, 1])
        for side in (-1, 1):
            far_mm, rise_mm, ix = _wall(optical, grid, x, iy, z, side)
            face = x + side * far_mm
            if rise_mm <= 0 or (eye[0] - face) * side >= 0:
                continue
            start[0], start[1], start[2] = x, y, z + OFF_MM
            if trace(optical, front, material, grid, start, head, top_mm) < 0:
                continue
            lx, ly, lz = head[0] - x, head[1] - y, head[2] - z
            l_mm = math.sqrt(lx * lx + ly * ly + lz * lz)
            wall = walls[material_at(material, ix, iy)]
            lit = walls[kinds[i, 2], 0] * lz / l_mm * head[2] / l_mm
            start[0] = face - side * OFF_MM
            if wall[1] > 0:
                away_mm = max(far_mm, 0.5)
                crest_mm = min(away_mm / math.sqrt(2.0), 0.7 * rise_mm)
                start[2] = z + crest_mm
                if trace(optical, front, material, grid, start, eye, top_mm) >= 0:
                    shine = 0.5 * line_width_mm * away_mm * crest_mm / math.hypot(away_mm, crest_mm) ** 3
                    out[n, 0], out[n, 1], out[n, 2] = face, y - half_mm, z + crest_mm
                    out[n, 3], out[n, 4], out[n, 5] = face, y + half_mm, z + crest_mm
                    foreshortened = abs(eye[0] - face) / math.hypot(eye[0] - face, eye[2] - z)
                    brightness[n], width[n] = lit * wall[1] * shine, min(0.8 * away_mm, 0.4 * rise_mm) * foreshortened
                    n += 1
            if wall[2] > 0:
                image = face + side * far_mm
                t = (face - eye[0]) / (image - eye[0]) if far_mm > 0 else 1.0
                seen_z = eye[2] + t * (z - eye[2])
                if z < seen_z < z + rise_mm:
                    start[1], start[2] = eye[1] + t * (y - eye[1]), seen_z
                    if trace(optical, front, material, grid, start, eye, top_mm) >= 0:
                        out[n, 0], out[n, 1], out[n, 2] = image, y - half_mm, z
                        out[n, 3], out[n, 4], out[n, 5] = image, y + half_mm, z
                        brightness[n], width[n] = lit * wall[2], line_mm
                        n += 1
    return out[:n], brightness[:n], width[:n]
