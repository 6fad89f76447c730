"""Facets of a heightfield as sound sees it: horizontal and tilted ones, merged where it is flat, and vertical walls."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.scene import Scene

MERGE = 4
"""Largest facet in the field, in cells; its aperture is integrated exactly to second order."""
BENCH_FACET_MM = 4.0
BENCH_MM = 344.0
"""The bench goes on this far at z = 0."""
WALL_MM = 0.05
"""Smaller steps have no wall."""
WALL_SLICE_MM = 3.0

NO_FLOOR_MM = -1e6
"""Floor of a wall that no level floor meets: nothing bounces twice there."""
SAME_PLANE_MM = 1e-9

HORIZONTAL, WALL_X, WALL_Y = 0, 1, 2


@dataclass(frozen=True)
class Facets:
    """Facets with their centre, kind, side of the normal, size and the floor at a wall's foot."""

    centre_mm: NDArray[np.float64]  # (m, 3)
    kind: NDArray[np.int8]  # (m,) HORIZONTAL: along x, y; WALL_X: along y, z; WALL_Y: along x, z
    sign: NDArray[np.float64]  # (m,) of the normal
    size_mm: NDArray[np.float64]  # (m, 2) along the facet's two directions
    floor_mm: NDArray[np.float64]  # (m,)
    tilted: NDArray[np.float64]
    """Tilted facets apart, shape (k, 6): x, y, z, size seen from above, dz/dx, dz/dy."""


def _blocks(image: NDArray[np.float64] | NDArray[np.bool_], n: int) -> NDArray[np.float64] | NDArray[np.bool_]:
    """Blocks of n x n cells, shape (rows / n, n, columns / n, n)."""
    rows, columns = image.shape[0] // n, image.shape[1] // n
    return image[: rows * n, : columns * n].reshape(rows, n, columns, n)


def _flat(heights: NDArray[np.float64], n: int) -> NDArray[np.bool_]:
    return np.ptp(_blocks(heights, n), axis=(1, 3)) == 0


def _taken(free: NDArray[np.bool_], usable: NDArray[np.bool_], n: int) -> NDArray[np.bool_]:
    """Which blocks are usable and wholly free; they are taken."""
    usable = usable & _blocks(free, n).all(axis=(1, 3))
    free[: usable.shape[0] * n, : usable.shape[1] * n] &= ~np.repeat(np.repeat(usable, n, axis=0), n, axis=1)
    return usable


def _tilts(scene: Scene) -> NDArray[np.bool_]:
    """Cells that are not level."""
    if scene.front_slope is None:
        return np.zeros(scene.front_mm.shape, dtype=np.bool_)
    return np.any(scene.front_slope != 0, axis=2)


