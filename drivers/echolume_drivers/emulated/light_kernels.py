"""Compiled loops of the stripe renderer: the laser plane cut with the heightfield, shadow, splat, and stray light.

`ground` is `Scene.light_ground` (height, dz/dx, dz/dy, underside), `glass` is `Scene.glass` (the same of the front,
panes, thickness), both (rows, columns, ...); a cell is a plane through the height at its centre.

All in one file: numba renews a cached kernel when its own file changes, not when that of a callee does.
"""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Ids = NDArray[np.int64]

GLASS, MIRROR = 2, 4
"""Of `Material`, as plain numbers for the compiled code."""

TOP, WALL = 0, 1
HEIGHT, RISE_X, RISE_Y, UNDER, PANES, THICK = range(6)

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
def cell_of(value: float, origin_mm: float, cell_mm: float) -> int:
    return math.floor((value - origin_mm) / cell_mm)


@numba.njit(cache=True, nogil=True)
def height_at(field: Floats, ix: int, iy: int) -> float:
    """Height of a cell's centre; the bench (0) goes on beyond the field."""
    if ix < 0 or iy < 0 or iy >= field.shape[0] or ix >= field.shape[1]:
        return 0.0
    return field[iy, ix, HEIGHT]


@numba.njit(cache=True, nogil=True)
def plane_at(field: Floats, ix: int, iy: int, off_x: float, off_y: float) -> float:
    """Height of a cell's plane, so far from its centre."""
    if ix < 0 or iy < 0 or iy >= field.shape[0] or ix >= field.shape[1]:
        return 0.0
    return field[iy, ix, HEIGHT] + field[iy, ix, RISE_X] * off_x + field[iy, ix, RISE_Y] * off_y


@numba.njit(cache=True, nogil=True)
def _tilts(field: Floats, ix: int, iy: int) -> bool:
    if ix < 0 or iy < 0 or iy >= field.shape[0] or ix >= field.shape[1]:
        return False
    return field[iy, ix, RISE_X] != 0.0 or field[iy, ix, RISE_Y] != 0.0


@numba.njit(cache=True, nogil=True)
def trace(ground: Floats, glass: Floats, grid: Floats, start: Floats, target: Floats, top_mm: float) -> int:
    """How many panes the straight way from `start` up to `target` crosses; -1 if something opaque is in it.

    `grid` is (x0_mm, y0_mm, cell_mm); nothing is higher than `top_mm`.
    """
    return march(ground, glass, grid, start, target, top_mm, 0.0, start)


@numba.njit(cache=True, nogil=True)
def march(
    ground: Floats, glass: Floats, grid: Floats, start: Floats, target: Floats, top_mm: float, index: float,
    raised: Floats,
) -> int:  # fmt: skip
    """As `trace`; with a refractive `index`, adds to `raised` (3,) how far the glass seems to raise the start.

    Without an index (0), `raised` is left alone.

    A plane plate of thickness t seems to raise what lies behind it along its normal, by
    t (1 - cos a / sqrt(index^2 - sin^2 a)) under the angle a; the way is taken as straight to find a.
    """
    x0, y0, cell = grid[0], grid[1], grid[2]
    dx, dy, dz = target[0] - start[0], target[1] - start[1], target[2] - start[2]
    ix, iy = cell_of(start[0], x0, cell), cell_of(start[1], y0, cell)
    step_x, step_y = (1 if dx > 0 else -1), (1 if dy > 0 else -1)
    next_x = x0 + (ix + (1 if dx > 0 else 0)) * cell
    next_y = y0 + (iy + (1 if dy > 0 else 0)) * cell
    t_x = (next_x - start[0]) / dx if dx != 0.0 else math.inf
    t_y = (next_y - start[1]) / dy if dy != 0.0 else math.inf
    d_x = cell / abs(dx) if dx != 0.0 else math.inf
    d_y = cell / abs(dy) if dy != 0.0 else math.inf
    t, crossed, inside = 0.0, 0, False
    while t < 1.0:
        z = start[2] + t * dz
        if z > top_mm:
            break
        end = min(min(t_x, t_y), 1.0)
        z_end = start[2] + end * dz
        if 0 <= ix < ground.shape[1] and 0 <= iy < ground.shape[0]:
            xc, yc = x0 + (ix + 0.5) * cell, y0 + (iy + 0.5) * cell
            off_x, off_y = start[0] + t * dx - xc, start[1] + t * dy - yc
            end_x, end_y = start[0] + end * dx - xc, start[1] + end * dy - yc
            rise_x, rise_y = ground[iy, ix, RISE_X], ground[iy, ix, RISE_Y]
            floor = ground[iy, ix, HEIGHT] - 1e-6
            if z < floor + rise_x * off_x + rise_y * off_y or z_end < floor + rise_x * end_x + rise_y * end_y:
                under = ground[iy, ix, UNDER]
                if under == -math.inf or z_end > under + rise_x * end_x + rise_y * end_y + 1e-6:
                    return -1
            in_glass = False
            if glass[iy, ix, PANES] > 0.0:
                rise_x, rise_y = glass[iy, ix, RISE_X], glass[iy, ix, RISE_Y]
                under = glass[iy, ix, UNDER]
                in_glass = z < glass[iy, ix, HEIGHT] + (rise_x * off_x + rise_y * off_y) and (
                    under == -math.inf or z_end > under + rise_x * end_x + rise_y * end_y
                )
            if in_glass and not inside:
                crossed += int(glass[iy, ix, PANES])
                if index > 0.0 and glass[iy, ix, THICK] > 0.0:
                    _raise(glass[iy, ix], dx, dy, dz, index, raised)
            inside = in_glass
        else:
            if z < -1e-6:
                return -1
            inside = False
        if t_x < t_y:
            t = t_x
            t_x += d_x
            ix += step_x
        else:
            t = t_y
            t_y += d_y
            iy += step_y
    return crossed


