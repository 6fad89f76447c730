"""Fusion: light gives the surface, sound judges it, and what light cannot see is found by predicting the echoes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration
from echolume_messages.plan import MapField
from echolume_messages.types import Structured
from echolume_processing.hybrid import holes
from echolume_processing.hybrid.cells import Cells, wide_field
from echolume_processing.hybrid.grid import accumulate
from echolume_processing.hybrid.heard import Heard, Seed, heard, seeds
from echolume_processing.hybrid.hypotheses import (
    Patch,
    absorbing,
    bent,
    clusters,
    plate,
    seeds_by_height,
    vanished,
)
from echolume_processing.hybrid.model import HybridMap, Registration, cell_centres_mm, window_of
from echolume_processing.hybrid.registration import register
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints
from echolume_processing.hybrid.sounding import sounding
from echolume_processing.hybrid.state import State, cells_near, pings_near
from echolume_processing.hybrid.surface import surface
from echolume_processing.ping import Ping

ANOMALOUS = 0.25
"""Residual energy over measured energy above which a ping contradicts the surface."""
ANOMALOUS_TIMES = 6.0
"""And it must be so many times that of the better pings, or the model as a whole is at fault."""
BETTER = 0.5
"""The better pings are this share of all."""
NEVER_AGREES = 0.7
"""A ping of which so much is unexplained contradicts the surface, however bad the others are."""
PLATES = 12
"""So many surfaces are sought at most."""
OFF_SURFACE_MM = 1.5
"""A contact that lies this near to the surface says nothing new."""
RIM_MM = 8.0
"""Pings whose foot is this near to the rim of a plate found hear it and what is beside it."""
UNEXPLAINED_MM = 5.0
AGREES_MM = 10.0
"""A ping confirms what lies this near to its foot."""
SHARED = 0.05
"""Share of the map that light must have seen to register sound to it."""


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
    measured echoes pass the same band and gate, and are registered to each other. Big holes get the plane that
    explains the pings over them. Pings that still disagree propose the planes that they met; each plane whose extent
    explains their echoes is a plate. What no plate explains is unknown: the cells whose echo is missing.
    """
    wide = wide_field(field)
    grid = accumulate(optical, wide)
    closed = holes.close(grid)
    cells = Cells(field, grid, closed)
    if not pings or not np.isfinite(grid.height_mm).any():
        missing = "no pings" if not pings else "no optical points"
        return cells.finish(Registration(), (f"{missing}: nothing was compared",))
    ordered = sorted(pings, key=lambda p: p.trigger)
    found = sounding(ordered, calibration.array)
    spoken = heard(ordered, calibration.array)
    scene = surface(closed.height_mm, wide)
    predicted = found.predict(scene, np.arange(len(found.apertures)))
    shared = float(closed.seen[window_of(wide, field)].mean())
    registration = Registration()
    if shared >= SHARED:
        found, predicted, registration = register(found, predicted, scene)
        spoken = spoken.raised(registration.dz_mm)
    else:
        cells.notes.append(
            f"light sees {100 * shared:.1f} % of the field: sound is not registered to it, but taken as calibrated"
        )
    state = _fill_holes(State(found, scene, predicted), closed.absorbing, cells, spoken)
    if closed.absorbing and registration.pings:
        found, predicted, again = register(found, state.predicted)
        state = State(found, state.scene, predicted)
        spoken = spoken.raised(again.dz_mm)
        registration = registration.then(again)
    _find_plates(state, cells, spoken)
    return cells.finish(registration, (*cells.notes, *registration.notes, *_limits(calibration)))


def _fill_holes(state: State, found_holes: Sequence[Mask], cells: Cells, spoken: Heard) -> State:
    """Give each big optical hole the height that sound finds there."""
    for hole in found_holes:
        patch = absorbing(state, hole, spoken)
        if patch is not None:
            cells.put(patch, state.scene.height_mm)
            state = state.with_patch(patch.mask, patch.plane)
    return state


def _find_plates(state: State, cells: Cells, spoken: Heard) -> None:
    """Explain contradicting pings by surfaces, the one that most of them met first; then say what is left."""
    refused = np.zeros(len(state.found.apertures), dtype=np.bool_)
    settled = refused.copy()
    for _ in range(PLATES):
        odd = _contradicting(state)
        chosen = _next_plate(state, odd, refused, cells, spoken)
        if chosen is None:
            break
        patch, after = chosen
        cells.put(patch, state.scene.height_mm)
        state = after
        settled[_inside(state, patch)] = True
    if cells.beside.any():
        state = _straighten(state, cells, spoken)
    odd = _contradicting(state)
    for cluster in clusters(state.found, np.nonzero(odd & ~settled)[0]):
        state = _unexplained(state, cluster, cells)
    _judge_dark(state, cells, _contradicting(state))


