"""Optical points to cells: a median per cell that does not depend on the order of arrival."""

from __future__ import annotations

from dataclasses import dataclass
from dataclasses import field as dataclass_field

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import OpticalSource, Provenance, Structured
from echolume_processing.hybrid.witnesses import Triggers, Witnesses, tabled

STEPS_PER_MM = 1000.0
"""Heights are compared as whole micrometres, so that equal evidence gives equal bits."""
LEAST_SIGMA_MM = 0.01
SPREAD_OF_MAD = 1.4826
_LARGEST = np.iinfo(np.int64).max

_BIT_OF_SOURCE = {
    OpticalSource.STEREO: Provenance.STEREO,
    OpticalSource.ACTIVE_LEFT: Provenance.ACTIVE_LEFT,
    OpticalSource.ACTIVE_RIGHT: Provenance.ACTIVE_RIGHT,
}


@dataclass(frozen=True)
class OpticalGrid:
    """What light says of each cell; all arrays have the shape of the field."""

    field: MapField
    height_mm: NDArray[np.float64]
    """Median height; nan where no point fell."""
    sigma_mm: NDArray[np.float64]
    count: NDArray[np.int64]
    provenance: NDArray[np.uint8]
    stripes: Witnesses = dataclass_field(default_factory=Witnesses)
    """Stripes that the points of each cell are of; no table where their triggers were not told."""


def cell_index(field: MapField, x_mm: NDArray[np.floating], y_mm: NDArray[np.floating]) -> NDArray[np.int64]:
    """Flat index of the cell of each point (n,); -1 outside the field."""
    rows, columns = field.shape
    ix = np.floor((np.asarray(x_mm, dtype=np.float64) - field.x_mm[0]) / field.cell_mm).astype(np.int64)
    iy = np.floor((np.asarray(y_mm, dtype=np.float64) - field.y_mm[0]) / field.cell_mm).astype(np.int64)
    inside = (ix >= 0) & (ix < columns) & (iy >= 0) & (iy < rows)
    return np.where(inside, iy * columns + ix, -1)


def accumulate(points: Structured, field: MapField, triggers: Triggers | None = None) -> OpticalGrid:
    """Median height, spread, count and sources of the optical points in each cell.

    Parameters
    ----------
    points
        ``OPTICAL_POINT`` records (n,) of any number of stripes, in any order.
    field
        The raster of cells.
    triggers
        Trigger of the stripe that each point is of, shape (n,).

    Returns
    -------
    OpticalGrid
        The standard deviation of a cell is that of its median: 1.2533 times the larger of the robust spread and
        the points' own sigma, over the root of their number.

    Notes
    -----
    Points are sorted by cell and height in whole micrometres before anything is counted, so any order of
    arrival gives the same bits. A cell that straddles a step gives the height of its majority.
    """
    rows, columns = field.shape
    height_mm = np.full(rows * columns, np.nan)
    sigma_mm = np.full(rows * columns, np.nan)
    count = np.zeros(rows * columns, dtype=np.int64)
    provenance = np.zeros(rows * columns, dtype=np.uint8)
    cell = cell_index(field, points["x_mm"], points["y_mm"])
    good = (cell >= 0) & np.isfinite(points["z_mm"])
    cell, used = cell[good], points[good]
    if cell.size:
        steps = np.round(used["z_mm"].astype(np.float64) * STEPS_PER_MM).astype(np.int64)
        own_steps = np.round(used["sigma_z_mm"].astype(np.float64) * STEPS_PER_MM).astype(np.int64)
        cells, median, number = _median_per_cell(cell, steps)
        twice = np.zeros(rows * columns, dtype=np.int64)  # a median may lie halfway between two steps
        twice[cells] = np.round(2 * median)
        spread = 0.5 * _median_per_cell(cell, np.abs(2 * steps - twice[cell]))[1] * SPREAD_OF_MAD / STEPS_PER_MM
        own_mm = _median_per_cell(cell, own_steps)[1] / STEPS_PER_MM
        height_mm[cells] = median / STEPS_PER_MM
        sigma_mm[cells] = np.maximum(LEAST_SIGMA_MM, 1.2533 * np.maximum(spread, own_mm) / np.sqrt(number))
        count[cells] = number
        for source, bit in _BIT_OF_SOURCE.items():
            provenance[cell[used["source"] == source]] |= np.uint8(bit)
    shape = field.shape
    return OpticalGrid(
        field,
        height_mm.reshape(shape),
        sigma_mm.reshape(shape),
        count.reshape(shape),
        provenance.reshape(shape),
        Witnesses() if triggers is None else tabled(cell, triggers[good], rows * columns),
    )


def _median_per_cell(
    cell: NDArray[np.int64], value: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.int64]]:
    """Cells that occur (m,), the median of their values (m,), how many there are (m,)."""
    lowest = int(value.min())
    span = int(value.max()) - lowest + 1
    if span < _LARGEST // (int(cell.max()) + 1):
        key = np.sort(cell * span + (value - lowest))  # one sort of whole numbers, five times as fast as two by index
        ordered_cell, ordered = np.divmod(key, span)
        ordered += lowest
    else:
        order = np.lexsort((value, cell))
        ordered_cell, ordered = cell[order], value[order]
    start = np.flatnonzero(np.diff(ordered_cell, prepend=-1))
    cells, number = ordered_cell[start], np.diff(start, append=ordered_cell.size)
    low, high = ordered[start + (number - 1) // 2], ordered[start + number // 2]
    return cells, 0.5 * (low + high).astype(np.float64), number.astype(np.int64)