@numba.njit(cache=True, nogil=True)
def _raise(pane: Floats, dx: float, dy: float, dz: float, index: float, raised: Floats) -> None:
    """Add what a pane seems to raise its background by, seen along a way."""
    nx, ny = -pane[RISE_X], -pane[RISE_Y]
    norm = math.sqrt(nx * nx + ny * ny + 1.0)
    cosine = abs(nx * dx + ny * dy + dz) / (norm * math.sqrt(dx * dx + dy * dy + dz * dz))
    by_mm = pane[THICK] * (1.0 - cosine / math.sqrt(index * index - 1.0 + cosine * cosine)) / norm
    raised[0] += by_mm * nx
    raised[1] += by_mm * ny
    raised[2] += by_mm


@numba.njit(cache=True, nogil=True)
def project(camera: Floats, x: float, y: float, z: float) -> tuple[float, float]:
    """Distorted image point (u, v) of a rig point; `camera` is CameraTruth.packed."""
    cx = camera[9] * x + camera[10] * y + camera[11] * z + camera[12]
    cy = camera[13] * x + camera[14] * y + camera[15] * z + camera[16]
    cz = camera[17] * x + camera[18] * y + camera[19] * z + camera[20]
    a, b = cx / cz, cy / cz
    r2 = a * a + b * b
    radial = 1 + r2 * (camera[4] + r2 * (camera[5] + r2 * camera[8]))
    p1, p2 = camera[6], camera[7]
    return (
        camera[0] * (a * radial + 2 * p1 * a * b + p2 * (r2 + 2 * a * a)) + camera[2],
        camera[1] * (b * radial + p1 * (r2 + 2 * b * b) + 2 * p2 * a * b) + camera[3],
    )


@numba.njit(cache=True, nogil=True)
def _met(ground: Floats, grid: Floats, lean: float, x_low: float, y: float, ix: int, iy: int) -> float:
    """Where the laser plane x = x_low - lean z meets the plane of a cell."""
    if ix < 0 or iy < 0 or iy >= ground.shape[0] or ix >= ground.shape[1]:
        return 0.0
    if ground[iy, ix, RISE_X] == 0.0 and ground[iy, ix, RISE_Y] == 0.0:
        return ground[iy, ix, HEIGHT]
    off_x, off_y = x_low - (grid[0] + (ix + 0.5) * grid[2]), y - (grid[1] + (iy + 0.5) * grid[2])
    rise_x = ground[iy, ix, RISE_X]
    return (ground[iy, ix, HEIGHT] + rise_x * off_x + ground[iy, ix, RISE_Y] * off_y) / (1.0 + rise_x * lean)


@numba.njit(cache=True, nogil=True)
def top_height(ground: Floats, grid: Floats, plane: Floats, y: float, iy: int) -> float:
    """Where the laser plane, coming from above at this y, meets the cells of row iy."""
    x_low = (plane[3] - plane[1] * y) / plane[0]
    lean = plane[2] / plane[0]
    first = _met(ground, grid, lean, x_low, y, cell_of(x_low, grid[0], grid[2]), iy)
    x_first = x_low - plane[2] / plane[0] * first
    ix = cell_of(x_first, grid[0], grid[2])
    second = _met(ground, grid, lean, x_low, y, ix, iy)
    if second == first:
        return first
    x_second = x_low - plane[2] / plane[0] * second
    if cell_of(x_second, grid[0], grid[2]) == ix:
        return second
    # The plane leaves the cell on the way down: it meets the side of its higher neighbour.
    edge = grid[0] + (ix + (1 if x_second > x_first else 0)) * grid[2]
    return (x_low - edge) * plane[0] / plane[2]


@numba.njit(cache=True, nogil=True)
def _put(spans: Floats, n: int, xa: float, ya: float, za: float, xb: float, yb: float, zb: float) -> None:
    spans[n, 0], spans[n, 1], spans[n, 2] = xa, ya, za
    spans[n, 3], spans[n, 4], spans[n, 5] = xb, yb, zb


