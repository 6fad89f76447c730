"""Kirchhoff integral over facets into a time history per receiver and frequency band (numba).

The scattered pressure of a rigid facet is 2 p_in dG/dn dS. Its delta in time is spread over two bins of an
oversampled history; directivity and the facet's aperture are taken at a few bands. A wall sees the array and the
array's image in the floor at its foot: direct, floor-wall, wall-floor and floor-wall-floor.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit  # pyright: ignore[reportAttributeAccessIssue]
from numpy.typing import NDArray

BANDS = 5
"""Bands of the history; the loops over them are unrolled."""
WAY, COSINE, LIT, ALONG_U, ALONG_V, SPREAD, BEAM = range(7)
"""How an element sees a facet: distance, cosine, visible share, direction in the facet, longer way, BANDS of beam."""
OBSTACLE_MM = 0.3
"""An obstacle must rise this far above a facet to count."""
STRIDE = 5
"""Cells that a ray steps over where all is low."""
DARK = -3.0
"""Hidden by so many Fresnel radii, a facet adds nothing."""


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _ground(heights: NDArray[np.float64], x0: float, y0: float, cell: float, x: float, y: float) -> float:
    i, j = math.floor((x - x0) / cell), math.floor((y - y0) / cell)
    return heights[j, i] if 0 <= i < heights.shape[1] and 0 <= j < heights.shape[0] else 0.0


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def clearance(
    heights: NDArray[np.float64],
    near: NDArray[np.float64],
    x0: float,
    y0: float,
    cell: float,
    top: float,
    px: float,
    py: float,
    pz: float,
    qx: float,
    qy: float,
    qz: float,
    wavelength: float,
) -> float:
    """Least clearance of the ray from p up to q over higher terrain, in first-Fresnel radii; negative: hidden.

    `near` is the highest terrain within `STRIDE` cells: where it is low, the ray steps so far at once.
    """
    dx, dy, dz = qx - px, qy - py, qz - pz
    lateral = math.sqrt(dx * dx + dy * dy)
    if dz <= 0 or lateral < 0.5 * cell:
        return 9.0
    length = math.sqrt(lateral * lateral + dz * dz)
    least = 9.0
    steps = int(min(1.0, (top + 4.0 - pz) / dz) * lateral / cell)
    k = 1
    while k <= steps:
        t = k * cell / lateral
        x, y = px + t * dx, py + t * dy
        if _ground(near, x0, y0, cell, x, y) <= pz + OBSTACLE_MM:
            k += STRIDE
            continue
        k += 1
        ground = _ground(heights, x0, y0, cell, x, y)
        if ground > pz + OBSTACLE_MM:
            above = (pz + t * dz - ground) * lateral / length
            radius = math.sqrt(wavelength * length * max(t * (1 - t), 1e-3))
            least = min(least, above / radius)
            if least < DARK:
                break
    return least


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def soft(nu: float) -> float:
    """Amplitude past an edge at `nu` first-Fresnel radii of clearance: half at the edge, fading into the shadow."""
    if nu > 4.0:
        return 1.0
    if nu >= 0.0:
        return 1.0 - 0.5 * math.exp(-3.0 * nu)
    return 0.5 * math.exp(2.0 * nu) if nu > DARK else 0.0


_SINC_STEP = 1 / 64
_SINC_END = 24.0
_SINC = np.sinc(np.arange(0, _SINC_END + 2 * _SINC_STEP, _SINC_STEP) / np.pi)


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _sinc(x: float) -> float:
    at = min(abs(x), _SINC_END) / _SINC_STEP
    n = int(at)
    return _SINC[n] + (at - n) * (_SINC[n + 1] - _SINC[n])


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _floor_free(
    heights: NDArray[np.float64],
    x0: float,
    y0: float,
    cell: float,
    wx: float,
    wy: float,
    wz: float,
    ex: float,
    ey: float,
    ez: float,
    floor: float,
) -> float:
    """Share of the floor between a wall point and its mirror point towards the array that is there and free."""
    t = (wz - floor) / (wz - floor + ez - floor)
    good = 0
    for k in range(1, 6):
        s = t * k / 4.0
        ground = _ground(heights, x0, y0, cell, wx + s * (ex - wx), wy + s * (ey - wy))
        if abs(ground - floor) < OBSTACLE_MM:
            good += 1
        elif ground > floor:
            return 0.0
    return good / 5.0


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _geometry(
    px: float,
    py: float,
    pz: float,
    kind: int,
    sign: float,
    size_u: float,
    size_v: float,
    mirror_mm: float,
    elements: NDArray[np.float64],
    axis: NDArray[np.float64],
    radius: float,
    table: NDArray[np.float32],
    view: NDArray[np.float64],
) -> None:
    """Fill `view` (elements, 6 + BANDS) of one facet: see the column names above.

    Elements are mirrored in the plane z = `mirror_mm` unless it is nan; LIT says only whether the facet faces them.
    """
    last = table.shape[0] - 1
    mirrored = not math.isnan(mirror_mm)
    for e in range(elements.shape[0]):
        qz = 2 * mirror_mm - elements[e, 2] if mirrored else elements[e, 2]
        dx, dy, dz = elements[e, 0] - px, elements[e, 1] - py, qz - pz
        d = math.sqrt(dx * dx + dy * dy + dz * dz)
        normal = dz if kind == 0 else (dx if kind == 1 else dy)
        u = (dy if kind == 1 else dx) / d
        v = (dy if kind == 0 else dz) / d
        ahead = -(dx * axis[0] + dy * axis[1] + (-dz if mirrored else dz) * axis[2]) / d
        view[e, WAY] = d
        view[e, COSINE] = normal * sign / d
        view[e, LIT] = 1.0 if view[e, COSINE] > 0 and ahead > 0 else 0.0
        view[e, ALONG_U], view[e, ALONG_V] = u, v
        # mean longer way over the facet and over the piston, which lie flat, not on a sphere
        facet = (size_u * size_u * (1 - u * u) + size_v * size_v * (1 - v * v)) / 24.0
        view[e, SPREAD] = (facet + radius * radius * (1 + ahead * ahead) / 8.0) / d
        at = max(1.0 - ahead * ahead, 0.0) * last
        n = min(int(at), last - 1)
        for b in range(BANDS):
            view[e, BEAM + b] = table[n, b] + (at - n) * (table[n + 1, b] - table[n, b])


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _deposit(
    source: NDArray[np.float64],
    views: NDArray[np.float64],
    size_u: float,
    size_v: float,
    rough: float,
    fade: float,
    wavenumbers: NDArray[np.float64],
    bin_mm: float,
    start_mm: float,
    history: NDArray[np.float32],
) -> None:
    """Add one facet's echo of the emitter seen as `source` to every receiver in `views`."""
    bins = history.shape[1]
    area = size_u * size_v
    for e in range(1, views.shape[0]):
        view = views[e]
        lit = source[LIT] * view[LIT] * fade
        if lit < 1e-3:
            continue
        way = source[WAY] + view[WAY]
        at = (way + source[SPREAD] + view[SPREAD] - start_mm) / bin_mm
        n = int(at)
        if at < 0 or n + 1 >= bins:
            continue
        oblique = area * (source[COSINE] + view[COSINE]) / 2 + rough
        weight = oblique * lit / (2 * math.pi * source[WAY] * view[WAY])
        u = (source[ALONG_U] + view[ALONG_U]) * size_u / 2
        v = (source[ALONG_V] + view[ALONG_V]) * size_v / 2
        for b in range(BANDS):
            k = wavenumbers[b]
            value = weight * source[BEAM + b] * view[BEAM + b] * _sinc(k * u) * _sinc(k * v)
            history[e - 1, n, b] += value * (1 - (at - n))
            history[e - 1, n + 1, b] += value * (at - n)


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def accumulate(
    centre: NDArray[np.float64],
    kind: NDArray[np.int8],
    sign: NDArray[np.float64],
    size: NDArray[np.float64],
    floor: NDArray[np.float64],
    texture: NDArray[np.float64],
    heights: NDArray[np.float64],
    near: NDArray[np.float64],
    dilated: NDArray[np.float64],
    origin: NDArray[np.float64],
    cell: float,
    elements: NDArray[np.float64],
    axis: NDArray[np.float64],
    table: NDArray[np.float32],
    wavenumbers: NDArray[np.float64],
    radius: float,
    reach: tuple[float, float],
    bin_mm: float,
    start_mm: float,
    history: NDArray[np.float32],
) -> None:
    """Add every facet's echo to `history` (receivers, bins, BANDS).

    `elements` (1 + receivers, 3) are emitter and receivers in the rig frame, `axis` (3,) their direction, `radius`
    that of the pistons, `reach` the lateral distances where facets begin to fade and where they end, all in mm;
    `wavenumbers` (BANDS,) in 1/mm.
    """
    x0, y0 = origin[0], origin[1]
    top = heights.max()
    wavelength = 2 * math.pi / wavenumbers[BANDS // 2]
    ex, ey, ez = elements[0, 0], elements[0, 1], elements[0, 2]
    views = np.empty((2, elements.shape[0], BEAM + BANDS))
    for f in range(centre.shape[0]):
        px, py, pz = centre[f, 0], centre[f, 1], centre[f, 2]
        lateral = math.sqrt((px - ex) ** 2 + (py - ey) ** 2)
        if lateral >= reach[1]:
            continue
        fade = 1.0
        if lateral > reach[0]:
            fade = 0.5 + 0.5 * math.cos(math.pi * (lateral - reach[0]) / (reach[1] - reach[0]))
        wall = kind[f] != 0
        size_u, size_v = size[f, 0], size[f, 1]
        direct, image = views[0], views[1]
        _geometry(px, py, pz, kind[f], sign[f], size_u, size_v, math.nan, elements, axis, radius, table, direct)
        # just outside the wall, so that a ray does not start inside its own column
        mx = px + (0.51 * cell * sign[f] if kind[f] == 1 else 0.0)
        my = py + (0.51 * cell * sign[f] if kind[f] == 2 else 0.0)
        # nothing higher near the facet, nor near its way up: then every element sees it
        open_sky = (
            not wall
            and _ground(dilated, x0, y0, cell, px, py) < pz + OBSTACLE_MM
            and clearance(dilated, dilated, x0, y0, cell, top, px, py, pz, ex, ey, ez, wavelength) > 4.0
        )
        for e in range(elements.shape[0]):
            if direct[e, LIT] > 0 and not open_sky:
                qx, qy, qz = elements[e, 0], elements[e, 1], elements[e, 2]
                direct[e, LIT] = soft(clearance(heights, near, x0, y0, cell, top, mx, my, pz, qx, qy, qz, wavelength))
            if direct[0, LIT] <= 0:
                break
        if direct[0, LIT] <= 0:
            continue
        rough = texture[f] * math.sqrt(size_u * size_v)
        _deposit(direct[0], direct, size_u, size_v, rough, fade, wavenumbers, bin_mm, start_mm, history)
        if wall:
            _geometry(px, py, pz, kind[f], sign[f], size_u, size_v, floor[f], elements, axis, radius, table, image)
            for e in range(elements.shape[0]):
                qx, qy, qz = elements[e, 0], elements[e, 1], elements[e, 2]
                free = _floor_free(heights, x0, y0, cell, mx, my, pz, qx, qy, qz, floor[f])
                image[e, LIT] = min(image[e, LIT], direct[e, LIT]) * free
            _deposit(direct[0], image, size_u, size_v, rough, fade, wavenumbers, bin_mm, start_mm, history)
            _deposit(image[0], direct, size_u, size_v, rough, fade, wavenumbers, bin_mm, start_mm, history)
            _deposit(image[0], image, size_u, size_v, rough, fade, wavenumbers, bin_mm, start_mm, history)


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _clearance_above(
    heights: NDArray[np.float64],
    x0: float,
    y0: float,
    cell: float,
    top: float,
    facet: NDArray[np.float64],
    qx: float,
    qy: float,
    qz: float,
    wavelength: float,
) -> float:
    """As `clearance`, from a tilted facet up to q: only what rises above the facet's own plane is in the way."""
    px, py, pz, rise_x, rise_y = facet[0], facet[1], facet[2], facet[4], facet[5]
    dx, dy, dz = qx - px, qy - py, qz - pz
    lateral = math.sqrt(dx * dx + dy * dy)
    if dz <= 0 or lateral < 0.5 * cell:
        return 9.0
    length = math.sqrt(lateral * lateral + dz * dz)
    least = 9.0
    steps = int(min(1.0, (top + 4.0 - pz) / dz) * lateral / cell)
    for k in range(1, steps + 1):
        t = k * cell / lateral
        ground = _ground(heights, x0, y0, cell, px + t * dx, py + t * dy)
        plane = pz + max(0.0, t * (rise_x * dx + rise_y * dy) + cell * (abs(rise_x) + abs(rise_y)))
        if ground > plane + OBSTACLE_MM:
            above = (pz + t * dz - ground) * lateral / length
            least = min(least, above / math.sqrt(wavelength * length * max(t * (1 - t), 1e-3)))
            if least < DARK:
                break
    return least


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def _tilted_geometry(
    facet: NDArray[np.float64],
    elements: NDArray[np.float64],
    axis: NDArray[np.float64],
    radius: float,
    table: NDArray[np.float32],
    view: NDArray[np.float64],
) -> None:
    """As `_geometry` for a tilted facet; directions, cosine and area are those per area seen from above."""
    last = table.shape[0] - 1
    size, rise_x, rise_y = facet[3], facet[4], facet[5]
    for e in range(elements.shape[0]):
        dx, dy, dz = elements[e, 0] - facet[0], elements[e, 1] - facet[1], elements[e, 2] - facet[2]
        d = math.sqrt(dx * dx + dy * dy + dz * dz)
        u, v = (dx + rise_x * dz) / d, (dy + rise_y * dz) / d
        ahead = -(dx * axis[0] + dy * axis[1] + dz * axis[2]) / d
        view[e, WAY] = d
        view[e, COSINE] = (dz - rise_x * dx - rise_y * dy) / d
        view[e, LIT] = 1.0 if view[e, COSINE] > 0 and ahead > 0 else 0.0
        view[e, ALONG_U], view[e, ALONG_V] = u, v
        flat = size * size * (2 + rise_x * rise_x + rise_y * rise_y - u * u - v * v) / 24.0
        view[e, SPREAD] = (flat + radius * radius * (1 + ahead * ahead) / 8.0) / d
        at = max(1.0 - ahead * ahead, 0.0) * last
        n = min(int(at), last - 1)
        for b in range(BANDS):
            view[e, BEAM + b] = table[n, b] + (at - n) * (table[n + 1, b] - table[n, b])


@njit(cache=True, fastmath={"reassoc", "contract", "arcp", "nsz"})
def accumulate_tilted(
    facets: NDArray[np.float64],
    texture: NDArray[np.float64],
    heights: NDArray[np.float64],
    origin: NDArray[np.float64],
    cell: float,
    elements: NDArray[np.float64],
    axis: NDArray[np.float64],
    table: NDArray[np.float32],
    wavenumbers: NDArray[np.float64],
    radius: float,
    reach: tuple[float, float],
    bin_mm: float,
    start_mm: float,
    history: NDArray[np.float32],
) -> None:
    """As `accumulate` for tilted facets, rows x, y, z, size seen from above, dz/dx, dz/dy; no double bounce."""
    top = heights.max()
    wavelength = 2 * math.pi / wavenumbers[BANDS // 2]
    views = np.empty((elements.shape[0], BEAM + BANDS))
    for f in range(facets.shape[0]):
        facet = facets[f]
        lateral = math.sqrt((facet[0] - elements[0, 0]) ** 2 + (facet[1] - elements[0, 1]) ** 2)
        if lateral >= reach[1]:
            continue
        fade = 1.0
        if lateral > reach[0]:
            fade = 0.5 + 0.5 * math.cos(math.pi * (lateral - reach[0]) / (reach[1] - reach[0]))
        _tilted_geometry(facet, elements, axis, radius, table, views)
        for e in range(elements.shape[0]):
            if views[0, LIT] <= 0:
                break
            if views[e, LIT] > 0:
                qx, qy, qz = elements[e, 0], elements[e, 1], elements[e, 2]
                views[e, LIT] = soft(
                    _clearance_above(heights, origin[0], origin[1], cell, top, facet, qx, qy, qz, wavelength)
                )
        if views[0, LIT] <= 0:
            continue
        size = facet[3]
        _deposit(views[0], views, size, size, texture[f] * size, fade, wavenumbers, bin_mm, start_mm, history)
