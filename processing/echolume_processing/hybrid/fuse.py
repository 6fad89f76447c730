"""Fusion: light gives the surface, sound judges it, and what light cannot see is found by predicting the echoes."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration
from echolume_messages.plan import MapField
from echolume_messages.types import Structured
from echolume_processing.hybrid import holes
from echolume_processing.hybrid.cells import Cells, wide_field
from echolume_processing.hybrid.contradictions import find_plates
from echolume_processing.hybrid.dark import absorbing
from echolume_processing.hybrid.grid import OpticalGrid, accumulate
from echolume_processing.hybrid.heard import Heard, heard
from echolume_processing.hybrid.model import HybridMap, Registration, window_of
from echolume_processing.hybrid.registration import register
from echolume_processing.hybrid.scipy_typed import Mask
from echolume_processing.hybrid.sounding import Sounding, Spectra, sounding
from echolume_processing.hybrid.state import State
from echolume_processing.hybrid.surface import Surface, surface
from echolume_processing.hybrid.witnesses import Triggers
from echolume_processing.ping import Ping

SHARED = 0.05
"""Share of the map that light must have seen to register sound to it."""


@dataclass(frozen=True)
class Foreseen:
    """Echoes that were predicted ahead: of which heights, in air of which speed, and their spectra by trigger."""

    height_mm: NDArray[np.float64]
    speed_mps: float
    spectra: Mapping[int, NDArray[np.complex64]]

    def of(self, found: Sounding, scene: Surface) -> Mapping[int, NDArray[np.complex64]]:
        """Those that are still true: of the same surface, in the same air."""
        same = self.speed_mps == found.speed_mps and np.array_equal(self.height_mm, scene.height_mm)
        return self.spectra if same else {}


def fuse(
    optical: Structured,
    pings: Sequence[Ping],
    calibration: Calibration,
    field: MapField,
    triggers: Triggers | None = None,
) -> HybridMap:
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
    triggers
        Trigger of the stripe that each optical point is of, (n,).

    Returns
    -------
    HybridMap
        Every cell has a label and its provenance; cells without evidence stay unknown and have no height.
    """
    grid = accumulate(optical, wide_field(field), triggers)
    if not pings:
        return explain(grid, None, None, calibration, field)
    ordered = sorted(pings, key=lambda p: p.trigger)
    return explain(grid, sounding(ordered, calibration.array), heard(ordered, calibration.array), calibration, field)


def explain(
    grid: OpticalGrid,
    found: Sounding | None,
    spoken: Heard | None,
    calibration: Calibration,
    field: MapField,
    foreseen: Foreseen | None = None,
) -> HybridMap:
    """The hybrid map from light's cells and the pings in comparable form.

    Parameters
    ----------
    grid
        Light's cells of the `wide_field`.
    found, spoken
        The pings, sorted by trigger, and what each of them met; None if there are none.
    calibration
        What the scan was made with.
    field
        Cells of the map.
    foreseen
        Predictions made before, of the same pings; used if they are of the surface that light saw in the end.

    Notes
    -----
    The forward-model gate: the optical surface, its holes closed, predicts the echoes of every ping; predicted and
    measured echoes pass the same band and gate, and are registered to each other. Big holes get the plane that
    explains the pings over them. Pings that still disagree propose the planes that they met; each plane whose extent
    explains their echoes is a plate. What no plate explains is unknown: the cells whose echo is missing.
    """
    wide, closed = grid.field, holes.close(grid)
    cells = Cells(field, grid, closed)
    if found is None or spoken is None or not np.isfinite(grid.height_mm).any():
        missing = "no pings" if found is None else "no optical points"
        return cells.finish(Registration(), (f"{missing}: nothing was compared",))
    scene = surface(closed.height_mm, wide)
    predicted = _predicted(found, scene, foreseen)
    shared = float(closed.seen[window_of(wide, field)].mean())
    registration = Registration()
    if shared >= SHARED:
        before = found
        found, predicted, registration = register(found, predicted, scene)
        spoken = spoken.following(before, registration)
    else:
        cells.notes.append(
            f"light sees {100 * shared:.1f} % of the field: sound is not registered to it, but taken as calibrated"
        )
    state = _fill_holes(State(found, scene, predicted), closed.absorbing, cells, spoken)
    if closed.absorbing and registration.pings:
        before = found
        found, predicted, again = register(found, state.predicted)
        state = State(found, state.scene, predicted)
        spoken = spoken.following(before, again)
        registration = registration.then(again)
    find_plates(state, cells, spoken)
    by_trigger = np.array(found.triggers, dtype=np.uint32)
    return cells.finish(registration, (*cells.notes, *registration.notes, *_limits(calibration)), by_trigger)


def _predicted(found: Sounding, scene: Surface, foreseen: Foreseen | None) -> Spectra:
    """Echoes of a surface for all pings; those that were predicted ahead are not predicted again."""
    ahead = foreseen.of(found, scene) if foreseen is not None else {}
    missing = [k for k, trigger in enumerate(found.triggers) if trigger not in ahead]
    anew = dict(zip(missing, found.predict(scene, missing), strict=True)) if missing else {}
    return np.stack([anew[k] if k in anew else ahead[trigger] for k, trigger in enumerate(found.triggers)])


def _fill_holes(state: State, found_holes: Sequence[Mask], cells: Cells, spoken: Heard) -> State:
    """Give each big optical hole the height that sound finds there."""
    for hole in found_holes:
        patch = absorbing(state, hole, spoken)
        if patch is not None:
            cells.in_holes.append(patch)
            state = state.with_patch(patch.mask, patch.plane)
    return state


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