@numba.njit(cache=True, nogil=True)
def _underside(ground: Floats, grid: Floats, x: float, y: float, iy: int) -> float:
    """Where the body in row iy ends below at (x, y); -inf if it stands on what is below."""
    ix = cell_of(x, grid[0], grid[2])
    if ix < 0 or iy < 0 or iy >= ground.shape[0] or ix >= ground.shape[1] or ground[iy, ix, UNDER] == -math.inf:
        return -math.inf
    off_x, off_y = x - (grid[0] + (ix + 0.5) * grid[2]), y - (grid[1] + (iy + 0.5) * grid[2])
    return ground[iy, ix, UNDER] + ground[iy, ix, RISE_X] * off_x + ground[iy, ix, RISE_Y] * off_y


@numba.njit(cache=True, nogil=True)
def cut(
    ground: Floats,
    material: NDArray[np.uint8],
    grid: Floats,
    plane: Floats,
    y_mm: tuple[float, float],
    per_mm: int,
    relief_mm: float,
) -> tuple[Floats, NDArray[np.int64]]:
    """Cut the plane n.X = c (`plane` = n, c) with the optical surface, from low to high y.

    There are `per_mm` pieces to the millimetre; no step between two cells is higher than `relief_mm`.

    Returns
    -------
    spans
        Short straight pieces, shape (n, 6): their two ends in mm.
    kinds
        Shape (n, 3): TOP or WALL, the wall's outward direction along y (-1 or 1), the material.
    """
    first, last = cell_of(y_mm[0], grid[1], grid[2]), cell_of(y_mm[1], grid[1], grid[2])
    per_cell = max(1, round(per_mm * grid[2]))
    limit = (last - first + 1) * (per_cell + 2 + int(per_mm * (relief_mm + 1)))
    spans = np.empty((limit, 6))
    kinds = np.empty((limit, 3), dtype=np.int64)
    n = 0
    for iy in range(first, last + 1):
        y_start = grid[1] + iy * grid[2]
        for k in range(per_cell):
            ya, yb = y_start + k * grid[2] / per_cell, y_start + (k + 1) * grid[2] / per_cell
            za, zb = top_height(ground, grid, plane, ya, iy), top_height(ground, grid, plane, yb, iy)
            xa = (plane[3] - plane[1] * ya - plane[2] * za) / plane[0]
            xb = (plane[3] - plane[1] * yb - plane[2] * zb) / plane[0]
            ix = cell_of(0.5 * (xa + xb), grid[0], grid[2])
            _put(spans, n, xa, ya, za, xb, yb, zb)
            kinds[n, 0], kinds[n, 1] = TOP, 0
            kinds[n, 2] = material_at(material, ix, iy)
            n += 1
        y_end = y_start + grid[2]
        z_here, z_next = top_height(ground, grid, plane, y_end, iy), top_height(ground, grid, plane, y_end, iy + 1)
        rise = z_next - z_here
        if abs(rise) < 1e-9:
            continue
        owner = iy + 1 if rise > 0 else iy
        under = _underside(ground, grid, (plane[3] - plane[1] * y_end - plane[2] * z_here) / plane[0], y_end, owner)
        if under > min(z_here, z_next):
            # it hangs: the side begins at its underside
            z_here, z_next = (under, z_next) if rise > 0 else (z_here, under)
            rise = z_next - z_here
        pieces = max(1, math.ceil(per_mm * abs(rise)))
        for k in range(pieces):
            za, zb = z_here + rise * k / pieces, z_here + rise * (k + 1) / pieces
            xa = (plane[3] - plane[1] * y_end - plane[2] * za) / plane[0]
            xb = (plane[3] - plane[1] * y_end - plane[2] * zb) / plane[0]
            _put(spans, n, xa, y_end, za, xb, y_end, zb)
            kinds[n, 0], kinds[n, 1] = WALL, (-1 if rise > 0 else 1)
            kinds[n, 2] = material_at(material, cell_of(0.5 * (xa + xb), grid[0], grid[2]), owner)
            n += 1
    return spans[:n], kinds[:n]


@numba.njit(cache=True, nogil=True)
def material_at(material: NDArray[np.uint8], ix: int, iy: int) -> int:
    if ix < 0 or iy < 0 or iy >= material.shape[0] or ix >= material.shape[1]:
        return 0
    return int(material[iy, ix])


