"""What becomes of pings that contradict the surface: plates, bent ground, missing echoes, or cells that are unknown."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_processing.hybrid.accounts import account
from echolume_processing.hybrid.cells import Cells
from echolume_processing.hybrid.curved import curved_seed, first_height_mm
from echolume_processing.hybrid.heard import Heard, Seed, seeds
from echolume_processing.hybrid.hypotheses import Light, Patch, bent, plate
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.proposals import clusters, seeds_by_height, vanished
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints
from echolume_processing.hybrid.state import State, cells_near, pings_near

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
SAME_MM = 1.0
REACHES_MM = 45.0
"""A surface in a hole whose plane is that of contacts so near to it is part of what they met."""
UNEXPLAINED_MM = 5.0
AGREES_MM = 10.0
"""A ping confirms what lies this near to its foot."""


def find_plates(state: State, cells: Cells, spoken: Heard) -> None:
    """Explain contradicting pings by surfaces, the one that most of them met first; then say what is left."""
    refused = np.zeros(len(state.found.apertures), dtype=np.bool_)
    settled = refused.copy()
    for _ in range(PLATES):
        odd = _contradicting(state)
        chosen = _next_plate(state, odd, refused, cells, spoken)
        chosen = chosen or _next_curved(state, odd & ~settled, cells, spoken)
        if chosen is None:
            break
        patch, below, state = chosen
        cells.put(patch, below.scene.height_mm)
        settled[_inside(state, patch)] = True
    for patch in cells.in_holes:
        left = patch.mask & cells.open  # plates found later cover the rest
        if left.any():
            cells.put(replace(patch, mask=left), cells.ground_mm)
    if cells.beside.any():
        state = _straighten(state, cells, spoken)
    odd = _contradicting(state)
    for cluster in clusters(state.found, np.nonzero(odd & ~settled)[0]):
        state = _unexplained(state, cluster, cells)
    odd = _contradicting(state)
    _judge_dark(state, cells, odd)
    cells.account(account(state, odd, cells.claims()))


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
) -> tuple[Patch, State, State] | None:
    """The next surface that explains contradicting pings, what is below it, and the state with it.

    Pings of seeds that do not are marked as refused.
    """
    while True:
        asked = np.nonzero(odd & ~refused & _off_surface(state, spoken))[0]
        proposals = seeds(spoken, asked) or _by_height(state, np.nonzero(odd & ~refused)[0])
        if not proposals:
            return None
        for seed in proposals:
            same = [patch for patch in cells.in_holes if _coplanar(patch, seed, state.scene.field)]
            rest = [patch for patch in cells.in_holes if not any(patch is other for other in same)]
            also = _union(same, cells.dark.shape)
            base = state.with_heights(np.where(also, cells.ground_mm, state.scene.height_mm), also) if same else state
            light = Light(cells.seen, cells.open & ~_union(rest, cells.dark.shape))
            chosen = plate(base, seed, light, also)
            if chosen is not None:
                cells.in_holes = rest
                return chosen
            refused[seed.which] = True


def _next_curved(
    state: State, odd: NDArray[np.bool_], cells: Cells, spoken: Heard
) -> tuple[Patch, State, State] | None:
    """A smooth surface that bends, through what no plane explains, what is below it, and the state with it."""
    above = odd & (first_height_mm(state.found, spoken) > _height_below_mm(state, state.found.foot_mm) + OFF_SURFACE_MM)
    for cluster in clusters(state.found, np.nonzero(above)[0]):
        seed = curved_seed(state.found, spoken, cluster)
        nowhere = np.zeros(cells.dark.shape, dtype=np.bool_)
        chosen = plate(state, seed, Light(cells.seen, cells.open), nowhere) if seed is not None else None
        if chosen is not None:
            return chosen
    return None


def _coplanar(patch: Patch, seed: Seed, field: MapField) -> bool:
    """Whether a surface in a hole goes on, beside the hole, as the plane that some pings met."""
    apart_mm = np.abs(seed.plane.image(field) - patch.plane.image(field))[patch.mask]
    near = cells_near(seed.place_mm, field, REACHES_MM) & patch.mask
    return bool(near.any() and np.median(apart_mm) <= SAME_MM)


def _union(patches: Sequence[Patch], shape: tuple[int, int]) -> Mask:
    """Cells of any of some surfaces."""
    return np.any([np.zeros(shape, dtype=np.bool_), *(patch.mask for patch in patches)], axis=0)


def _by_height(state: State, odd: NDArray[np.int64]) -> list[Seed]:
    """Seeds where contacts tell no plane, as in a narrow band or with receivers a little off their places."""
    regions = clusters(state.found, odd)
    return seeds_by_height(state, regions[0]) if regions else []


def _off_surface(state: State, spoken: Heard) -> NDArray[np.bool_]:
    """Pings that met something above the surface, (pings,)."""
    place = np.nan_to_num(spoken.place_mm, nan=-1e9)
    return np.abs(place[:, 2] - _height_below_mm(state, place)) > OFF_SURFACE_MM


def _height_below_mm(state: State, place_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of the surface below places (n, 2 or more); of the field's edge beyond it."""
    field = state.scene.field
    rows, columns = field.shape
    i = np.clip((place_mm[:, 0] - field.x_mm[0]) / field.cell_mm, 0, columns - 1).astype(np.int64)
    j = np.clip((place_mm[:, 1] - field.y_mm[0]) / field.cell_mm, 0, rows - 1).astype(np.int64)
    return state.scene.height_mm[j, i]


def _inside(state: State, patch: Patch) -> NDArray[np.int64]:
    """Pings whose foot, or mirror point, lies in a patch or at its rim: they have their explanation."""
    field = state.scene.field
    return pings_near(state.found, patch.mask, field, RIM_MM, patch.plane)


def _judge_dark(state: State, cells: Cells, odd: NDArray[np.bool_]) -> None:
    """What light did not see and no surface fills has the height of what is beside it, if the echoes say so."""
    cells.doubt_steps()
    left = cells.open | cells.holed
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
        cells.hides(missing)
        return state.without(missing)
    mask = cells_near(foot, state.scene.field, UNEXPLAINED_MM)
    cells.unknown(mask, f"light and sound disagree in {{cells}} cells {where}, and no plate explains it: unknown")
    return state
