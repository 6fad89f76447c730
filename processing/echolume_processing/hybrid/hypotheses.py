"""Surfaces that only sound knows: absorbing ones that fill optical holes, and plates that light goes through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.types import Label
from echolume_processing.hybrid.heard import Heard, Seed, seeds
from echolume_processing.hybrid.outline import straightened
from echolume_processing.hybrid.plates import Plane, fit_plane, ping_heights
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints, depth_inside, distance_to, labelled, opened
from echolume_processing.hybrid.sounding import Sounding
from echolume_processing.hybrid.state import State, cells_near, centres_mm, pings_inside, pings_near, residual_of
from echolume_processing.hybrid.tiles import covered, occupancy, tiles_over, without_pinholes

INSIDE_MM = 5.0
"""A ping counts as over a hole if its foot is this far inside; less in a small one."""
CANDIDATES = 4
APART_MM = 3.0
"""So many heights are tried for a hole, so far apart."""
EXPLAINED = 0.2
"""A residual energy below this share of the measured one is an explanation in itself."""
LEAST_PINGS = 3
LEAST_OVER_HOLE = 2
JUDGED_MM = 30.0
"""Pings whose foot or mirror point is this near to a region judge it."""
JUDGES = 80
"""So many judges are enough to accept or refuse a surface."""
STEP_MM = 0.3
"""Step of the parabola through three heights."""
ACCEPTED = 0.6
"""A surface must bring the residual energy below this share of what it was."""
INSIDE_LEFT = 0.45
"""Over a plate's own cells no more than this of the measured energy may be left over."""
CLOSE_MM = 2.0
"""Pings whose own height is this near to a plane may have met it."""
LEVEL_FIRST = 0.95
"""A tilted plane must explain so much better than a level one."""
LEAST_MM2 = 150.0
LEAST_RISE_MM = 1.5
NEIGHBOUR_MM = 14.0
"""Cells this near to where a ping met a plate may belong to it."""
BENT_MM = (0.3, 4.0)
"""Through a plate a camera sees the ground too high by so much."""
GROWS = 3
END_MM, LEAST_AT_END_MM2 = 3.0, 40.0
"""A plate of which so much lies so near to the end of what was searched may reach further."""
SNAP_MM = 4.0
"""Between the rim of a dark surface as sound sees it and as light does may lie so much."""
DARK_SHARE = 0.5
"""A surface that light is missing over so much of is not one that light goes through."""
KEPT = 0.3
"""Cells of a hole of which sound finds less than this covered do not belong to the surface in it."""
SHADOW_MM = 3.0
"""Narrower strips of such cells are within what sound resolves."""
RIM_CELLS = 2
RIM_MM = 6.0
"""The rim of a plate is sought again so far in and out, with tiles of so many cells."""
VANISHED = 0.8
"""Missing echoes must bring the residual energy below this share of what it was."""
STRAIGHT = 1.02
"""An outline with straight sides may leave so much more over."""
NARROW = 0.3
"""Below this relative bandwidth a height is only known up to half a wavelength, unless the echoes say more."""
RIVAL = 1.15
"""A rival height whose residual is below this times the best one cannot be told from it."""


@dataclass(frozen=True)
class Patch:
    """A surface found by sound."""

    mask: Mask
    plane: Plane
    sigma_mm: float
    pings: int
    ambiguous: bool
    """Another height, half a wavelength off, explains the echoes as well."""
    label: Label
    """Absorbing: light returned nothing from most of it; transparent: light goes through; matte: light sees it, bent by
    a plate beside it."""


