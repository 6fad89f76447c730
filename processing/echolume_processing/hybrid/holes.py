"""Where light returned nothing: shadows, surfaces that swallow light, and what closes the holes for prediction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from echolume_processing.hybrid.cell_kernels import lower_ground
from echolume_processing.hybrid.grid import OpticalGrid
from echolume_processing.hybrid.scipy_typed import (
    EIGHT,
    Mask,
    NearestPoints,
    around_each,
    depth_inside,
    dilated,
    labelled,
    opened,
)

LEAST_POINTS = 2
LEAST_NEIGHBOURS = 3
ABSORBING_MM = 9.0
"""A hole that a square of this side fits into is more than a shadow beside a step."""
PIT_CELLS = 2
LEVEL_MM = 1.0
"""A hole that a square of so many cells fits into, with a rim as level as this, has nothing that throws a shadow: it
may be a dark spot or a pit, and sound does not resolve it."""
STEEP = 0.7
"""Beside ground that falls so much towards a hole, more of the same flank may lie in it."""
WALL_MM = 4.0
"""A greater difference between neighbouring cells is a wall."""
BENCH_MM = 0.0
LOOKED_CELLS = 3.0
"""The lower ground is sought so much further than twice the distance to the nearest seen cell, and than right across
the hole: a shadow has what throws it on one side, and what it falls on on the other."""
LOOKED_WIDE_CELLS = 25.0
"""Beside a wide hole, further: light sees the rim of a plate, and nothing of what is next to it."""


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
    near = np.asarray(ndimage.convolve(seen.astype(np.int64), EIGHT.astype(np.int64), mode="constant"))
    seen &= near - seen.astype(np.int64) >= LEAST_NEIGHBOURS
    swept = _swept(seen)
    holes = swept & ~seen
    wide = opened(holes, max(1, round(ABSORBING_MM / grid.field.cell_mm)))
    labels, number = labelled(wide)
    absorbing = tuple(np.asarray(labels == k) for k in range(1, number + 1))
    occluded = holes & ~wide & ~_untold(grid, seen, holes & ~wide)
    height_mm = np.where(seen, grid.height_mm, BENCH_MM)
    _fill_from_lower(height_mm, seen, holes, wide)
    return Closed(height_mm, seen, occluded, absorbing, ~swept)


def _untold(grid: OpticalGrid, seen: Mask, narrow: Mask) -> Mask:
    """Small holes of which nothing tells whether they are pits or dark spots, and flanks too steep for light."""
    labels, _ = labelled(narrow)
    places = around_each(labels)
    fall_mm = _fall(np.where(seen, grid.height_mm, np.nan))
    out = np.zeros_like(narrow)
    for k in np.unique(labels[opened(narrow, PIT_CELLS)]):
        around = places[k - 1]
        inside = labels[around] == k
        j, i = np.nonzero(inside)
        rim = dilated(inside) & seen[around]
        if not rim.any():
            continue
        rim_mm = grid.height_mm[around][rim]
        small = max(np.ptp(j), np.ptp(i)) * grid.field.cell_mm < ABSORBING_MM
        above = rim_mm > rim_mm.min() + LEVEL_MM
        if np.median(fall_mm[around][rim][above]) > STEEP * grid.field.cell_mm if above.any() else small:
            out[around] |= inside
    return out


def _fall(height_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """How much each cell lies above or below its known neighbours, in the median, those beyond a wall left out."""
    rows, columns = height_mm.shape
    padded = np.pad(height_mm, 1, constant_values=np.nan)
    beside = [padded[1 + j : 1 + j + rows, 1 + i : 1 + i + columns] for j in (-1, 0, 1) for i in (-1, 0, 1) if i or j]
    off_mm = np.sort(np.abs(np.stack(beside) - height_mm), axis=0)  # those not known come last
    off_mm[off_mm > WALL_MM] = np.nan
    known = np.isfinite(off_mm).sum(axis=0)
    middle = np.take_along_axis(off_mm, np.maximum(known - 1, 0)[None] // 2, axis=0)[0]
    return np.where(known > 0, middle, 0.0)


def _swept(seen: Mask) -> Mask:
    """Rectangle that the optical pass covered: rows and columns of which a tenth was seen, and all between."""
    out = np.zeros(seen.shape, dtype=np.bool_)
    rows = np.nonzero(seen.sum(axis=1) >= 0.1 * seen.any(axis=0).sum())[0]
    columns = np.nonzero(seen.sum(axis=0) >= 0.1 * seen.any(axis=1).sum())[0]
    if seen.any() and rows.size and columns.size:
        out[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1] = True
    return out


def _fill_from_lower(height_mm: NDArray[np.float64], seen: Mask, holes: Mask, wide: Mask) -> None:
    """Give each hole cell the height of the nearest seen rim cell among the low ones around it."""
    labels, number = labelled(holes)
    for k, around in zip(range(1, number + 1), around_each(labels), strict=True):
        inside = labels[around] == k
        rim = dilated(inside) & seen[around]
        if not rim.any():
            continue
        cells, rim_cells = (np.ascontiguousarray(np.argwhere(mask)) for mask in (inside, rim))
        view, looked = height_mm[around], LOOKED_WIDE_CELLS if wide[around][inside].any() else LOOKED_CELLS
        across = 2 * float(depth_inside(inside).max()) + LOOKED_CELLS
        nearest, _ = NearestPoints(rim_cells.astype(np.float64)).nearest(cells.astype(np.float64))
        row_start = np.searchsorted(rim_cells[:, 0], np.arange(rim.shape[0] + 1))
        view[inside] = lower_ground(cells, nearest, looked, across, rim_cells, view[rim], row_start)
