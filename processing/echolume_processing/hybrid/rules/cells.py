"""Writes what a rule claims of each cell, so that no claim goes without its sigma, its sense and its count."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import NO_TRIGGER, Label, Provenance
from echolume_processing.hybrid import certainty
from echolume_processing.hybrid.grid import OpticalGrid
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells
from echolume_processing.hybrid.scipy_typed import Mask
from echolume_processing.hybrid.witnesses import Triggers, Witnesses, tabled

Image = NDArray[np.float64]
COUNT_LIMIT = np.iinfo(np.uint16).max


class Cells:
    """The cells of a map in the making; all images have the shape of the field.

    Parameters
    ----------
    field
        The raster of cells.
    stripes
        Stripes that light's points in each cell are of.
    pings
        Pings that sound's height in each cell is of: one by cell, or a table of them.
    """

    def __init__(self, field: MapField, stripes: Witnesses, pings: Triggers | Witnesses) -> None:
        self._field = field
        self._stripes = stripes
        self._pings = pings if isinstance(pings, Witnesses) else _one_a_cell(pings.ravel())
        self._cells = empty_cells(field)
        self._view = self._cells.reshape(field.shape)

    def light(self, grid: OpticalGrid, where: Mask) -> None:
        """Light's own height: it came back from something, so this is matte until sound says otherwise."""
        self._claim(where, grid.height_mm, grid.sigma_mm, Label.MATTE)
        self._view["provenance"][where] = grid.provenance[where]
        self._view["optical_n"][where] = np.minimum(grid.count, COUNT_LIMIT)[where]

    def sound(self, height_mm: Image, sigma_mm: Image, where: Mask, label: Label = Label.UNKNOWN) -> None:
        """A height that rests on sound alone; of what it is, sound alone says nothing: unknown."""
        self._claim(where, height_mm, sigma_mm, label)
        self._view["provenance"][where] = Provenance.ULTRASONIC
        self._view["ultrasonic_n"][where] = 1
        self._view["optical_n"][where] = 0

    def both(self, grid: OpticalGrid, height_mm: Image, sigma_mm: Image, where: Mask) -> None:
        """A height made of both senses' heights, which agree on it."""
        self.light(grid, where)
        self._claim(where, height_mm, sigma_mm, Label.MATTE)
        self._view["provenance"][where] |= np.uint8(Provenance.ULTRASONIC)
        self._view["ultrasonic_n"][where] = 1

    def transparent(self, grid: OpticalGrid, height_mm: Image, sigma_mm: Image, where: Mask) -> None:
        """Sound's height in front, light's behind."""
        self.both(grid, height_mm, sigma_mm, where)
        self._view["label"][where] = Label.TRANSPARENT
        self._view["behind_mm"][where] = grid.height_mm[where]

    def occluded(self, height_mm: Image, sigma_mm: float, where: Mask) -> None:
        """A narrow hole, closed from its lower neighbour: nothing was measured here, and the cell says so."""
        self._claim(where, height_mm, np.full(height_mm.shape, sigma_mm), Label.OCCLUDED)
        self._view["provenance"][where] = Provenance.FILLED

    def counts(self, optical: NDArray[np.int64], ultrasonic: NDArray[np.int64]) -> None:
        """Points of each sense in each cell, where a rule counts them itself."""
        self._view["optical_n"] = np.minimum(optical, COUNT_LIMIT)
        self._view["ultrasonic_n"] = np.minimum(ultrasonic, COUNT_LIMIT)

    def mixed(self, height_mm: Image, sigma_mm: Image, provenance: NDArray[np.uint8], where: Mask) -> None:
        """A height of whatever points fell there; matte where light is among them."""
        self._claim(where, height_mm, sigma_mm, Label.UNKNOWN)
        self._view["provenance"][where] = provenance[where]
        self._view["label"][where & ((provenance & ~np.uint8(Provenance.ULTRASONIC)) != 0)] = Label.MATTE

    def finish(self, *notes: str, registration: Registration | None = None) -> HybridMap:
        """The map."""
        cells = self._cells
        stripes = self._stripes.only(cells["optical_n"] > 0)
        pings = self._pings.only(cells["ultrasonic_n"] > 0)
        if stripes.which.size:
            cells["stripe_first"], cells["stripe_last"] = stripes.first, stripes.last
        if pings.which.size:
            cells["ping"] = pings.first
        cells["probability"] = certainty.by_rule(cells["label"])
        return HybridMap(self._field, cells, registration or Registration(), notes, stripes, pings)

    def _claim(self, where: Mask, height_mm: Image, sigma_mm: Image, label: Label) -> None:
        self._view["front_mm"][where] = height_mm[where]
        self._view["sigma_mm"][where] = sigma_mm[where]
        self._view["label"][where] = label


def _one_a_cell(triggers: Triggers) -> Witnesses:
    """A table of at most one trigger a cell; no table if there is none at all."""
    there = np.flatnonzero(triggers != NO_TRIGGER)
    return tabled(there, triggers[there], triggers.size) if there.size else Witnesses()
