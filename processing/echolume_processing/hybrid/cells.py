"""Cells of the map while it is made: what each is, where it was learnt, and how sure that is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import Label, Provenance
from echolume_processing.hybrid.grid import OpticalGrid
from echolume_processing.hybrid.holes import Closed
from echolume_processing.hybrid.hypotheses import Patch
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells, widened, window_of
from echolume_processing.hybrid.scipy_typed import Mask, depth_inside, distance_to

MARGIN_MM = 80.0
"""Sound sees this far beyond the map."""
OCCLUDED_SIGMA_MM = 2.0
CONFIRMED_SIGMA_MM = 0.5
RIM_MM, RIM_REACH_MM = 0.6, 6.0
"""The doubt which side of a rim a cell lies on falls by e over the first, and ends at the second."""
BESIDE_MM = 3.0
BESIDE_PER_RISE = 0.6
"""Beside the rim of a plate light is missing as far as `BESIDE_MM`, and this more for each millimetre that it is up:
one camera looks through the plate there, and the other past it."""

_COUNT_LIMIT = np.iinfo(np.uint16).max


class Cells:
    """Collects what each cell of a field, and of the margin around it, is."""

    def __init__(self, field: MapField, grid: OpticalGrid, closed: Closed) -> None:
        self.notes: list[str] = []
        self.wide = grid.field
        self.dark = np.any(closed.absorbing, axis=0) if closed.absorbing else np.zeros(grid.field.shape, dtype=np.bool_)
        """Where light is missing over more than a shadow."""
        self._field, self._window = field, window_of(grid.field, field)
        self._grid, self._seen = grid, closed.seen
        self._doubt_mm2 = np.zeros(grid.field.shape)
        self._beside = np.zeros(grid.field.shape, dtype=np.bool_)
        self._patched = np.zeros(grid.field.shape, dtype=np.bool_)
        self._given_up = np.zeros(grid.field.shape, dtype=np.bool_)
        self._cells = empty_cells(grid.field).reshape(grid.field.shape)
        self._optical_mm = np.where(closed.seen, grid.height_mm, np.nan)
        view, seen, occluded = self._cells, closed.seen, closed.occluded
        view["front_mm"][seen] = grid.height_mm[seen]
        view["sigma_mm"][seen] = grid.sigma_mm[seen]
        view["label"][seen] = Label.MATTE
        view["provenance"][seen] = grid.provenance[seen]
        view["optical_n"] = np.where(seen, np.minimum(grid.count, _COUNT_LIMIT), 0)
        view["front_mm"][occluded] = closed.height_mm[occluded]
        view["sigma_mm"][occluded] = OCCLUDED_SIGMA_MM
        view["label"][occluded] = Label.OCCLUDED
        view["provenance"][occluded] = Provenance.FILLED

    @property
    def open(self) -> Mask:
        """Dark cells of which nothing is known yet."""
        return self.dark & ~self._patched & ~self._given_up

    @property
    def beside(self) -> Mask:
        """Cells beside the rim of a transparent plate, of which sound has not said anything."""
        return self._beside & ~self._patched

    def put(self, patch: Patch, below_mm: NDArray[np.float64]) -> None:
        """A surface that sound found above heights believed before."""
        kind = "dark" if patch.label == Label.ABSORBING else "transparent"
        if patch.ambiguous:
            self.unknown(
                patch.mask,
                f"a {kind} region of {{cells}} cells stays unknown: two heights explain its echoes equally well",
            )
            return
        mask, view, height_mm = patch.mask, self._cells, patch.plane.image(self.wide)
        self._patched |= mask
        view["front_mm"][mask] = height_mm[mask]
        view["sigma_mm"][mask] = patch.sigma_mm
        view["label"][mask] = patch.label
        view["provenance"][mask] = Provenance.ULTRASONIC
        view["ultrasonic_n"][mask] = min(patch.pings, _COUNT_LIMIT)
        rise_mm = height_mm - below_mm
        away = distance_to(mask) * self.wide.cell_mm
        if patch.label == Label.TRANSPARENT:
            view["behind_mm"][mask] = self._optical_mm[mask]
            lit = mask & self._seen
            view["provenance"][lit] |= self._grid.provenance[lit]
            up_mm = float(np.median(rise_mm[mask]))
            self._beside |= away <= BESIDE_MM + BESIDE_PER_RISE * up_mm
        off_mm = np.where(mask, depth_inside(mask) * self.wide.cell_mm, away) - 0.5 * self.wide.cell_mm
        other = np.where(off_mm < RIM_REACH_MM, 0.5 * np.exp(-off_mm / RIM_MM), 0.0)
        self._doubt_mm2 += other * (1 - other) * rise_mm**2

    def confirm(self, mask: Mask, height_mm: NDArray[np.float64], pings: int) -> None:
        """Dark cells whose height, taken from beside them, explains the echoes."""
        view = self._cells
        mask = mask & self.open
        view["front_mm"][mask] = height_mm[mask]
        view["sigma_mm"][mask] = CONFIRMED_SIGMA_MM
        view["label"][mask] = np.where(self._beside, Label.OCCLUDED, Label.ABSORBING)[mask]
        view["provenance"][mask] = Provenance.FILLED | Provenance.ULTRASONIC
        view["ultrasonic_n"][mask] = min(pings, _COUNT_LIMIT)
        self._patched |= mask

    def unknown(self, mask: Mask, why: str) -> None:
        """Cells of which nothing is claimed, unless sound explained them; `why` may say how many with ``{cells}``."""
        mask = mask & ~self._patched
        self._given_up |= mask
        self.note(mask, why)
        view = self._cells
        view["front_mm"][mask] = view["sigma_mm"][mask] = view["behind_mm"][mask] = np.nan
        view["label"][mask] = Label.UNKNOWN

    def note(self, mask: Mask, why: str) -> None:
        """Keep a note, unless it is about cells beyond the map."""
        inside = int(mask[self._window].sum())
        if inside:
            self.notes.append(why.format(cells=inside))

    def finish(self, registration: Registration, notes: tuple[str, ...]) -> HybridMap:
        """Cut the map out of the wide field."""
        claimed = np.isfinite(self._cells["sigma_mm"])
        doubtful = np.sqrt(self._cells["sigma_mm"].astype(np.float64) ** 2 + self._doubt_mm2)
        self._cells["sigma_mm"][claimed] = doubtful[claimed]
        cells = empty_cells(self._field)
        part = self._cells[self._window].reshape(-1)
        for name in cells.dtype.names or ():
            if name not in ("ix", "iy"):
                cells[name] = part[name]
        return HybridMap(self._field, cells, registration, notes)


def wide_field(field: MapField) -> MapField:
    """The field and its margin."""
    return widened(field, MARGIN_MM)
