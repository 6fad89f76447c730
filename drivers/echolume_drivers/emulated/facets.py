"""Facets of a heightfield as sound sees it: horizontal ones, merged where it is flat, and vertical walls."""

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

HORIZONTAL, WALL_X, WALL_Y = 0, 1, 2


@dataclass(frozen=True)
class Facets:
    """Facets with their centre, kind, side of the normal, size and the floor at a wall's foot."""

    centre_mm: NDArray[np.float64]  # (m, 3)
    kind: NDArray[np.int8]  # (m,) HORIZONTAL: along x, y; WALL_X: along y, z; WALL_Y: along x, z
    sign: NDArray[np.float64]  # (m,) of the normal
    size_mm: NDArray[np.float64]  # (m, 2) along the facet's two directions
    floor_mm: NDArray[np.float64]  # (m,)


def _flat(heights: NDArray[np.float64], n: int) -> NDArray[np.bool_]:
    rows, columns = heights.shape[0] // n, heights.shape[1] // n
    blocks = heights[: rows * n, : columns * n].reshape(rows, n, columns, n)
    return np.ptp(blocks, axis=(1, 3)) == 0


def _horizontal(scene: Scene) -> NDArray[np.float64]:
    """Rows x, y, z, size of square facets, merged to 4 x 4 and 2 x 2 cells where it is flat."""
    heights, cell = scene.front_mm, scene.cell_mm
    free = np.ones(heights.shape, dtype=bool)
    rows: list[NDArray[np.float64]] = []
    for n in (MERGE, MERGE // 2, 1):
        usable = _flat(heights, n)
        span = (usable.shape[0] * n, usable.shape[1] * n)
        usable &= free[: span[0], : span[1]].reshape(usable.shape[0], n, usable.shape[1], n).all(axis=(1, 3))
        j, i = np.nonzero(usable)
        z = heights[j * n, i * n]
        x, y = scene.x0_mm + (i + 0.5) * n * cell, scene.y0_mm + (j + 0.5) * n * cell
        rows.append(np.stack([x, y, z, np.full(len(x), n * cell)], axis=1))
        free[: span[0], : span[1]] &= ~np.repeat(np.repeat(usable, n, axis=0), n, axis=1)
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


def _walls(heights: NDArray[np.float64], cell: float, merge: int) -> NDArray[np.float64]:
    """Walls between columns; rows: boundary index, centre along it, z, sign, length, slice height, floor."""
    rows: list[tuple[float, ...]] = []
    n_rows = heights.shape[0]
    padded = np.pad(heights, ((0, 0), (1, 1)))
    step = np.abs(np.diff(padded, axis=1)) > WALL_MM  # (rows, columns + 1)
    for b in np.nonzero(step.any(axis=0))[0].tolist():
        j = 0
        while j < n_rows:
            left, right = float(padded[j, b]), float(padded[j, b + 1])
            end = j + 1
            if step[j, b]:
                while end < n_rows and end - j < merge and padded[end, b] == left and padded[end, b + 1] == right:
                    end += 1
                low, high = min(left, right), max(left, right)
                slices = max(1, int(np.ceil((high - low) / WALL_SLICE_MM)))
                tall = (high - low) / slices
                rows.extend(
                    (b * cell, (j + end) / 2 * cell, low + (s + 0.5) * tall, 1.0 if left > right else -1.0,
                     (end - j) * cell, tall, low)
                    for s in range(slices)
                )  # fmt: skip
            j = end
    return np.array(rows, dtype=np.float64).reshape(-1, 7)


def build_facets(scene: Scene) -> Facets:
    """Cut a scene's `front_mm`, the bench around it and all its walls into facets."""
    top, bench = _horizontal(scene), _bench(scene)
    wx = _walls(scene.front_mm, scene.cell_mm, MERGE)
    wy = _walls(np.ascontiguousarray(scene.front_mm.T), scene.cell_mm, MERGE)
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
    )
