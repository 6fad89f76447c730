"""Optical points to cells: a height per cell, at its centre, that does not depend on the order of arrival."""

from __future__ import annotations

from dataclasses import dataclass, replace
from dataclasses import field as dataclass_field

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import OpticalSource, Provenance, Structured
from echolume_processing.hybrid.cell_kernels import occupied, twice_medians
from echolume_processing.hybrid.witnesses import Triggers, Witnesses, tabled

STEPS_PER_MM = 1000.0
"""Heights are compared as whole micrometres, so that equal evidence gives equal bits."""
LEAST_SIGMA_MM = 0.01
SPREAD_OF_MAD = 1.4826
GENTLEST, STEEPEST = 0.02, 2.5
"""Slopes between which heights are brought to the centres of their cells."""
LEAST_RUN = 0.3
"""Points of neighbouring cells are taken to be no nearer than this share of a cell."""

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
    """nan where no point fell."""
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


@dataclass(frozen=True)
class Gathered:
    """What the points of each cell say by themselves; all images have the shape of the field."""

    grid: OpticalGrid
    """Heights are the medians of the points, wherever in their cells those lie."""
    aside_mm: NDArray[np.float64]
    """By how much their middle is off the cell's centre in x and in y, (2, rows, columns); 0 where there is none."""


def accumulate(points: Structured, field: MapField, triggers: Triggers | None = None) -> OpticalGrid:
    """Height, spread, count and sources of the optical points in each cell.

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
        See `gather` and `centred`.
    """
    return centred(gather(points, field, triggers))


def gather(points: Structured, field: MapField, triggers: Triggers | None = None) -> Gathered:
    """Median height, spread, count and sources of the optical points in each cell, and where in it they lie.

    Notes
    -----
    Points are sorted by cell and height in whole micrometres before anything is counted, so any order of
    arrival gives the same bits. A cell that straddles a step gives the height of its majority. The standard
    deviation of a cell is that of its median: 1.2533 times the larger of the robust spread and the points' own
    sigma, over the root of their number. A stereo point is made of the same two image points as the active ones of its
    row: stereo points count if there are more of them than active ones, and else those.
    """
    rows, columns = field.shape
    height_mm = np.full(rows * columns, np.nan)
    sigma_mm = np.full(rows * columns, np.nan)
    count = np.zeros(rows * columns, dtype=np.int64)
    provenance = np.zeros(rows * columns, dtype=np.uint8)
    aside_mm = np.zeros((2, rows * columns))
    cell = cell_index(field, points["x_mm"], points["y_mm"])
    good = (cell >= 0) & np.isfinite(points["z_mm"])
    cell = cell[good]
    if cell.size:
        used = {name: points[name][good] for name in ("x_mm", "y_mm", "z_mm", "sigma_z_mm", "source")}
        cells, number, slot = occupied(cell, rows * columns)
        twice = twice_medians(slot, number, _steps(used["z_mm"]), _steps(used["sigma_z_mm"]))
        median, off, own = (0.5 * each.astype(np.float64) for each in twice)
        spread, own_mm = 0.5 * off * SPREAD_OF_MAD / STEPS_PER_MM, own / STEPS_PER_MM
        height_mm[cells] = median / STEPS_PER_MM
        stereo = np.bincount(slot[used["source"] == OpticalSource.STEREO], minlength=cells.size)
        images = np.maximum(stereo, number - stereo)
        sigma_mm[cells] = np.maximum(LEAST_SIGMA_MM, 1.2533 * np.maximum(spread, own_mm) / np.sqrt(images))
        count[cells] = number
        for axis, name in enumerate(("x_mm", "y_mm")):
            place = np.round(used[name].astype(np.float64) * STEPS_PER_MM)  # whole numbers: their sum is exact
            middle_mm = np.bincount(slot, place, cells.size) / (number * STEPS_PER_MM)
            aside_mm[axis, cells] = middle_mm - _centres_mm(field, axis, cells)
        for source, bit in _BIT_OF_SOURCE.items():
            provenance[cell[used["source"] == source]] |= np.uint8(bit)
    shape = field.shape
    grid = OpticalGrid(
        field,
        height_mm.reshape(shape),
        sigma_mm.reshape(shape),
        count.reshape(shape),
        provenance.reshape(shape),
        Witnesses() if triggers is None else tabled(cell, triggers[good], rows * columns),
    )
    return Gathered(grid, aside_mm.reshape(2, *shape))


def centred(gathered: Gathered) -> OpticalGrid:
    """Heights at the centres of the cells: along the slope from where in each cell its points lie.

    Notes
    -----
    A stripe crosses a column of cells at one place, which is off the middle by up to half a cell. The slope is that
    between neighbouring cells: the harmonic mean of those to either side (van Leer, doi:10.1016/0021-9991(74)90019-9),
    which is 0 on a crest and where one side is level, as at a step; where a neighbour is missing, that of the two next
    slopes on the other side. Slopes beyond `STEEPEST` are steps, those below `GENTLEST` noise.
    """
    grid = gathered.grid
    height_mm = grid.height_mm.copy()
    for axis, along in ((0, 1), (1, 0)):
        place_mm = gathered.aside_mm[axis]
        rise_mm = np.diff(grid.height_mm, axis=along)
        run_mm = np.maximum(grid.field.cell_mm + np.diff(place_mm, axis=along), LEAST_RUN * grid.field.cell_mm)
        beside = [(2, 2) if each == along else (0, 0) for each in (0, 1)]
        padded = np.pad(rise_mm / run_mm, beside, constant_values=np.nan)
        cells = height_mm.shape[along]
        further_before, before, after, further_after = (
            padded.take(range(k, k + cells), axis=along) for k in range(4)
        )  # fmt: skip
        slope = np.where(np.isnan(after), _limited(further_before, before), _limited(before, after))
        slope = np.where(np.isnan(before), _limited(after, further_after), slope)
        height_mm -= slope * place_mm
    return replace(grid, height_mm=height_mm)


def _limited(one: NDArray[np.float64], other: NDArray[np.float64]) -> NDArray[np.float64]:
    """Harmonic mean of slopes that have one sign and are neither noise nor a step; else 0."""
    same = one * other > 0
    mean = np.divide(2 * one * other, one + other, out=np.zeros_like(one), where=same)
    return np.where((np.abs(mean) >= GENTLEST) & (np.abs(mean) <= STEEPEST), mean, 0.0)


def _centres_mm(field: MapField, axis: int, cells: NDArray[np.int64]) -> NDArray[np.float64]:
    """x (axis 0) or y (1) of the centres of some cells by their flat index."""
    iy, ix = np.divmod(cells, field.shape[1])
    low_mm, number = (field.x_mm[0], ix) if axis == 0 else (field.y_mm[0], iy)
    return low_mm + (number + 0.5) * field.cell_mm


def _steps(value_mm: NDArray[np.floating]) -> NDArray[np.int64]:
    """Values in whole micrometres."""
    return np.round(value_mm.astype(np.float64) * STEPS_PER_MM).astype(np.int64)