@numba.njit(cache=True, nogil=True)
def light(
    ground: Floats,
    glass: Floats,
    grid: Floats,
    spans: Floats,
    kinds: NDArray[np.int64],
    head: Floats,
    eye: Floats,
    surface: Floats,
    transmission: float,
    top_mm: float,
) -> Floats:
    """Brightness of each piece as the camera at `eye` sees it, shape (n,); 0 where dark, shadowed or hidden.

    `surface` has a row per material: diffuse albedo, specular strength; nothing is higher than `top_mm`. Brightness 1
    is white, lit at right angles from the bench's distance to the head.
    """
    n = spans.shape[0]
    out = np.zeros(n)
    reach_mm = head[2]
    start = np.empty(3)
    for i in range(n):
        albedo, specular = surface[kinds[i, 2], 0], surface[kinds[i, 2], 1]
        if albedo <= 0.0 and specular <= 0.0:
            continue
        for k in range(3):
            start[k] = 0.5 * (spans[i, k] + spans[i, k + 3])
        normal_x, normal_y, normal_z = 0.0, float(kinds[i, 1]), (1.0 if kinds[i, 0] == TOP else 0.0)
        ix, iy = cell_of(start[0], grid[0], grid[2]), cell_of(start[1], grid[1], grid[2])
        if kinds[i, 0] == TOP and _tilts(ground, ix, iy):
            normal_z = 1.0 / math.sqrt(1.0 + ground[iy, ix, RISE_X] ** 2 + ground[iy, ix, RISE_Y] ** 2)
            normal_x, normal_y = -ground[iy, ix, RISE_X] * normal_z, -ground[iy, ix, RISE_Y] * normal_z
        lx, ly, lz = head[0] - start[0], head[1] - start[1], head[2] - start[2]
        ex, ey, ez = eye[0] - start[0], eye[1] - start[1], eye[2] - start[2]
        l_mm, e_mm = math.sqrt(lx * lx + ly * ly + lz * lz), math.sqrt(ex * ex + ey * ey + ez * ez)
        lit = (normal_x * lx + normal_y * ly + normal_z * lz) / l_mm
        seen = (normal_x * ex + normal_y * ey + normal_z * ez) / e_mm
        if lit <= 0.0 or seen <= 0.0:
            continue
        start[0] += 1e-7 * normal_x
        start[1] += 1e-7 * normal_y
        start[2] += 1e-7 * normal_z
        in_way = trace(ground, glass, grid, start, head, top_mm)
        if in_way < 0:
            continue
        out_way = trace(ground, glass, grid, start, eye, top_mm)
        if out_way < 0:
            continue
        hx, hy, hz = lx / l_mm + ex / e_mm, ly / l_mm + ey / e_mm, lz / l_mm + ez / e_mm
        half = (normal_x * hx + normal_y * hy + normal_z * hz) / math.sqrt(hx * hx + hy * hy + hz * hz)
        brightness = albedo * lit + specular * max(half, 0.0) ** 80
        out[i] = brightness * reach_mm / l_mm * transmission ** (in_way + out_way)
    return out


@numba.njit(cache=True, nogil=True)
def images(camera: Floats, spans: Floats, width_px: float) -> Floats:
    """Image of each piece of a line `width_px` wide, shape (n, 4): middle u, v, length, and width with defocus, px.

    Widths are standard deviations; `camera` is CameraTruth.packed.
    """
    out = np.empty((spans.shape[0], 4))
    for i in range(spans.shape[0]):
        ua, va = project(camera, spans[i, 0], spans[i, 1], spans[i, 2])
        ub, vb = project(camera, spans[i, 3], spans[i, 4], spans[i, 5])
        out[i, 0], out[i, 1] = 0.5 * (ua + ub), 0.5 * (va + vb)
        out[i, 2] = math.sqrt((ub - ua) ** 2 + (vb - va) ** 2)
        far_mm = camera[17] * spans[i, 0] + camera[18] * spans[i, 1] + camera[19] * spans[i, 2] + camera[20]
        blur_px = camera[21] * (1.0 - camera[22] / far_mm)
        out[i, 3] = math.sqrt(width_px**2 + blur_px**2)
    return out


@numba.njit(cache=True, nogil=True)
def splat(
    pieces: Floats, brightness: Floats, width_px: float, image: NDArray[np.float32], touched: NDArray[np.int64]
) -> None:
    """Add a line of Gaussian cross section to `image` (rows, columns).

    `pieces` (n, 4) are `images`; where their width is `width_px`, the line's crest is `brightness`, and wider pieces
    spread the same light. `touched` (rows, 2) gets the first column and the one after the last that are not dark.
    """
    rows, columns = image.shape
    reach = 0.0
    for i in range(pieces.shape[0]):
        reach = max(reach, pieces[i, 3])
    room = 2 * math.ceil(4.5 * reach) + 1
    across, down = np.empty(room), np.empty(room)
    for i in range(pieces.shape[0]):
        if brightness[i] <= 0.0:
            continue
        u, v, sigma_px = pieces[i, 0], pieces[i, 1], pieces[i, 3]
        half = math.ceil(4.5 * sigma_px)
        c, r = round(u), round(v)
        if c + half < 0 or r + half < 0 or c - half >= columns or r - half >= rows:
            continue
        for k in range(-half, half + 1):
            across[k + half] = math.exp(-0.5 * ((c + k - u) / sigma_px) ** 2)
            down[k + half] = math.exp(-0.5 * ((r + k - v) / sigma_px) ** 2)
        weight = brightness[i] * pieces[i, 2] * width_px / (sigma_px * sigma_px * math.sqrt(2 * math.pi))
        lo, hi = max(0, c - half), min(columns, c + half + 1)
        for row in range(max(0, r - half), min(rows, r + half + 1)):
            gain = np.float32(weight * down[row - r + half])
            touched[row, 0] = min(touched[row, 0], lo)
            touched[row, 1] = max(touched[row, 1], hi)
            for column in range(lo, hi):
                image[row, column] += gain * np.float32(across[column - c + half])


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
    ground: Floats, glass: Floats, grid: Floats, start: Floats, head: Floats, eye: Floats, top_mm: float
) -> bool:
    return trace(ground, glass, grid, start, head, top_mm) >= 0 and trace(ground, glass, grid, start, eye, top_mm) >= 0


