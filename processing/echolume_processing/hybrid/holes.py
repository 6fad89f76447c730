"""Where light returned nothing: shadows, surfaces that swallow light, and what closes the holes for prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.spatial import cKDTree

from echolume_processing.hybrid.grid import OpticalGrid

LEAST_POINTS = 2
LEAST_NEIGHBOURS = 3
ABSORBING_MM = 9.0
"""A hole that a square of this side fits into is more than a shadow beside a step."""
BENCH_MM = 0.0

Mask = NDArray[np.bool_]
_EIGHT = np.ones((3, 3), dtype=np.bool_)


@dataclass(frozen=True)
class Closed:
    """An optical surface without holes, for prediction, and where it was closed; images of the field's shape."""

    height_mm: NDArray[np.float64]
    seen: Mask
    """Cells with optical evidence."""
    occluded: Mask
    """Narrow holes, closed from the lower neighbour."""
    absorbing: tuple[Mask, ...]
    """Holes big enough to be surfaces of their own."""
    outside: Mask
    """Cells that the optical pass never swept; the bench is taken to go on there."""


def close(grid: OpticalGrid) -> Closed:
    """Close the holes of an optical grid.

    Parameters
    ----------
    grid
        Heights with nan where no point fell.

    Returns
    -------
    Closed
        Lone cells (fewer than `LEAST_POINTS` points or `LEAST_NEIGHBOURS` seen neighbours) count as holes: noise
        on a black surface looks like them.
    """
    seen = np.isfinite(grid.height_mm) & (grid.count >= LEAST_POINTS)
    neighbours = ndimage.convolve(seen.astype(np.int64), _EIGHT.astype(np.int64), mode="constant") - seen
    seen &= neighbours >= LEAST_NEIGHBOURS
    swept = _swept(seen)
    holes = swept & ~seen
    side = max(1, round(ABSORBING_MM / grid.field.cell_mm))
    square = np.ones((side, side), dtype=np.bool_)
    # the border is mirrored, or a hole at the rim would be eaten by the opening
    pad = side
    opened = ndimage.binary_opening(np.pad(holes, pad, mode="edge"), square)[pad:-pad, pad:-pad] & holes
    labels, number = ndimage.label(opened, structure=_EIGHT)
    absorbing = tuple(np.asarray(labels == k) for k in range(1, number + 1))
    occluded = holes & ~opened
    height_mm = np.where(seen, grid.height_mm, BENCH_MM)
    _fill_from_lower(height_mm, seen, holes)
    return Closed(height_mm, seen, occluded, absorbing, ~swept)


def _swept(seen: Mask) -> Mask:
    """Rectangle that the optical pass covered: rows and columns of which a tenth was seen, and all between."""
    out = np.zeros(seen.shape, dtype=np.bool_)
    rows = np.nonzero(seen.sum(axis=1) >= 0.1 * seen.any(axis=0).sum())[0]
    columns = np.nonzero(seen.sum(axis=0) >= 0.1 * seen.any(axis=1).sum())[0]
    if rows.size and columns.size:
        out[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
    return out


def _fill_from_lower(height_mm: NDArray[np.float64], seen: Mask, holes: Mask) -> None:
    """Give each hole cell the height of the nearest seen rim cell among the low ones around it."""
    labels, number = ndimage.label(holes, structure=_EIGHT)
    for k, window in enumerate(ndimage.find_objects(labels, max_label=number), start=1):
        around = tuple(slice(max(0, s.start - 1), s.stop + 1) for s in window)
        inside = labels[around] == k
        rim = ndimage.binary_dilation(inside, structure=_EIGHT) & seen[around]
        if not rim.any():
            continue
        cells, rim_cells = np.argwhere(inside), np.argwhere(rim)
        rim_mm = height_mm[around][rim]
        tree = cKDTree(rim_cells)
        nearest, _ = tree.query(cells)
        view = height_mm[around]
        for cell, distance in zip(cells, np.asarray(nearest), strict=True):
            near = np.array(sorted(tree.query_ball_point(cell, 2 * float(distance) + 3.0)), dtype=np.int64)
            low = near[rim_mm[near] <= rim_mm[near].min() + 1.0]
            away = ((rim_cells[low] - cell) ** 2).sum(axis=1)
            view[cell[0], cell[1]] = rim_mm[low[int(np.argmin(away))]]
