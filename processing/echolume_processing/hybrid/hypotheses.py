"""Plates that light goes through: proposed by a plane that pings met, and explained tile by tile."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import Label
from echolume_processing.hybrid.heard import Seed
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.outline import straightened
from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.rims import LitRim, lit_rim
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints, depth_inside, distance_to, labelled
from echolume_processing.hybrid.settle import is_narrow, settle
from echolume_processing.hybrid.state import State, cells_near, pings_inside, pings_near, residual_of
from echolume_processing.hybrid.tiles import covered, occupancy, tiles_over, without_pinholes

JUDGED_MM = 30.0
"""Pings whose foot or mirror point is this near to a region judge it."""
ACCEPTED = 0.6
"""A surface must bring the residual energy below this share of what it was."""
INSIDE_LEFT = 0.45
"""Over a plate's own cells, or where pings met it, no more than this of the measured energy may be left over."""
OVER_MM = 5.0
LEAST_TO_TURN = 6
"""The tilt of a plate is refined by so many pings or more: that met it, or whose mirror points lie so far inside."""
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
"""Between the rim of a surface as sound sees it and as light does may lie so much."""
INNER_MM = 3.0
THROUGH = 0.15
"""Light goes through a plate if it sees something below in so much of what lies deeper inside its outline."""
RIM_CELLS = 2
RIM_MM = 6.0
"""The rim of a plate is sought again so far in and out, with tiles of so many cells."""
STRAIGHT = 1.02
"""An outline with straight sides may leave so much more over."""


@dataclass(frozen=True)
class Light:
    """What light says of each cell."""

    seen: Mask
    dark: Mask
    """Where it returned nothing, and nobody knows yet what is there."""


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
    which: NDArray[np.int64]
    """Pings that met it: those that proposed it, and those whose mirror point lies in it."""
    left: float
    """Residual energy of the pings that judged it, with it over without it."""
    rim: Mask | None = None
    """Cells of which light sees just the plate's rim."""
    bent: Mask | None = None
    """Cells of which light sees the ground too high, through the plate."""
    doubt_mm: NDArray[np.float64] | None = None
    """One sigma more of each cell, where the surface goes on from where pings met it; image."""


def plate(state: State, seed: Seed, light: Light, also: Mask) -> tuple[Patch, State, State] | None:
    """The surface in the plane of a seed that explains its pings; None if it does not.

    Parameters
    ----------
    state
        What is believed so far; it predicts these pings badly.
    seed
        A plane, the pings that met it and where.
    light
        Which cells light saw, and which are dark.
    also
        Cells where the surface may lie too, though those pings did not meet it there.

    Returns
    -------
    tuple of Patch, State, State
        The surface, what is below it, and the state with it.
    """
    found, field = state.found, state.scene.field
    mask, judges = _extent(state, seed, also)
    if seed.plane.bent:  # it ends where it meets the ground
        mask &= seed.plane.image(field) > state.scene.height_mm + LEAST_RISE_MM
    if mask.sum() * field.cell_mm**2 < LEAST_MM2:
        return None
    rim = lit_rim(state, mask, seed.plane, light.seen)
    state = rim.state
    over = np.union1d(seed.which, pings_inside(found, mask, field, OVER_MM, seed.plane))
    plane, ambiguous = settle(state, mask, _planes(state, seed), over, turns=over.size >= LEAST_TO_TURN)
    rise_mm = plane.image(field) - state.scene.height_mm
    if float(np.median(rise_mm[mask])) < LEAST_RISE_MM:
        return None
    is_dark = not _goes_through(mask, light.seen & ~rim.lit & (rise_mm > LEAST_RISE_MM), field.cell_mm)
    if is_dark:
        mask = light.dark & (distance_to(mask) * field.cell_mm <= SNAP_MM)
    ways = [(hangs, state.with_patch(mask, plane, hangs=hangs)) for hangs in (False, True)]
    before = residual_of(found, state.predicted[judges], judges)
    after = [residual_of(found, believed.predicted[judges], judges) for _, believed in ways]
    hangs, believed = ways[int(np.argmin(after))]
    if min(after) >= ACCEPTED * before:
        return None
    if not is_dark:
        mask = _rim(state, believed, mask, plane, judges, rim)
        believed = state.with_patch(mask, plane, hangs=hangs)
        mask, believed = _straight(state, believed, mask, plane, judges)
    inside = pings_inside(found, mask, field, 0.0, plane)
    asked = inside if inside.size else seed.which
    if residual_of(found, believed.predicted[asked], asked) > INSIDE_LEFT:
        return None
    label = Label.ABSORBING if is_dark else Label.TRANSPARENT
    pings, left = int(seed.which.size), residual_of(found, believed.predicted[judges], judges) / before
    which = np.union1d(seed.which, inside)
    patch = Patch(mask, plane, seed.sigma_mm, pings, ambiguous, label, which, left, rim.lit, rim.bent)
    return replace(patch, doubt_mm=_beyond_mm(seed, field)), state, believed