def _straighten(state: State, cells: Cells, spoken: Heard) -> State:
    """Beside plates, give the ground that light sees bent the height that sound finds."""
    for seed in seeds(spoken, np.nonzero(_contradicting(state))[0]):
        chosen = bent(state, seed, cells.beside)
        if chosen is not None:
            cells.put(chosen[0], state.scene.height_mm)
            state = chosen[1]
    return state


def _contradicting(state: State) -> NDArray[np.bool_]:
    """Pings whose echoes are not those of the surface, (pings,)."""
    residual = state.residual()
    limit = max(ANOMALOUS, ANOMALOUS_TIMES * float(np.quantile(residual, BETTER)))
    return residual > min(limit, NEVER_AGREES)


def _next_plate(
    state: State, odd: NDArray[np.bool_], refused: NDArray[np.bool_], cells: Cells, spoken: Heard
) -> tuple[Patch, State] | None:
    """The next surface that explains contradicting pings; those of seeds that do not are marked as refused."""
    while True:
        asked = np.nonzero(odd & ~refused & _off_surface(state, spoken))[0]
        proposals = seeds(spoken, asked) or _by_height(state, np.nonzero(odd & ~refused)[0])
        if not proposals:
            return None
        for seed in proposals:
            chosen = plate(state, seed, cells.open)
            if chosen is not None:
                return chosen
            refused[seed.which] = True


def _by_height(state: State, odd: NDArray[np.int64]) -> list[Seed]:
    """Seeds where contacts tell no plane, as in a narrow band or with receivers a little off their places."""
    regions = clusters(state.found, odd)
    return seeds_by_height(state.found, regions[0]) if regions else []


def _off_surface(state: State, spoken: Heard) -> NDArray[np.bool_]:
    """Pings that met something above the surface, (pings,)."""
    field, place = state.scene.field, np.nan_to_num(spoken.place_mm, nan=-1e9)
    rows, columns = field.shape
    i = np.clip((place[:, 0] - field.x_mm[0]) / field.cell_mm, 0, columns - 1).astype(np.int64)
    j = np.clip((place[:, 1] - field.y_mm[0]) / field.cell_mm, 0, rows - 1).astype(np.int64)
    return np.abs(place[:, 2] - state.scene.height_mm[j, i]) > OFF_SURFACE_MM


def _inside(state: State, patch: Patch) -> NDArray[np.int64]:
    """Pings whose foot, or mirror point, lies in a patch or at its rim: they have their explanation."""
    field = state.scene.field
    return pings_near(state.found, patch.mask, field, RIM_MM, patch.plane)


def _judge_dark(state: State, cells: Cells, odd: NDArray[np.bool_]) -> None:
    """What light did not see and no surface fills has the height of what is beside it, if the echoes say so."""
    left = cells.open
    if not left.any():
        return
    foot = state.found.foot_mm
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(state.scene.field))
    _, nearest = NearestPoints(foot).nearest(np.column_stack((x_mm[left], y_mm[left])), AGREES_MM)
    agrees = np.append(~odd, False)[nearest]
    confirmed = np.zeros(left.shape, dtype=np.bool_)
    confirmed[left] = agrees
    cells.confirm(confirmed, state.scene.height_mm, 1)
    cells.note(cells.open, "a dark region of {cells} cells stays unknown: no echo fits it")


def _unexplained(state: State, cluster: NDArray[np.int64], cells: Cells) -> State:
    """No plate explains these pings: the cells whose echo is missing, or else those right below, are unknown."""
    foot = state.found.foot_mm[cluster]
    where = f"around x {foot[:, 0].mean():.0f}, y {foot[:, 1].mean():.0f} mm"
    missing = vanished(state, cluster)
    if missing is not None:
        cells.unknown(
            missing, f"the echo of {{cells}} cells {where} is missing: something hides them from sound; unknown"
        )
        return state.without(missing)
    mask = cells_near(foot, state.scene.field, UNEXPLAINED_MM)
    cells.unknown(mask, f"light and sound disagree in {{cells}} cells {where}, and no plate explains it: unknown")
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
