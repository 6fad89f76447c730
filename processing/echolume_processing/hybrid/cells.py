"""Cells of the map while it is made: what each is, where it was learnt, and how sure that is."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import Label, Provenance
from echolume_processing.hybrid import certainty
from echolume_processing.hybrid.accounts import Accounts, Claims
from echolume_processing.hybrid.grid import OpticalGrid
from echolume_processing.hybrid.holes import Closed
from echolume_processing.hybrid.hypotheses import Patch
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells, widened, window_of
from echolume_processing.hybrid.scipy_typed import Mask, depth_inside, distance_to
from echolume_processing.hybrid.scipy_typed import closed as filled
from echolume_processing.hybrid.witnesses import Triggers, Witnesses, tabled

MARGIN_MM = 80.0
"""Sound sees this far beyond the map."""
OCCLUDED_SIGMA_MM = 2.0
CONFIRMED_SIGMA_MM = 0.5
RIM_MM, RIM_REACH_MM = 0.5, 4.0
"""The doubt which side of a rim a cell lies on falls by e over the first, and ends at the second."""
STEP_BETWEEN_MM = 3.0
"""Ground that light sees on two sides of a dark cell may differ by so much, as it does where one side is seen through a
plate."""
BESIDE_MM = 3.0
BESIDE_PER_RISE = 0.6
"""Beside the rim of a plate light is missing as far as `BESIDE_MM`, and this more for each millimetre that it is up:
one camera looks through the plate there, and the other past it."""
AT_GROUND_MM = 1.5
"""A dark surface this near to the ground, beside a plate, is the ground."""
HIDDEN_MM = 15.0
"""The same beside a plate without an echo, of which nobody knows how high it is."""

_COUNT_LIMIT = np.iinfo(np.uint16).max


class Cells:
    """Collects what each cell of a field, and of the margin around it, is."""

    def __init__(self, field: MapField, grid: OpticalGrid, closed: Closed) -> None:
        self.notes: list[str] = []
        self.wide = grid.field
        self.dark = np.any(closed.absorbing, axis=0) if closed.absorbing else np.zeros(grid.field.shape, dtype=np.bool_)
        """Where light is missing over more than a shadow."""
        self.seen, self.ground_mm = closed.seen, closed.height_mm
        self.in_holes: list[Patch] = []
        """Surfaces that sound found in holes of light, as long as no plate claims them."""
        self._field, self._window = field, window_of(grid.field, field)
        self._grid, self._seen = grid, closed.seen
        self._doubt_mm2 = np.zeros(grid.field.shape)
        self._beside = np.zeros(grid.field.shape, dtype=np.bool_)
        self._close = np.zeros(grid.field.shape, dtype=np.bool_)
        self._hidden = np.zeros(grid.field.shape, dtype=np.bool_)
        self._rims = np.zeros(grid.field.shape, dtype=np.bool_)
        self._patched = np.zeros(grid.field.shape, dtype=np.bool_)
        self._given_up = np.zeros(grid.field.shape, dtype=np.bool_)
        self._cells = empty_cells(grid.field).reshape(grid.field.shape)
        self._patches: list[Patch] = []
        self._of_patch = np.full(grid.field.shape, -1, dtype=np.int64)
        self._accounts: Accounts | None = None
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
        self._of_patch[mask] = len(self._patches)
        self._patches.append(patch)
        view["front_mm"][mask] = height_mm[mask]
        view["sigma_mm"][mask] = patch.sigma_mm
        view["label"][mask] = patch.label
        view["provenance"][mask] = Provenance.ULTRASONIC
        view["ultrasonic_n"][mask] = min(patch.pings, _COUNT_LIMIT)
        if patch.doubt_mm is not None:
            self._doubt_mm2[mask] += patch.doubt_mm[mask] ** 2
        rise_mm = height_mm - below_mm
        away = distance_to(mask) * self.wide.cell_mm
        if patch.rim is not None and patch.bent is not None:
            self._rims |= patch.rim
            self._to_ground((patch.rim | patch.bent) & ~mask, below_mm)
        if patch.label == Label.TRANSPARENT:
            view["behind_mm"][mask] = self._optical_mm[mask]
            lit = mask & self._seen
            view["provenance"][lit] |= self._grid.provenance[lit]
            up_mm = float(np.median(rise_mm[mask]))
            self._beside |= away <= BESIDE_MM + BESIDE_PER_RISE * np.maximum(up_mm, rise_mm)
            self._close |= away <= BESIDE_MM + BESIDE_PER_RISE * up_mm
        elif patch.label == Label.ABSORBING:
            view["label"][mask & self._beside & (np.abs(rise_mm) <= AT_GROUND_MM)] = Label.OCCLUDED
        off_mm = np.where(mask, depth_inside(mask) * self.wide.cell_mm, away) - 0.5 * self.wide.cell_mm
        other = np.where(off_mm < RIM_REACH_MM, 0.5 * np.exp(-off_mm / RIM_MM), 0.0)
        self._doubt_mm2 += other * (1 - other) * rise_mm**2

    def confirm(self, mask: Mask, height_mm: NDArray[np.float64], pings: int) -> None:
        """Dark cells whose height, taken from beside them, explains the echoes.

        In the hole of a plate sound vouches for the height, and nothing says what is there.
        """
        view, holed = self._cells, self.holed
        mask = mask & (self.open | (holed & (view["label"] == Label.OCCLUDED)))
        view["front_mm"][mask] = height_mm[mask]
        view["sigma_mm"][mask] = CONFIRMED_SIGMA_MM
        beside = np.where(self._beside | self._hidden, Label.OCCLUDED, Label.ABSORBING)
        view["label"][mask] = np.where(holed, Label.UNKNOWN, beside)[mask]
        view["provenance"][mask] = Provenance.FILLED | Provenance.ULTRASONIC
        view["ultrasonic_n"][mask] = min(pings, _COUNT_LIMIT)
        self._patched |= mask

    @property
    def holed(self) -> Mask:
        """Holes of transparent plates: sound gets through, and a camera sees past the plate, or through it."""
        plates = self._cells["label"] == Label.TRANSPARENT
        return filled(plates) & ~plates

    def hides(self, mask: Mask) -> None:
        """Something of which sound hears nothing, that bends light beside it as plates do."""
        self._hidden |= distance_to(mask) * self.wide.cell_mm <= HIDDEN_MM

    def doubt_steps(self) -> None:
        """Beside a plate, dark cells between grounds of two heights are unknown: the step may lie anywhere there."""
        light_mm = np.where(self._rims, np.nan, self._optical_mm)
        between = _rise_between(light_mm) > STEP_BETWEEN_MM
        filled_in = self.open | (self._cells["label"] == Label.OCCLUDED)
        mask = self._close & filled_in & np.isnan(light_mm) & between
        self.unknown(
            mask, "{cells} dark cells beside a plate stay unknown: the ground around them is not of one height"
        )

    def _to_ground(self, mask: Mask, height_mm: NDArray[np.float64]) -> None:
        """Cells of which light sees only a plate's rim, or the ground through it: they take the height beside them."""
        view = self._cells
        view["front_mm"][mask] = height_mm[mask]
        view["sigma_mm"][mask] = CONFIRMED_SIGMA_MM
        view["label"][mask] = Label.OCCLUDED
        view["provenance"][mask] = Provenance.FILLED

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

    def claims(self) -> Claims:
        """What is claimed of each cell."""
        return Claims(
            self.wide, self._cells["label"], np.isfinite(self._cells["front_mm"]), self._patches, self._of_patch
        )

    def account(self, accounts: Accounts) -> None:
        """Keep which pings speak for each cell."""
        self._accounts = accounts

    def finish(self, registration: Registration, notes: tuple[str, ...], triggers: Triggers | None = None) -> HybridMap:
        """Cut the map out of the wide field; `triggers` are those of the pings, in their order."""
        claimed = np.isfinite(self._cells["sigma_mm"])
        doubtful = np.sqrt(self._cells["sigma_mm"].astype(np.float64) ** 2 + self._doubt_mm2)
        self._cells["sigma_mm"][claimed] = doubtful[claimed]
        stripes, pings = self._witnesses(triggers)
        self._cells["probability"] = self._probability()
        cells = empty_cells(self._field)
        part = self._cells[self._window].reshape(-1)
        for name in cells.dtype.names or ():
            if name not in ("ix", "iy"):
                cells[name] = part[name]
        return HybridMap(self._field, cells, registration, notes, stripes, pings)

    def _witnesses(self, triggers: Triggers | None) -> tuple[Witnesses, Witnesses]:
        """Stripes and pings of each cell of the map."""
        view, accounts = self._cells, self._accounts
        window = np.arange(view.size).reshape(view.shape)[self._window].ravel()
        stripes = self._grid.stripes.only(self._seen.ravel())
        if stripes.which.size:
            view["stripe_first"], view["stripe_last"] = (x.reshape(view.shape) for x in (stripes.first, stripes.last))
        if accounts is None or triggers is None:
            return stripes.taken(window), tabled(window[:0], window[:0], window.size)
        spoken = accounts.nearest >= 0
        view["ping"][spoken] = triggers[accounts.nearest[spoken]]
        return stripes.taken(window), tabled(accounts.cell, triggers[accounts.ping], view.size).taken(window)

    def _probability(self) -> NDArray[np.float64]:
        """How probable each label is."""
        label = self._cells["label"]
        left = np.append([patch.left for patch in self._patches], np.nan)[self._of_patch]
        verdict = np.zeros(label.shape, dtype=np.uint8) if self._accounts is None else self._accounts.verdict
        raised = (self._of_patch >= 0) & (label != Label.MATTE)
        return certainty.probability(label, _off_rim_mm(raised, self.wide.cell_mm), left, verdict)


def _off_rim_mm(mask: Mask, cell_mm: float) -> NDArray[np.float64]:
    """Distance of each cell's centre to the rim of a mask."""
    return (np.where(mask, depth_inside(mask), distance_to(mask)) - 0.5) * cell_mm


def _rise_between(height_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Of each cell, how much the nearest known heights along its row and its column, both ways, differ."""
    lowest, highest = np.full(height_mm.shape, np.inf), np.full(height_mm.shape, -np.inf)
    for turns in range(4):
        view = np.rot90(height_mm, turns)
        known = np.where(np.isfinite(view), np.arange(view.shape[1]), -1)
        last = np.maximum.accumulate(known, axis=1)
        reached = np.where(last >= 0, np.take_along_axis(view, np.maximum(last, 0), axis=1), np.nan)
        reached = np.rot90(reached, -turns)
        lowest, highest = np.fmin(lowest, reached), np.fmax(highest, reached)
    return highest - lowest


def wide_field(field: MapField) -> MapField:
    """The field and its margin."""
    return widened(field, MARGIN_MM)