@numba.njit(cache=True, nogil=True)
def _drop(field: Floats, cell_mm: float, ix: int, iy: int, side_x: int, side_y: int) -> float:
    """How far it goes down at a cell's edge, on that side."""
    half_mm = 0.5 * cell_mm
    here = plane_at(field, ix, iy, side_x * half_mm, side_y * half_mm)
    return here - plane_at(field, ix + side_x, iy + side_y, -side_x * half_mm, -side_y * half_mm)


@numba.njit(cache=True, nogil=True)
def glints(
    ground: Floats,
    glass: Floats,
    material: NDArray[np.uint8],
    grid: Floats,
    plane: Floats,
    head: Floats,
    eye: Floats,
    edge: Floats,
    shines: Floats,
    line_mm: float,
    top_mm: float,
) -> tuple[Floats, Floats, Floats]:
    """What shines where the laser meets worn edges and the glass's own surface.

    `edge` is the strength of a worn edge by material, `shines` is the glass's haze, mirror strength and its exponent,
    `line_mm` the standard deviation of the laser line's width.

    Returns
    -------
    spans
        Their two ends in mm, shape (n, 6).
    brightness
        Shape (n,), in terms of white under the line's crest.
    width
        Standard deviation in mm across the span, shape (n,).
    """
    rows, columns = ground.shape[0], ground.shape[1]
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
            z, kind = glass[iy, ix, HEIGHT], material_at(material, ix, iy)
            rise_x, rise_y = glass[iy, ix, RISE_X], glass[iy, ix, RISE_Y]
            x_left, y_low = grid[0] + ix * grid[2], grid[1] + iy * grid[2]
            if rise_x != 0.0:
                z += rise_x * min(max(x_low - x_left - 0.5 * grid[2], -0.5 * grid[2]), 0.5 * grid[2])
            x_plane = x_low - plane[2] / plane[0] * z
            start[2] = z + OFF_MM
            crossed = cell_of(x_plane, grid[0], grid[2]) == ix
            if crossed and kind == GLASS and shines[0] + shines[1] > 0:
                start[0], start[1] = x_plane, y
                lx, ly, lz = head[0] - x_plane, head[1] - y, head[2] - z
                ex, ey, ez = eye[0] - x_plane, eye[1] - y, eye[2] - z
                l_mm, e_mm = math.sqrt(lx * lx + ly * ly + lz * lz), math.sqrt(ex * ex + ey * ey + ez * ez)
                hx, hy, hz = lx / l_mm + ex / e_mm, ly / l_mm + ey / e_mm, lz / l_mm + ez / e_mm
                norm = math.sqrt(1.0 + rise_x * rise_x + rise_y * rise_y)
                half = (hz - rise_x * hx - rise_y * hy) / (norm * math.sqrt(hx * hx + hy * hy + hz * hz))
                upright = (lz - rise_x * lx - rise_y * ly) / norm
                fresnel = 0.04 + 0.96 * (1 - upright / l_mm) ** 5
                shine = shines[0] * upright / l_mm + fresnel * shines[1] * max(half, 0.0) ** shines[2]
                if shine > 0 and _clear(ground, glass, grid, start, head, eye, top_mm):
                    half_mm = 0.5 * grid[2] * rise_y
                    spans[n, 0], spans[n, 1], spans[n, 2] = x_plane, y_low, z - half_mm
                    spans[n, 3], spans[n, 4], spans[n, 5] = x_plane, y_low + grid[2], z + half_mm
                    brightness[n], width[n] = shine * head[2] / l_mm, line_mm
                    n += 1
            if edge[kind] <= 0:
                continue
            for side in (-1, 1):
                if crossed and _drop(glass, grid[2], ix, iy, 0, side) > STEP_MM:
                    y_edge = y + 0.5 * side * grid[2]
                    start[0], start[1] = x_plane, y_edge - side * OFF_MM
                    shine = edge[kind] * _chips(ix, iy) * _bevel(0.0, side, x_plane, y_edge, z, head, eye)
                    if _clear(ground, glass, grid, start, head, eye, top_mm):
                        spans[n, 0], spans[n, 1], spans[n, 2] = x_plane, y_edge - 0.5 * BEVEL_MM, z
                        spans[n, 3], spans[n, 4], spans[n, 5] = x_plane, y_edge + 0.5 * BEVEL_MM, z
                        brightness[n], width[n] = shine, line_mm
                        n += 1
                if _drop(glass, grid[2], ix, iy, side, 0) > STEP_MM:
                    x_edge = x_left + (grid[2] if side > 0 else 0.0)
                    off = (x_edge - x_plane) / line_mm
                    if abs(off) > 3:
                        continue
                    start[0], start[1] = x_edge - side * OFF_MM, y
                    shine = edge[kind] * _chips(ix, iy) * _bevel(side, 0.0, x_edge, y, z, head, eye)
                    if _clear(ground, glass, grid, start, head, eye, top_mm):
                        for k in range(PIECES):
                            spans[n, 0], spans[n, 1], spans[n, 2] = x_edge, y_low + k * grid[2] / PIECES, z
                            spans[n, 3], spans[n, 4], spans[n, 5] = x_edge, y_low + (k + 1) * grid[2] / PIECES, z
                            brightness[n], width[n] = shine * math.exp(-0.5 * off * off), BEVEL_MM / math.sqrt(12.0)
                            n += 1
    return spans[:n], brightness[:n], width[:n]


