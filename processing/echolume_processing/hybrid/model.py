"""The hybrid map as an object: its field, its cells, and what was found out on the way."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import MAP_CELL, NO_TRIGGER, Label, Provenance, Structured
from echolume_processing.hybrid.witnesses import Witnesses

MOVES = (
    "dz_mm",
    "rx_rad",
    "ry_rad",
    "x_mm",
    "y_mm",
    "yaw_rad",
    "array_rx_rad",
    "array_ry_rad",
    "speed_mps",
    "drift_mps",
)
"""What a registration may move, in the order in which it is solved for."""
NOTED = dict(zip(MOVES, (0.25, 2e-3, 2e-3, 0.25, 0.25, 2e-3, 2e-3, 2e-3, 0.9, 0.9), strict=True))
"""A move beyond this is worth a note: a quarter of a millimetre, 0.1 deg, 1.5 K."""


@dataclass(frozen=True)
class Registration:
    """What the array's own echoes of the surface said about the set-up, and what was moved for it.

    Lengths and angles are errors of the calibrated set-up, added to it: of the robot's frame about the rig's origin,
    and of the array's tilt about its emitter, along the rig's axes.
    """

    dz_mm: float = 0.0
    """Added to the array's calibrated height."""
    speed_of_sound_mps: float = 0.0
    """In the middle of the scan."""
    pings: int = 0
    """Pings that took part; 0 means that nothing could be registered."""
    residual_db: float = 0.0
    """Median residual energy of those pings over their measured energy."""
    before_db: float = 0.0
    """The same before anything was moved."""
    x_mm: float = 0.0
    y_mm: float = 0.0
    rx_rad: float = 0.0
    ry_rad: float = 0.0
    yaw_rad: float = 0.0
    array_rx_rad: float = 0.0
    array_ry_rad: float = 0.0
    speed_mps: float = 0.0
    """Added to the speed of sound that the thermometer gave."""
    drift_mps: float = 0.0
    """Added to the change of the speed from the first to the last ping that the thermometer gave."""
    sigma: dict[str, float] = dataclasses.field(default_factory=dict[str, float])
    """One sigma of each of those, by its name; of one that was left alone, how far off it may be."""
    undetermined: tuple[str, ...] = ()
    """What these echoes do not tell; it was left as calibrated."""
    refused: str = ""
    """Why nothing was moved."""

    def errors(self, speed_mps: float) -> NDArray[np.float64]:
        """Those in the order of `MOVES`, (10,): the speed relative to one, the drift from the middle to the last ping.

        Parameters
        ----------
        speed_mps
            At which the echoes were predicted.
        """
        told = np.array([getattr(self, name) for name in MOVES], dtype=np.float64)
        told[-2:] /= speed_mps * np.array([1.0, 2.0])
        return told

    def then(self, again: Registration) -> Registration:
        """Both of two registrations, the second made from where the first had moved the set-up."""
        if again.refused or not again.pings:
            return self if self.pings else again
        left = tuple(n for n in again.undetermined if not self.pings or n in self.undetermined)
        first_knows = set(again.undetermined) - set(left)
        sums = {name: getattr(self, name) + getattr(again, name) for name in MOVES}
        sigma = {name: (self if name in first_knows else again).sigma[name] for name in again.sigma}
        before_db = self.before_db if self.pings else again.before_db
        return replace(again, **sums, sigma=sigma, undetermined=left, before_db=before_db)

    @property
    def notes(self) -> tuple[str, ...]:
        """What a reader of the map must know of it."""
        if self.refused:
            return (f"the ultrasound was not registered to light: {self.refused}; the calibrated set-up stands",)
        far = [name for name in MOVES if abs(getattr(self, name)) > NOTED[name]]
        if not far:
            return ()
        told = ", ".join(f"{name} {getattr(self, name):+.3g} +- {self.sigma.get(name, 0.0):.1g}" for name in far)
        return (f"the set-up is not as it was calibrated; its own echoes moved it: {told}",)

    def report(self) -> dict[str, object]:
        """Everything, as JSON takes it."""
        return {**dataclasses.asdict(self), "undetermined": list(self.undetermined)}


@dataclass(frozen=True)
class HybridMap:
    """Every cell of the field, row by row (iy, then ix), and the notes that belong to the map as a whole."""

    field: MapField
    cells: Structured
    registration: Registration
    notes: tuple[str, ...] = ()
    stripes: Witnesses = dataclasses.field(default_factory=Witnesses)
    """Stripes that put points into each cell, by trigger."""
    pings: Witnesses = dataclasses.field(default_factory=Witnesses)
    """Pings whose echo explains each cell, by trigger; see `accounts`."""

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
    for name in ("stripe_first", "stripe_last", "ping"):
        cells[name] = NO_TRIGGER
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