def _horizontal(scene: Scene) -> NDArray[np.float64]:
    """Rows x, y, z, size of square facets, merged to 4 x 4 and 2 x 2 cells where it is flat."""
    heights, cell = scene.front_mm, scene.cell_mm
    free = ~_tilts(scene)
    rows: list[NDArray[np.float64]] = []
    for n in (MERGE, MERGE // 2, 1):
        j, i = np.nonzero(_taken(free, _flat(heights, n), n))
        z = heights[j * n, i * n]
        x, y = scene.x0_mm + (i + 0.5) * n * cell, scene.y0_mm + (j + 0.5) * n * cell
        rows.append(np.stack([x, y, z, np.full(len(x), n * cell)], axis=1))
    return np.concatenate(rows)


def _tilted(scene: Scene) -> NDArray[np.float64]:
    """Rows x, y, z, size, dz/dx, dz/dy of tilted facets, merged likewise where they lie in one plane."""
    free, cell = _tilts(scene), scene.cell_mm
    if scene.front_slope is None or not free.any():
        return np.zeros((0, 6))
    slope_x, slope_y = scene.front_slope[..., 0], scene.front_slope[..., 1]
    at_x, at_y = np.arange(free.shape[1]) * cell, np.arange(free.shape[0])[:, None] * cell
    rows: list[NDArray[np.float64]] = []
    for n in (MERGE, MERGE // 2, 1):
        # heights less the plane of each cell's block
        first = [np.repeat(np.repeat(_blocks(s, n)[:, 0, :, 0], n, axis=0), n, axis=1) for s in (slope_x, slope_y)]
        span = first[0].shape
        over = scene.front_mm[: span[0], : span[1]] - first[0] * at_x[: span[1]] - first[1] * at_y[: span[0]]
        flat = np.ptp(_blocks(over, n), axis=(1, 3)) < SAME_PLANE_MM
        for image in (slope_x, slope_y):
            flat &= np.ptp(_blocks(image, n), axis=(1, 3)) < SAME_PLANE_MM
        j, i = np.nonzero(_taken(free, flat, n))
        z = _blocks(scene.front_mm, n).mean(axis=(1, 3))[j, i]
        x, y = scene.x0_mm + (i + 0.5) * n * cell, scene.y0_mm + (j + 0.5) * n * cell
        size = np.full(len(x), n * cell)
        rows.append(np.stack([x, y, z, size, slope_x[j * n, i * n], slope_y[j * n, i * n]], axis=1))
    return np.concatenate(rows)


def _bench(scene: Scene) -> NDArray[np.float64]:
    """Bench facets around the field, rows x, y, z = 0, width, depth; frames the field without overlap."""
    x0, y0 = scene.x0_mm, scene.y0_mm
    x1 = x0 + scene.front_mm.shape[1] * scene.cell_mm
    y1 = y0 + scene.front_mm.shape[0] * scene.cell_mm

    def cuts(low: float, high: float) -> NDArray[np.float64]:
        parts = [(-BENCH_MM, low), (low, high), (high, BENCH_MM)]
        edges = [np.linspace(a, b, max(1, round((b - a) / BENCH_FACET_MM)) + 1)[:-1] for a, b in parts]
        return np.append(np.concatenate(edges), BENCH_MM)

    xe, ye = cuts(x0, x1), cuts(y0, y1)
    xc, yc = (xe[1:] + xe[:-1]) / 2, (ye[1:] + ye[:-1]) / 2
    x, y = (a.ravel() for a in np.meshgrid(xc, yc))
    w, d = (a.ravel() for a in np.meshgrid(np.diff(xe), np.diff(ye)))
    outside = ~((x > x0) & (x < x1) & (y > y0) & (y < y1))
    return np.stack([x, y, np.zeros_like(x), w, d], axis=1)[outside]


@dataclass(frozen=True)
class _Steps:
    """Both sides of each boundary between columns, all of shape (rows, columns + 1)."""

    left: NDArray[np.float64]
    right: NDArray[np.float64]
    foot: NDArray[np.float64]
    """Where the wall begins: at the lower side, or at the underside of the higher one."""
    floor: NDArray[np.float64]


def _steps(scene: Scene, *, across: bool) -> _Steps:
    """The steps of a scene's front between columns; with `across`, between rows."""

    def columns(image: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.ascontiguousarray(image.T) if across else image

    heights = columns(scene.front_mm)
    slope = np.zeros(heights.shape)
    tilts = columns(_tilts(scene).astype(np.float64)) > 0
    if scene.front_slope is not None:
        slope = columns(scene.front_slope[..., 1 if across else 0])
    rise = 0.5 * scene.cell_mm * slope
    end, begin = ((0, 0), (1, 0)), ((0, 0), (0, 1))
    left, right = np.pad(heights + rise, end), np.pad(heights - rise, begin)
    low = np.minimum(left, right)
    foot, floor = low, low
    if scene.underside_mm is not None:
        under = columns(scene.underside_mm)
        below = np.where(left > right, np.pad(under + rise, end), np.pad(under - rise, begin))
        foot = np.maximum(low, below)
    if tilts.any():
        uneven = np.where(left > right, np.pad(tilts, begin), np.pad(tilts, end))
        floor = np.where(uneven, NO_FLOOR_MM, low)
    return _Steps(left, right, foot, floor)


def _walls(steps: _Steps, cell: float, merge: int) -> NDArray[np.float64]:
    """Walls between columns; rows: boundary index, centre along it, z, sign, length, slice height, floor."""
    rows: list[tuple[float, ...]] = []
    left_mm, right_mm, foot_mm, floor_mm = steps.left, steps.right, steps.foot, steps.floor
    n_rows = left_mm.shape[0]
    high_mm = np.maximum(left_mm, right_mm)
    step = (np.abs(right_mm - left_mm) > WALL_MM) & (high_mm - foot_mm > WALL_MM)  # (rows, columns + 1)
    same = np.zeros(step.shape, dtype=np.bool_)
    same[1:] = (left_mm[1:] == left_mm[:-1]) & (right_mm[1:] == right_mm[:-1]) & (foot_mm[1:] == foot_mm[:-1])
    for b in np.nonzero(step.any(axis=0))[0].tolist():
        j = 0
        while j < n_rows:
            end = j + 1
            if step[j, b]:
                while end < n_rows and end - j < merge and same[end, b]:
                    end += 1
                low, high = float(foot_mm[j, b]), float(high_mm[j, b])
                slices = max(1, int(np.ceil((high - low) / WALL_SLICE_MM)))
                tall = (high - low) / slices
                sign, floor = (1.0 if left_mm[j, b] > right_mm[j, b] else -1.0), float(floor_mm[j, b])
                rows.extend(
                    (b * cell, (j + end) / 2 * cell, low + (s + 0.5) * tall, sign, (end - j) * cell, tall, floor)
                    for s in range(slices)
                )
            j = end
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def build_facets(scene: Scene) -> Facets:
    """Cut a scene's `front_mm`, the bench around it and all its walls into facets."""
    top, bench = _horizontal(scene), _bench(scene)
    wx = _walls(_steps(scene, across=False), scene.cell_mm, MERGE)
    wy = _walls(_steps(scene, across=True), scene.cell_mm, MERGE)
    x0, y0 = scene.x0_mm, scene.y0_mm
    centre = [
        top[:, :3],
        bench[:, :3],
        np.stack([x0 + wx[:, 0], y0 + wx[:, 1], wx[:, 2]], axis=1),
        np.stack([x0 + wy[:, 1], y0 + wy[:, 0], wy[:, 2]], axis=1),
    ]
    flat = np.ones(len(top) + len(bench))
    return Facets(
        centre_mm=np.concatenate(centre),
        kind=np.repeat(np.array([HORIZONTAL, WALL_X, WALL_Y], dtype=np.int8), [len(flat), len(wx), len(wy)]),
        sign=np.concatenate([flat, wx[:, 3], wy[:, 3]]),
        size_mm=np.concatenate([top[:, [3, 3]], bench[:, 3:], wx[:, 4:6], wy[:, 4:6]]),
        floor_mm=np.concatenate([0 * flat, wx[:, 6], wy[:, 6]]),
        tilted=_tilted(scene),
    )
