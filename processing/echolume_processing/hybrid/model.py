"""The hybrid map as an object: its field, its cells, and what was found out on the way."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import MAP_CELL, Label, Provenance, Structured


@dataclass(frozen=True)
class Registration:
    """How the predicted echoes were brought onto the measured ones before anything was compared."""

    dz_mm: float = 0.0
    """Added to the array's calibrated height."""
    speed_of_sound_mps: float = 0.0
    pings: int = 0
    """Pings that took part; 0 means that nothing could be registered."""
    residual_db: float = 0.0
    """Median residual energy of those pings over their measured energy."""


@dataclass(frozen=True)
class HybridMap:
    """Every cell of the field, row by row (iy, then ix), and the notes that belong to the map as a whole."""

    field: MapField
    cells: Structured
    registration: Registration
    notes: tuple[str, ...] = ()

    def image(self, name: str) -> NDArray[Any]:
        """One field of the cells as an image, shape (rows along y, columns along x)."""
        return self.cells[name].reshape(self.field.shape)


def empty_cells(field: MapField) -> Structured:
    """Cells of a map of which nothing is known, shape (rows * columns,)."""
    rows, columns = field.shape
    cells = np.zeros(rows * columns, dtype=MAP_CELL)
    iy, ix = np.divmod(np.arange(rows * columns), columns)
    cells["ix"], cells["iy"] = ix, iy
    cells["front_mm"] = cells["behind_mm"] = cells["sigma_mm"] = np.nan
    cells["label"], cells["provenance"] = Label.UNKNOWN, Provenance.NONE
    return cells


def cell_centres_mm(field: MapField) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """x of each column and y of each row of a field, at the centres of the cells."""
    rows, columns = field.shape
    x_mm = field.x_mm[0] + (np.arange(columns) + 0.5) * field.cell_mm
    y_mm = field.y_mm[0] + (np.arange(rows) + 0.5) * field.cell_mm
    return x_mm.astype(np.float64), y_mm.astype(np.float64)


def widened(field: MapField, margin_mm: float) -> MapField:
    """The same raster of cells, reaching at least `margin_mm` further on each side."""
    more_mm = np.ceil(margin_mm / field.cell_mm) * field.cell_mm
    return MapField(
        x_mm=(field.x_mm[0] - more_mm, field.x_mm[1] + more_mm),
        y_mm=(field.y_mm[0] - more_mm, field.y_mm[1] + more_mm),
        cell_mm=field.cell_mm,
    )


def window_of(wide: MapField, field: MapField) -> tuple[slice, slice]:
    """Rows and columns that a field takes up in a wider one of the same raster."""
    j = round((field.y_mm[0] - wide.y_mm[0]) / field.cell_mm)
    i = round((field.x_mm[0] - wide.x_mm[0]) / field.cell_mm)
    rows, columns = field.shape
    return slice(j, j + rows), slice(i, i + columns)
