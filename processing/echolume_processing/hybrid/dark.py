"""Surfaces that light returned nothing from: planes that fill optical holes."""

from __future__ import annotations

import numpy as np

from echolume_messages.types import Label
from echolume_processing.hybrid.heard import Heard, seeds
from echolume_processing.hybrid.hypotheses import (
    ACCEPTED,
    JUDGED_MM,
    LEAST_MM2,
    NEIGHBOUR_MM,
    SNAP_MM,
    Patch,
)
from echolume_processing.hybrid.plates import Plane, fit_plane, ping_heights
from echolume_processing.hybrid.scipy_typed import Mask, depth_inside, distance_to, opened
from echolume_processing.hybrid.settle import settle
from echolume_processing.hybrid.state import State, cells_near, centres_mm, pings_inside, pings_near, residual_of
from echolume_processing.hybrid.tiles import occupancy, tiles_over

INSIDE_MM = 5.0
"""A ping counts as over a hole if its foot is this far inside; less in a small one."""
CANDIDATES = 4
APART_MM = 3.0
"""So many heights are tried for a hole, so far apart."""
EXPLAINED = 0.2
"""A residual energy below this share of the measured one is an explanation in itself."""
LEAST_OVER_HOLE = 2
JUDGES = 80
"""So many judges are enough to accept or refuse a surface."""
KEPT = 0.3
"""Cells of a hole of which sound finds less than this covered do not belong to the surface in it."""
SHADOW_MM = 3.0
"""Narrower strips of such cells are within what sound resolves."""


def absorbing(state: State, hole: Mask, heard: Heard) -> Patch | None:
    """The plane that fills an optical hole, or most of it; None if sound finds none.

    None as well if the ground beside the hole, continued into it, is what the pings over it met.
    """
    found, field = state.found, state.scene.field
    deepest_mm = float(depth_inside(hole).max()) * field.cell_mm
    over = pings_inside(found, hole, field, min(INSIDE_MM, 0.3 * deepest_mm))
    if over.size < LEAST_OVER_HOLE:
        return None
    judges = over[:: max(1, over.size // JUDGES)]
    if (found.residual(state.predicted[over], over) <= EXPLAINED).all():
        return None
    before = residual_of(found, state.predicted[judges], judges)
    heights = ping_heights(found, judges)
    middle = found.foot_mm[over].mean(axis=0)
    level = [Plane(float(middle[0]), float(middle[1]), z) for z in heights.candidates(CANDIDATES, APART_MM)]
    seen = seeds(heard, over)[:1]
    planes = [*level, fit_plane(found, heights, True), *(seed.plane for seed in seen)]
    plane, ambiguous = settle(state, hole, planes, judges)
    any_over = pings_inside(found, hole, field, 0.0)
    near = cells_near(plane.mirror_points(centres_mm(found)[any_over]), field, NEIGHBOUR_MM)
    mask = _within(state, hole & near, plane)
    if mask.sum() * field.cell_mm**2 < LEAST_MM2 / 2:
        return None
    after = residual_of(found, found.predict(state.scene_with(mask, plane), judges), judges)
    if after >= max(EXPLAINED, ACCEPTED * before):
        return None
    centre = centres_mm(found)[judges]
    off_mm = heights.height_mm - plane.at(centre[:, 0], centre[:, 1])
    spread_mm = seen[0].spread_mm if seen else 1.4826 * float(np.median(np.abs(off_mm)))
    sigma_mm = max(0.05, spread_mm / float(np.sqrt(over.size)))
    return Patch(mask, plane, sigma_mm, int(over.size), ambiguous, Label.ABSORBING, over, after / before)


def _within(state: State, hole: Mask, plane: Plane) -> Mask:
    """The cells of a hole that a plane fills, by sound: shadows beside what is dark do not belong to it."""
    field = state.scene.field
    if not hole.any():
        return hole
    judges = pings_near(state.found, hole, field, JUDGED_MM, plane)
    tiles = tiles_over(distance_to(hole) * field.cell_mm <= SNAP_MM)
    share = occupancy(state.found, state.scene, state.predicted[judges], judges, plane, tiles).share
    bare = hole & (tiles.fine(np.where(tiles.grid >= 0, share[tiles.grid], 0.0), hole.shape) < KEPT)
    return hole & ~opened(bare, max(1, round(SHADOW_MM / field.cell_mm)))