def _beyond_mm(seed: Seed, field: MapField) -> NDArray[np.float64] | None:
    """How far a bent surface may be from where it is said to go on: by what a parabola leaves an arc."""
    plane = seed.plane
    if not plane.bent:
        return None
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(field))
    away_mm, _ = NearestPoints(seed.place_mm).nearest(np.column_stack((x_mm.ravel(), y_mm.ravel())))
    bend = max(abs(plane.bend_xx), abs(plane.bend_yy), abs(plane.bend_xy))
    return (bend**3 * away_mm**4 / 8).reshape(field.shape)


def _planes(state: State, seed: Seed) -> list[Plane]:
    """The plane of a seed, and the level one through the same contacts: the normals of a few contacts err."""
    if is_narrow(state.found) or seed.plane.level or seed.plane.bent:
        return [seed.plane]
    x, y = seed.place_mm.mean(axis=0)
    return [seed.plane, Plane(float(x), float(y), float(seed.plane.at(np.array([x]), np.array([y]))[0]))]


def _goes_through(mask: Mask, below: Mask, cell_mm: float) -> bool:
    """Whether light sees through a surface; `below` is where it sees something under the surface's plane."""
    inner = depth_inside(mask) * cell_mm > INNER_MM
    where = inner if inner.any() else mask
    return bool((below & where).sum() >= THROUGH * where.sum())


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
    pings = int(seed.which.size)
    patch = Patch(mask, seed.plane, seed.sigma_mm, pings, False, Label.MATTE, seed.which, after / before)
    return patch, believed


def _extent(state: State, seed: Seed, also: Mask) -> tuple[Mask, NDArray[np.int64]]:
    """Cells that a plate in the plane of a seed covers, and the pings that judge it.

    Sought around where pings met it, and further on as long as it reaches the end of what was searched.
    """
    found, field = state.found, state.scene.field
    window = cells_near(seed.place_mm, field, NEIGHBOUR_MM) | also
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


def _rim(state: State, believed: State, mask: Mask, plane: Plane, judges: NDArray[np.int64], rim: LitRim) -> Mask:
    """The mask with its rim found again on small tiles."""
    share = rim_shares(state, believed, mask, plane, judges)
    fine = _largest(without_pinholes(share > rim.share_at(share), state.scene.field.cell_mm))
    return fine if fine.any() else mask


def rim_shares(
    state: State, believed: State, mask: Mask, plane: Plane | None, judges: NDArray[np.int64]
) -> NDArray[np.float64]:
    """How much of each cell is covered, near to the rim of a mask: on small tiles, from what the mask leaves over.

    Parameters
    ----------
    state, believed
        What is below, and the state with what covers it within the mask.
    plane
        What covers it; None: something without an echo.
    """
    field = state.scene.field
    depth_mm = np.where(mask, depth_inside(mask), distance_to(mask)) * field.cell_mm
    tiles = tiles_over(depth_mm <= RIM_MM, RIM_CELLS)
    start = tiles.mean(mask)
    at = tiles.grid >= 0
    already = np.zeros(tiles.corners.shape[0])
    already[tiles.grid[at]] = start[at]
    share = occupancy(state.found, state.scene, believed.predicted[judges], judges, plane, tiles, already).share
    coarse = start.copy()
    coarse[at] = share[tiles.grid[at]]
    return tiles.fine(coarse, mask.shape)


def _straight(state: State, believed: State, mask: Mask, plane: Plane, judges: NDArray[np.int64]) -> tuple[Mask, State]:
    """The mask with straight sides that meet in corners, and the state with it, if the echoes do not object."""
    straight = straightened(mask, state.scene.field.cell_mm)
    if not straight.any() or np.array_equal(straight, mask):
        return mask, believed
    hangs = believed.scene.hanging is not state.scene.hanging
    other = state.with_patch(straight, plane, hangs=hangs)
    before, after = (residual_of(state.found, s.predicted[judges], judges) for s in (believed, other))
    return (straight, other) if after <= STRAIGHT * before else (mask, believed)


def _largest(mask: Mask) -> Mask:
    """The largest connected piece."""
    labels, number = labelled(mask)
    if number <= 1:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == int(sizes.argmax())
