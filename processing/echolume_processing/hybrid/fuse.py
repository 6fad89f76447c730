"""Fusion: light gives the surface, sound judges it, and what light cannot see is found by predicting the echoes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration
from echolume_messages.plan import MapField
from echolume_messages.types import Label, Provenance, Structured
from echolume_processing.hybrid import holes
from echolume_processing.hybrid.grid import OpticalGrid, accumulate
from echolume_processing.hybrid.hypotheses import Patch, State, absorbing, clusters, transparent
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells, widened, window_of
from echolume_processing.hybrid.sounding import register, sounding
from echolume_processing.hybrid.surface import surface
from echolume_processing.hybrid.tiles import Mask
from echolume_processing.ping import Ping

MARGIN_MM = 80.0
"""Sound sees this far beyond the map."""
ANOMALOUS = 0.25
"""Residual energy over measured energy above which a ping contradicts the surface."""
ANOMALOUS_TIMES = 6.0
"""And it must be so many times the median over all pings, or the model as a whole is at fault."""
ROUNDS = 4
OCCLUDED_SIGMA_MM = 2.0
UNEXPLAINED_MM = 5.0

_COUNT_LIMIT = np.iinfo(np.uint16).max


def fuse(optical: Structured, pings: Sequence[Ping], calibration: Calibration, field: MapField) -> HybridMap:
    """Fuse the optical points and the pings of a scan into the hybrid map.

    Parameters
    ----------
    optical
        ``OPTICAL_POINT`` (n,) of all stripes, in any order.
    pings
        All pings, in any order, of one digitiser setting.
    calibration
        What the scan was made with.
    field
        Cells of the map.

    Returns
    -------
    HybridMap
        Every cell has a label and its provenance; cells without evidence stay unknown, without a height.

    Notes
    -----
    The forward-model gate: the optical surface, its holes closed, predicts the echoes of every ping; predicted and
    measured echoes pass the same band and gate, and are registered to each other. Big holes get the height that
    explains the pings over them. Pings that still disagree form regions; each region is explained by a plate whose
    height, tilt and extent come from its echoes, or its cells become unknown.
    """
    wide = widened(field, MARGIN_MM)
    grid = accumulate(optical, wide)
    closed = holes.close(grid)
    builder = _Builder(wide, field, grid, closed)
    if not pings or not closed.seen.any():
        missing = "no pings" if not pings else "no optical points"
        return builder.finish(Registration(), (f"{missing}: nothing was compared",))
    found = sounding(sorted(pings, key=lambda p: p.trigger), calibration.array)
    scene = surface(closed.height_mm, wide)
    everything = np.arange(len(found.apertures))
    found, predicted, registration = register(found, found.predict(scene, everything))
    state = _fill_holes(State(found, scene, predicted), closed.absorbing, builder)
    if closed.absorbing:
        found, predicted, again = register(found, state.predicted)
        state = State(found, state.scene, predicted)
        registration = Registration(
            registration.dz_mm + again.dz_mm, again.speed_of_sound_mps, again.pings, again.residual_db
        )
    _find_plates(state, builder)
    return builder.finish(registration, (*builder.notes, *_limits(calibration)))


def _fill_holes(state: State, found_holes: Sequence[Mask], builder: _Builder) -> State:
    """Give each big optical hole the height that sound finds there."""
    height_mm, changed = state.scene.height_mm.copy(), np.zeros(state.scene.field.shape, dtype=np.bool_)
    for hole in found_holes:
        patch = absorbing(state, hole)
        builder.absorbing(hole, patch)
        if patch is not None:
            height_mm[hole] = patch.plane.image(state.scene.field)[hole]
            changed |= hole
    return state.with_height(height_mm, changed) if changed.any() else state


def _find_plates(state: State, builder: _Builder) -> None:
    """Explain regions of contradicting pings by plates, the largest first, until none is left."""
    hopeless = np.zeros(len(state.found.apertures), dtype=np.bool_)
    for _ in range(ROUNDS):
        residual = state.residual()
        limit = max(ANOMALOUS, ANOMALOUS_TIMES * float(np.median(residual)))
        regions = clusters(state.found, np.nonzero((residual > limit) & ~hopeless)[0])
        if not regions:
            return
        patch = transparent(state, regions[0])
        if patch is None:
            hopeless[regions[0]] = True
            builder.unexplained(state.found.foot_mm[regions[0]])
            continue
        builder.transparent(patch)
        height_mm = np.where(patch.mask, patch.plane.image(state.scene.field), state.scene.height_mm)
        state = state.with_height(height_mm, patch.mask)
        hopeless[_inside(state, patch)] = True


def _inside(state: State, patch: Patch) -> NDArray[np.int64]:
    """Pings whose foot lies in a patch: they have their explanation."""
    field = state.scene.field
    i, j = np.floor((state.found.foot_mm - (field.x_mm[0], field.y_mm[0])) / field.cell_mm).astype(np.int64).T
    inside = (i >= 0) & (j >= 0) & (i < field.shape[1]) & (j < field.shape[0])
    return np.nonzero(inside)[0][patch.mask[j[inside], i[inside]]]


def _limits(calibration: Calibration) -> tuple[str, ...]:
    """What an array of this band cannot decide."""
    array = calibration.array
    middle_hz = 0.5 * (array.low_hz + array.high_hz)
    if array.high_hz - array.low_hz >= 0.3 * array.low_hz:
        return ()
    half_wave_mm = 0.5e3 * array.speed_of_sound_mps / middle_hz
    return (
        f"narrow band around {middle_hz / 1e3:.0f} kHz: a plate n x {half_wave_mm:.2f} mm above what light sees "
        "returns the same echo and stays unseen; heights found by sound may be off by that step",
    )


class _Builder:
    """Collects what each cell of the wide field is."""

    def __init__(self, wide: MapField, field: MapField, grid: OpticalGrid, closed: holes.Closed) -> None:
        self.notes: list[str] = []
        self._wide, self._field = wide, field
        self._window = window_of(wide, field)
        self._grid, self._closed = grid, closed
        self._dark = np.any(closed.absorbing, axis=0) if closed.absorbing else np.zeros(wide.shape, dtype=np.bool_)
        cells = empty_cells(wide)
        self._cells = cells.reshape(wide.shape)
        seen, occluded = closed.seen, closed.occluded
        self._optical_mm = np.where(seen, grid.height_mm, np.nan)
        view = self._cells
        view["front_mm"][seen] = grid.height_mm[seen]
        view["sigma_mm"][seen] = grid.sigma_mm[seen]
        view["label"][seen] = Label.MATTE
        view["provenance"][seen] = grid.provenance[seen]
        view["optical_n"] = np.where(seen, np.minimum(grid.count, _COUNT_LIMIT), 0)
        view["front_mm"][occluded] = closed.height_mm[occluded]
        view["sigma_mm"][occluded] = OCCLUDED_SIGMA_MM
        view["label"][occluded] = Label.OCCLUDED
        view["provenance"][occluded] = Provenance.FILLED

    def absorbing(self, hole: Mask, patch: Patch | None) -> None:
        """A hole got its height from sound, or stays unknown."""
        if patch is None or patch.ambiguous:
            why = "no echo fits it" if patch is None else "two heights explain its echoes equally well"
            self._note(hole, f"a dark region of {{cells}} cells stays unknown: {why}")
            return
        self._put(hole, patch, Label.ABSORBING)

    def transparent(self, patch: Patch) -> None:
        """A plate that light goes through, or that has two possible heights."""
        mask = patch.mask & ~self._dark
        if patch.ambiguous:
            self._note(mask, "a transparent region of {cells} cells stays unknown: two heights explain its echoes")
            self._forget(mask)
            return
        self._put(mask, patch, Label.TRANSPARENT)
        view = self._cells
        view["behind_mm"][mask] = self._optical_mm[mask]
        lit = mask & self._closed.seen
        view["provenance"][lit] |= self._grid.provenance[lit]

    def unexplained(self, foot_mm: NDArray[np.float64]) -> None:
        """Pings contradict light, and no plate explains them: the cells right below are unknown."""
        rows, columns = self._wide.shape
        x_mm, y_mm = np.meshgrid(
            self._wide.x_mm[0] + (np.arange(columns) + 0.5) * self._wide.cell_mm,
            self._wide.y_mm[0] + (np.arange(rows) + 0.5) * self._wide.cell_mm,
        )
        mask = np.zeros(self._wide.shape, dtype=np.bool_)
        for x, y in foot_mm:
            mask |= (np.abs(x_mm - x) <= UNEXPLAINED_MM) & (np.abs(y_mm - y) <= UNEXPLAINED_MM)
        self._note(
            mask,
            f"light and sound disagree in {{cells}} cells around x {foot_mm[:, 0].mean():.0f}, "
            f"y {foot_mm[:, 1].mean():.0f} mm, and no plate explains it: unknown",
        )
        self._forget(mask)

    def _put(self, mask: Mask, patch: Patch, label: Label) -> None:
        view = self._cells
        view["front_mm"][mask] = patch.plane.image(self._wide)[mask]
        view["sigma_mm"][mask] = patch.sigma_mm
        view["label"][mask] = label
        view["provenance"][mask] = Provenance.ULTRASONIC
        view["ultrasonic_n"][mask] = min(patch.pings, _COUNT_LIMIT)

    def _note(self, mask: Mask, text: str) -> None:
        """Keep a note, unless it is about cells beyond the map."""
        inside = int(mask[self._window].sum())
        if inside:
            self.notes.append(text.format(cells=inside))

    def _forget(self, mask: Mask) -> None:
        view = self._cells
        view["front_mm"][mask] = view["sigma_mm"][mask] = np.nan
        view["label"][mask] = Label.UNKNOWN

    def finish(self, registration: Registration, notes: tuple[str, ...]) -> HybridMap:
        """Cut the map out of the wide field."""
        cells = empty_cells(self._field)
        part = self._cells[self._window].reshape(-1)
        for name in cells.dtype.names or ():
            if name not in ("ix", "iy"):
                cells[name] = part[name]
        return HybridMap(self._field, cells, registration, notes)