@numba.njit(cache=True, nogil=True)
def _wall(ground: Floats, grid: Floats, x: float, iy: int, z: float, side: int) -> tuple[float, float, int]:
    """The nearest wall beside (x, z): distance, height above z (0: none), and the column of the cell behind it."""
    here = cell_of(x, grid[0], grid[2])
    for k in range(1, math.ceil(REACH_MM / grid[2]) + 1):
        ix = here + side * k
        rise = height_at(ground, ix, iy) - z
        sloping = _tilts(ground, ix, iy) or _tilts(ground, ix - side, iy)
        if sloping and -_drop(ground, grid[2], ix - side, iy, side, 0) < STEP_MM:
            continue
        if 0 <= ix < ground.shape[1] and 0 <= iy < ground.shape[0] and ground[iy, ix, UNDER] > z + STEP_MM:
            continue
        if rise > STEP_MM:
            face = grid[0] + (ix + (0 if side > 0 else 1)) * grid[2]
            return abs(face - x), rise, ix
        if rise < -STEP_MM:
            break
    return 0.0, 0.0, 0


@numba.njit(cache=True, nogil=True)
def second_stripes(
    ground: Floats,
    glass: Floats,
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
            far_mm, rise_mm, ix = _wall(ground, grid, x, iy, z, side)
            face = x + side * far_mm
            if rise_mm <= 0 or (eye[0] - face) * side >= 0:
                continue
            start[0], start[1], start[2] = x, y, z + OFF_MM
            if trace(ground, glass, grid, start, head, top_mm) < 0:
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
                if trace(ground, glass, grid, start, eye, top_mm) >= 0:
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
                    if trace(ground, glass, grid, start, eye, top_mm) >= 0:
                        out[n, 0], out[n, 1], out[n, 2] = image, y - half_mm, z
                        out[n, 3], out[n, 4], out[n, 5] = image, y + half_mm, z
                        brightness[n], width[n] = lit * wall[2], line_mm
                        n += 1
    return out[:n], brightness[:n], width[:n]


@numba.njit(cache=True, nogil=True)
def bend(
    ground: Floats,
    glass: Floats,
    grid: Floats,
    spans: Floats,
    brightness: Floats,
    head: Floats,
    eye: Floats,
    index: float,
    top_mm: float,
) -> tuple[Floats, Floats]:
    """Where refraction by glass plates lets each piece lie, and where the camera sees it, both shaped as `spans`.

    The laser's way is bent on its way in: the piece slides along the level; then the glass seems to raise it.
    """
    landed, seen = spans.copy(), spans.copy()
    start, into, out = np.empty(3), np.empty(3), np.empty(3)
    for i in range(spans.shape[0]):
        if brightness[i] <= 0.0:
            continue
        for k in range(3):
            start[k] = 0.5 * (spans[i, k] + spans[i, k + 3])
        start[2] += OFF_MM
        into[:], out[:] = 0.0, 0.0
        march(ground, glass, grid, start, head, top_mm, index, into)
        march(ground, glass, grid, start, eye, top_mm, index, out)
        along = into[2] / (head[2] - start[2])
        for k in range(3):
            slid = along * (head[k] - start[k]) - into[k]
            for j in (k, k + 3):
                landed[i, j] = spans[i, j] + slid
                seen[i, j] = landed[i, j] + out[k]
    return landed, seen


@numba.njit(cache=True, nogil=True)
def _reflected_hit(ground: Floats, grid: Floats, start: Floats, way: Floats, top_mm: float, hit: Floats) -> int:
    """Follow a way from a mirror to what it meets: its point in `hit`; 0: a top, -1, 1, -2, 2: a side along x or y."""
    step = 0.25 * grid[2]
    ix, iy = cell_of(start[0], grid[0], grid[2]), cell_of(start[1], grid[1], grid[2])
    reach = grid[2] * (ground.shape[0] + ground.shape[1])
    for n in range(1, int(reach / step)):
        for k in range(3):
            hit[k] = start[k] + n * step * way[k]
        if hit[2] > top_mm or hit[2] < -1e3:
            return 9
        jx, jy = cell_of(hit[0], grid[0], grid[2]), cell_of(hit[1], grid[1], grid[2])
        off_x, off_y = hit[0] - (grid[0] + (jx + 0.5) * grid[2]), hit[1] - (grid[1] + (jy + 0.5) * grid[2])
        if hit[2] < plane_at(ground, jx, jy, off_x, off_y):
            for k in range(3):
                hit[k] -= step * way[k]
            if jx != ix and height_at(ground, jx, jy) > hit[2]:
                return -1 if jx > ix else 1
            if jy != iy and height_at(ground, jx, jy) > hit[2]:
                return -2 if jy > iy else 2
            return 0
        ix, iy = jx, jy
    return 9


@numba.njit(cache=True, nogil=True)
def thrown(
    ground: Floats,
    glass: Floats,
    material: NDArray[np.uint8],
    grid: Floats,
    spans: Floats,
    kinds: Ids,
    head: Floats,
    eye: Floats,
    albedo: Floats,
    line_mm: float,
    top_mm: float,
) -> tuple[Floats, Floats, Floats]:
    """What mirrors throw the stripe onto: spans, brightness and width as of `glints`; `albedo` by material."""
    out = np.empty((len(spans), 6))
    brightness, width = np.empty(len(spans)), np.full(len(spans), line_mm)
    start, way, hit = np.empty(3), np.empty(3), np.empty(3)
    n = 0
    for i in range(len(spans)):
        if kinds[i, 0] != TOP or kinds[i, 2] != MIRROR:
            continue
        for k in range(3):
            start[k] = 0.5 * (spans[i, k] + spans[i, k + 3])
        ix, iy = cell_of(start[0], grid[0], grid[2]), cell_of(start[1], grid[1], grid[2])
        start[2] += OFF_MM
        if trace(ground, glass, grid, start, head, top_mm) < 0:
            continue
        nz = 1.0 / math.sqrt(1.0 + ground[iy, ix, RISE_X] ** 2 + ground[iy, ix, RISE_Y] ** 2)
        nx, ny = -ground[iy, ix, RISE_X] * nz, -ground[iy, ix, RISE_Y] * nz
        for k in range(3):
            way[k] = start[k] - head[k]
        l_mm = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
        towards = 2.0 * (way[0] * nx + way[1] * ny + way[2] * nz)
        way[0], way[1], way[2] = way[0] - towards * nx, way[1] - towards * ny, way[2] - towards * nz
        for k in range(3):
            way[k] /= l_mm
        side = _reflected_hit(ground, grid, start, way, top_mm, hit)
        if side == 9 or trace(ground, glass, grid, hit, eye, top_mm) < 0:
            continue
        cosine = abs(way[2]) if side == 0 else (abs(way[0]) if abs(side) == 1 else abs(way[1]))
        jx, jy = cell_of(hit[0] + 0.5 * way[0], grid[0], grid[2]), cell_of(hit[1] + 0.5 * way[1], grid[1], grid[2])
        far_mm = l_mm + math.sqrt((hit[0] - start[0]) ** 2 + (hit[1] - start[1]) ** 2 + (hit[2] - start[2]) ** 2)
        half_mm = 0.5 * (spans[i, 4] - spans[i, 1])
        out[n, 0], out[n, 1], out[n, 2] = hit[0], hit[1] - half_mm, hit[2]
        out[n, 3], out[n, 4], out[n, 5] = hit[0], hit[1] + half_mm, hit[2]
        brightness[n] = albedo[material_at(material, jx, jy)] * cosine * head[2] / far_mm
        n += 1
    return out[:n], brightness[:n], width[:n]


@numba.njit(cache=True, nogil=True)
def mirrored(
    ground: Floats,
    glass: Floats,
    material: NDArray[np.uint8],
    grid: Floats,
    mirrors: Floats,
    spans: Floats,
    shine: Floats,
    head: Floats,
    eye: Floats,
    line_mm: float,
    top_mm: float,
) -> tuple[Floats, Floats, Floats]:
    """The stripe as the camera sees it in mirrors, behind them: spans, brightness and width as of `glints`.

    `mirrors` (m, 4) are the planes n.X = c of the mirrors; `shine` is what each span would show to an eye there.
    """
    out = np.empty((len(mirrors) * len(spans), 6))
    brightness, width = np.empty(len(out)), np.full(len(out), line_mm)
    lit, spot = np.empty(3), np.empty(3)
    n = 0
    for m in range(len(mirrors)):
        normal = mirrors[m]
        for i in range(len(spans)):
            if shine[i] <= 0.0:
                continue
            for k in range(3):
                lit[k] = 0.5 * (spans[i, k] + spans[i, k + 3])
            lit[2] += OFF_MM
            above = normal[0] * lit[0] + normal[1] * lit[1] + normal[2] * lit[2] - normal[3]
            eye_above = normal[0] * eye[0] + normal[1] * eye[1] + normal[2] * eye[2] - normal[3]
            if above < STEP_MM:
                continue
            t = above / (above + eye_above)
            for k in range(3):
                behind = lit[k] - 2.0 * above * normal[k]
                spot[k] = behind + t * (eye[k] - behind)
            jx, jy = cell_of(spot[0], grid[0], grid[2]), cell_of(spot[1], grid[1], grid[2])
            if material_at(material, jx, jy) != MIRROR:
                continue
            off_x = spot[0] - (grid[0] + (jx + 0.5) * grid[2])
            off_y = spot[1] - (grid[1] + (jy + 0.5) * grid[2])
            if abs(plane_at(ground, jx, jy, off_x, off_y) - spot[2]) > 0.05:
                continue
            spot[2] += OFF_MM
            if lit[2] <= spot[2] or trace(ground, glass, grid, spot, lit, top_mm) < 0:
                continue
            if trace(ground, glass, grid, spot, eye, top_mm) < 0:
                continue
            for j in range(6):
                end = spans[i, j]
                low = 3 * (j // 3)
                off = normal[0] * spans[i, low] + normal[1] * spans[i, low + 1] + normal[2] * spans[i, low + 2]
                out[n, j] = end - 2.0 * (off - normal[3]) * normal[j - low]
            brightness[n] = shine[i]
            n += 1
    return out[:n], brightness[:n], width[:n]


@numba.njit(cache=True, nogil=True)
def veil(
    ground: Floats,
    glass: Floats,
    grid: Floats,
    plane: Floats,
    rays: Floats,
    to_rig: Floats,
    head: Floats,
    eye: Floats,
    fan: tuple[float, float],
    smoke: float,
    line_mm: float,
    top_mm: float,
) -> NDArray[np.float32]:
    """The lit sheet in smoke as each pixel sees it (rows, columns), in terms of white under the line's crest.

    `rays` (rows, columns, 2) are x/z and y/z of each pixel, `to_rig` (3, 3) turns the camera's directions; `fan` are
    the sheet's ends along y at z = 0; `smoke` is the extinction in 1/mm. All of it scatters evenly.

    Notes
    -----
    A white surface that is lit with E shows E / pi; a sheet of thickness w, crossed at the angle of the normal's
    cosine c, shows E smoke w / (4 pi c).
    """
    rows, columns = rays.shape[0], rays.shape[1]
    out = np.zeros((rows, columns), dtype=np.float32)
    spot, way = np.empty(3), np.empty(3)
    free = True
    eye_off = plane[3] - (plane[0] * eye[0] + plane[1] * eye[1] + plane[2] * eye[2])
    sheet_mm = line_mm * math.sqrt(2.0 * math.pi)
    for row in range(rows):
        free_column = -4
        for column in range(columns):
            a, b = rays[row, column, 0], rays[row, column, 1]
            for k in range(3):
                way[k] = to_rig[k, 0] * a + to_rig[k, 1] * b + to_rig[k, 2]
            towards = plane[0] * way[0] + plane[1] * way[1] + plane[2] * way[2]
            t = eye_off / towards
            if not t > 0.0:
                continue
            for k in range(3):
                spot[k] = eye[k] + t * way[k]
            if spot[2] <= 0.0 or spot[2] >= head[2]:
                continue
            left = (head[2] - spot[2]) / head[2]
            if not fan[0] * left < spot[1] - head[1] * (1 - left) < fan[1] * left:
                continue
            if spot[2] < top_mm:
                # what is in the way changes slowly, and the veil is faint
                if column - free_column >= 4:
                    free, free_column = _clear(ground, glass, grid, spot, head, eye, top_mm), column
                if not free:
                    continue
            l_mm = math.sqrt((head[0] - spot[0]) ** 2 + (head[1] - spot[1]) ** 2 + (head[2] - spot[2]) ** 2)
            length = math.sqrt(way[0] ** 2 + way[1] ** 2 + way[2] ** 2)
            cosine = abs(towards) / length
            shown = smoke * sheet_mm / (4.0 * cosine) * head[2] / l_mm
            out[row, column] = shown * math.exp(-smoke * (l_mm + t * length))
    return out