def absorbing(state: State, hole: Mask, heard: Heard) -> Patch | None:
    """The plane that fills an optical hole, or most of it; None if sound finds none."""
    found, field = state.found, state.scene.field
    deepest_mm = float(depth_inside(hole).max()) * field.cell_mm
    over = pings_inside(found, hole, field, min(INSIDE_MM, 0.3 * deepest_mm))
    if over.size < LEAST_OVER_HOLE:
        return None
    judges = over[:: max(1, over.size // JUDGES)]
    before = residual_of(found, state.predicted[judges], judges)
    heights = ping_heights(found, judges)
    middle = found.foot_mm[over].mean(axis=0)
    level = [Plane(float(middle[0]), float(middle[1]), z) for z in heights.candidates(CANDIDATES, APART_MM)]
    seen = seeds(heard, over)[:1]
    planes = [*level, fit_plane(found, heights, True), *(seed.plane for seed in seen)]
    plane, ambiguous = _settle(state, hole, planes, judges)
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
    return Patch(mask, plane, sigma_mm, int(over.size), ambiguous, Label.ABSORBING)


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


def plate(state: State, seed: Seed, dark: Mask) -> tuple[Patch, State] | None:
    """The surface in the plane of a seed that explains its pings, and the state with it; None if it does not.

    Parameters
    ----------
    state
        What is believed so far; it predicts these pings badly.
    seed
        A plane, the pings that met it and where.
    dark
        Where light returned nothing.
    """
    found, field = state.found, state.scene.field
    mask, judges = _extent(state, seed)
    if mask.sum() * field.cell_mm**2 < LEAST_MM2:
        return None
    plane, ambiguous = _settle(state, mask, [seed.plane], seed.which)
    rise_mm = float(np.median((plane.image(field) - state.scene.height_mm)[mask]))
    if rise_mm < LEAST_RISE_MM:
        return None
    is_dark = bool((mask & dark).sum() >= DARK_SHARE * mask.sum())
    if is_dark:
        mask = dark & (distance_to(mask) * field.cell_mm <= SNAP_MM)
    ways = [(hangs, state.with_patch(mask, plane, hangs=hangs)) for hangs in (False, True)]
    before = residual_of(found, state.predicted[judges], judges)
    after = [residual_of(found, believed.predicted[judges], judges) for _, believed in ways]
    hangs, believed = ways[int(np.argmin(after))]
    if min(after) >= ACCEPTED * before:
        return None
    if not is_dark:
        mask = _rim(state, believed, mask, plane, judges)
        believed = state.with_patch(mask, plane, hangs=hangs)
        mask, believed = _straight(state, believed, mask, plane, judges)
    inside = pings_inside(found, mask, field, 0.0, plane)
    if inside.size and residual_of(found, believed.predicted[inside], inside) > INSIDE_LEFT:
        return None
    label = Label.ABSORBING if is_dark else Label.TRANSPARENT
    return Patch(mask, plane, seed.sigma_mm, int(seed.which.size), ambiguous, label), believed


def bent(state: State, seed: Seed, beside: Mask) -> tuple[Patch, State] | None:
    """The ground where light sees it too high, bent by a plate beside it, and the state with it; None if it is not so.

    Parameters
    ----------
    beside
        Cells near to the rim of a plate, of which sound has not said anything.
    """
    found, field = state.found, state.scene.field
    too_high_mm = state.scene.height_mm - seed.plane.image(field)
    near = cells_near(seed.place_mm, field, NEIGHBOUR_MM)
    mask = near & beside & (too_high_mm > BENT_MM[0]) & (too_high_mm < BENT_MM[1])
    if mask.sum() * field.cell_mm**2 < LEAST_MM2:
        return None
    believed = state.with_patch(mask, seed.plane)
    before, after = (residual_of(found, s.predicted[seed.which], seed.which) for s in (state, believed))
    if after >= ACCEPTED * before:
        return None
    return Patch(mask, seed.plane, seed.sigma_mm, int(seed.which.size), False, Label.MATTE), believed


def _extent(state: State, seed: Seed) -> tuple[Mask, NDArray[np.int64]]:
    """Cells that a plate in the plane of a seed covers, and the pings that judge it.

    Sought around where pings met it, and further on as long as it reaches the end of what was searched.
    """
    found, field = state.found, state.scene.field
    window = cells_near(seed.place_mm, field, NEIGHBOUR_MM)
    mask, judges = np.zeros_like(window), seed.which
    for _ in range(GROWS):
        judges = pings_near(found, window, field, JUDGED_MM, seed.plane)
        tiles = tiles_over(window)
        share = occupancy(found, state.scene, state.predicted[judges], judges, seed.plane, tiles).share
        mask = _largest(covered(share, tiles, window.shape, field.cell_mm))
        at_end = mask & (distance_to(~window) * field.cell_mm <= END_MM)
        if at_end.sum() * field.cell_mm**2 < LEAST_AT_END_MM2:
            break
        window |= distance_to(at_end) * field.cell_mm <= NEIGHBOUR_MM
    return mask, judges


def _rim(state: State, believed: State, mask: Mask, plane: Plane, judges: NDArray[np.int64]) -> Mask:
    """The mask with its rim found again on small tiles, from what the plate so far leaves over."""
    field = state.scene.field
    depth_mm = np.where(mask, depth_inside(mask), distance_to(mask)) * field.cell_mm
    band = depth_mm <= RIM_MM
    tiles = tiles_over(band, RIM_CELLS)
    start = tiles.mean(mask)
    at = tiles.grid >= 0
    already = np.zeros(tiles.corners.shape[0])
    already[tiles.grid[at]] = start[at]
    share = occupancy(state.found, state.scene, believed.predicted[judges], judges, plane, tiles, already).share
    coarse = start.copy()
    coarse[at] = share[tiles.grid[at]]
    fine = _largest(without_pinholes(tiles.fine(coarse, mask.shape) > 0.5, field.cell_mm))
    return fine if fine.any() else mask


def _straight(state: State, believed: State, mask: Mask, plane: Plane, judges: NDArray[np.int64]) -> tuple[Mask, State]:
    """The mask with straight sides that meet in corners, and the state with it, if the echoes do not object."""
    straight = straightened(mask, state.scene.field.cell_mm)
    if not straight.any() or np.array_equal(straight, mask):
        return mask, believed
    hangs = believed.scene.hanging is not state.scene.hanging
    other = state.with_patch(straight, plane, hangs=hangs)
    before, after = (residual_of(state.found, s.predicted[judges], judges) for s in (believed, other))
    return (straight, other) if after <= STRAIGHT * before else (mask, believed)


def seeds_by_height(found: Sounding, cluster: NDArray[np.int64]) -> list[Seed]:
    """A level and a tilted plane through the heights of some pings, for echoes from which no contact can be told."""
    heights = ping_heights(found, cluster)
    centre, out = centres_mm(found)[cluster], list[Seed]()
    for tilted in (False, True):
        plane = fit_plane(found, heights, tilted)
        if tilted and plane.slope_x == plane.slope_y == 0.0:
            continue
        off_mm = np.abs(heights.height_mm - plane.at(centre[:, 0], centre[:, 1]))
        close = off_mm <= CLOSE_MM
        if close.sum() >= LEAST_PINGS:
            spread_mm = 1.4826 * float(np.median(off_mm[close]))
            out.append(Seed(plane, cluster[close], found.foot_mm[cluster], spread_mm))
    return out


def vanished(state: State, cluster: NDArray[np.int64]) -> Mask | None:
    """Where the echo of the surface is missing and nothing came back instead; None if that explains nothing.

    Notes
    -----
    A smooth plate that throws sound elsewhere hides what lies below it without an echo of its own.
    """
    found, field = state.found, state.scene.field
    window = cells_near(found.foot_mm[cluster], field, NEIGHBOUR_MM)
    judges = pings_near(found, window, field, JUDGED_MM)
    tiles = tiles_over(window)
    missing = occupancy(found, state.scene, state.predicted[judges], judges, None, tiles)
    if missing.explained >= VANISHED:
        return None
    mask = covered(missing.share, tiles, window.shape, field.cell_mm)
    return mask if mask.any() else None


def clusters(found: Sounding, anomalous: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Groups of neighbouring anomalous pings, each sorted; neighbours are up to 1.6 times the scan's pitch apart."""
    if anomalous.size < LEAST_PINGS:
        return []
    foot = found.foot_mm
    pairs = NearestPoints(foot[anomalous]).pairs(1.6 * NearestPoints(foot).spacing())
    group = np.arange(anomalous.size)
    for _ in range(anomalous.size):
        low = np.minimum(group[pairs[:, 0]], group[pairs[:, 1]])
        new = group.copy()
        np.minimum.at(new, pairs[:, 0], low)
        np.minimum.at(new, pairs[:, 1], low)
        if np.array_equal(new, group):
            break
        group = new
    found_groups = [anomalous[group == g] for g in np.unique(group)]
    return sorted((g for g in found_groups if g.size >= LEAST_PINGS), key=lambda g: (-g.size, int(g[0])))


def _largest(mask: Mask) -> Mask:
    """The largest connected piece."""
    labels, number = labelled(mask)
    if number <= 1:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == int(sizes.argmax())


def is_narrow(found: Sounding) -> bool:
    """Whether the band is too narrow for one height to be told from the next."""
    return found.band.high_hz - found.band.low_hz < NARROW * found.band.low_hz


def _settle(state: State, mask: Mask, planes: list[Plane], over: NDArray[np.int64]) -> tuple[Plane, bool]:
    """Choose a plane and refine its height on the pings right over it; and whether another height is as good."""
    judges = over[:: max(1, over.size // 16)]
    near = state.scene_with(mask, planes[0])

    def cost(plane: Plane) -> float:
        return residual_of(state.found, state.found.predict(state.scene_with(mask, plane, near), judges), judges)

    costs = [cost(p) * (1.0 if p.slope_x == p.slope_y == 0.0 else 1 / LEVEL_FIRST) for p in planes]
    best = int(np.argmin(costs))
    plane, level = planes[best], costs[best]
    half_wave_mm = 1e3 * state.found.speed_mps / (state.found.band.low_hz + state.found.band.high_hz)
    narrow = is_narrow(state.found)
    if narrow:
        plane, level = _slip(plane, level, half_wave_mm, cost)
    plane, level = _parabola(plane, cost)
    rivals = [cost(plane.raised(s * half_wave_mm)) for s in (-1, 1)] if narrow else []
    return plane, any(r < RIVAL * level for r in rivals)


def _slip(plane: Plane, level: float, half_wave_mm: float, cost: Callable[[Plane], float]) -> tuple[Plane, float]:
    """The best of the heights that differ by whole half wavelengths."""
    rivals = [plane.raised(n * half_wave_mm) for n in (-3, -2, -1, 1, 2, 3)]
    costs = [cost(r) for r in rivals]
    k = int(np.argmin(costs))
    return (rivals[k], costs[k]) if costs[k] < level else (plane, level)


def _parabola(plane: Plane, cost: Callable[[Plane], float]) -> tuple[Plane, float]:
    """Refine a height by the parabola through three residuals, at most `STEP_MM` away."""
    below, level, above = (cost(plane.raised(step)) for step in (-STEP_MM, 0.0, STEP_MM))
    bend = below - 2 * level + above
    if bend <= 0:
        return plane, level
    shift_mm = float(np.clip(0.5 * (below - above) / bend, -1.0, 1.0)) * STEP_MM
    return plane.raised(shift_mm), level - 0.125 * (below - above) ** 2 / bend
