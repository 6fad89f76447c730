"""Which pings speak for each cell of a finished surface, and whether they agree with it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_processing.hybrid.certainty import Verdict
from echolume_processing.hybrid.hypotheses import Patch
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints
from echolume_processing.hybrid.sounding import Sounding
from echolume_processing.hybrid.state import State, centres_mm

CONFIRMS_MM = 10.0
"""A ping speaks for what light saw this near to its foot."""
MIRROR_MM = 15.0
"""And for a surface that it met, this near to its mirror point there."""


@dataclass(frozen=True)
class Claims:
    """What is claimed of each cell; images of one shape."""

    field: MapField
    label: NDArray[np.uint8]
    claimed: Mask
    """Cells with a height."""
    patches: Sequence[Patch]
    of_patch: NDArray[np.int64]
    """Which of the patches each cell belongs to; -1: none."""


@dataclass(frozen=True)
class Accounts:
    """Pings by cell."""

    cell: NDArray[np.int64]
    """Flat index of the cell of each pair (n,)."""
    ping: NDArray[np.int64]
    """Place of its ping among those of the scan (n,)."""
    nearest: NDArray[np.int64]
    """The ping of each cell that is nearest to it, image; -1: none."""
    verdict: NDArray[np.uint8]
    """`Verdict` of each cell, image."""


@dataclass(frozen=True)
class Pairs:
    """Cells and pings near to them, with their distance; all (n,)."""

    cell: NDArray[np.int64]
    ping: NDArray[np.int64]
    away_mm: NDArray[np.float64]


def account(state: State, odd: NDArray[np.bool_], claims: Claims) -> Accounts:
    """Say for each cell which pings explain it.

    Parameters
    ----------
    state
        What is believed in the end.
    odd
        Pings that contradict it all the same, (pings,).
    claims
        What each cell is called.

    Notes
    -----
    A surface that sound found has the pings that met it with their mirror point within `MIRROR_MM`, or else the nearest
    of those that met it. Any other cell with a height has the pings that agree with the surface and whose foot is
    within `CONFIRMS_MM`: they confirm it. Cells without a height rest on no ping.
    """
    field, found = claims.field, state.found
    foot_mm = found.foot_mm
    parts = [
        _met(found, patch, claims.of_patch == k, field)
        for k, patch in enumerate(claims.patches)
        if (claims.of_patch == k).any()
    ]
    plain = (claims.of_patch < 0) & claims.claimed
    agreeing, contradicting = np.nonzero(~odd)[0], np.nonzero(odd)[0]
    parts.append(within(foot_mm[agreeing], agreeing, plain, field, CONFIRMS_MM))
    pairs = Pairs(*(np.concatenate([getattr(p, n) for p in parts]) for n in ("cell", "ping", "away_mm")))
    against = within(foot_mm[contradicting], contradicting, plain, field, CONFIRMS_MM)
    return Accounts(pairs.cell, pairs.ping, nearest(pairs, field), _verdict(pairs, against, odd, field))


def _met(found: Sounding, patch: Patch, mask: Mask, field: MapField) -> Pairs:
    """Pings that met a patch, by cell of it."""
    place_mm = patch.plane.mirror_points(centres_mm(found)[patch.which])[:, :2]
    near = within(place_mm, patch.which, mask, field, MIRROR_MM)
    left = mask.copy()
    left.ravel()[near.cell] = False
    if not left.any():
        return near
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(field))
    away_mm, index = NearestPoints(place_mm).nearest(np.column_stack((x_mm[left], y_mm[left])))
    return Pairs(
        np.concatenate((near.cell, np.flatnonzero(left))),
        np.concatenate((near.ping, patch.which[index])),
        np.concatenate((near.away_mm, away_mm)),
    )


def within(
    place_mm: NDArray[np.float64], number: NDArray[np.int64], mask: Mask, field: MapField, reach_mm: float
) -> Pairs:
    """Cells of a mask whose centre is within a reach of places (n, 2), with the numbers (n,) of the places."""
    reach = int(np.ceil(reach_mm / field.cell_mm)) + 1
    dy, dx = (axis.ravel() for axis in np.mgrid[-reach : reach + 1, -reach : reach + 1])
    x_mm, y_mm = cell_centres_mm(field)
    rows, columns = field.shape
    i = np.floor((place_mm[:, 0] - field.x_mm[0]) / field.cell_mm).astype(np.int64)[:, None] + dx
    j = np.floor((place_mm[:, 1] - field.y_mm[0]) / field.cell_mm).astype(np.int64)[:, None] + dy
    inside = (i >= 0) & (i < columns) & (j >= 0) & (j < rows)
    which = np.broadcast_to(np.arange(number.size)[:, None], i.shape)[inside]
    i, j = i[inside], j[inside]
    away_mm = np.hypot(x_mm[i] - place_mm[which, 0], y_mm[j] - place_mm[which, 1])
    near = (away_mm <= reach_mm) & mask[j, i]
    return Pairs((j * columns + i)[near], number[which[near]], away_mm[near])


def nearest(pairs: Pairs, field: MapField) -> NDArray[np.int64]:
    """The nearest ping of each cell, image; of two as near the earlier one; -1: none."""
    order = np.lexsort((pairs.ping, pairs.away_mm, pairs.cell))
    cell = pairs.cell[order]
    first = np.append(True, cell[1:] != cell[:-1]) if cell.size else np.zeros(0, dtype=np.bool_)
    out = np.full(field.shape, -1, dtype=np.int64)
    out.ravel()[cell[first]] = pairs.ping[order][first]
    return out


def _verdict(pairs: Pairs, against: Pairs, odd: NDArray[np.bool_], field: MapField) -> NDArray[np.uint8]:
    """Whether the nearest ping of all that reach a cell agrees with it, image."""
    every = Pairs(*(np.concatenate((getattr(pairs, n), getattr(against, n))) for n in ("cell", "ping", "away_mm")))
    last = nearest(every, field)
    return np.where(last < 0, Verdict.NOTHING, np.where(odd[last], Verdict.CONTRADICTS, Verdict.AGREES)).astype(
        np.uint8
    )
