"""Pings that contradict the surface, in groups, and what each group proposes where contacts tell no plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_processing.hybrid.heard import Seed
from echolume_processing.hybrid.hypotheses import JUDGED_MM, LEAST_MM2, NEIGHBOUR_MM, rim_shares
from echolume_processing.hybrid.plates import Plane, fit_plane, ping_heights
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints, labelled
from echolume_processing.hybrid.settle import is_narrow
from echolume_processing.hybrid.sounding import Sounding
from echolume_processing.hybrid.state import State, cells_near, centres_mm, pings_near
from echolume_processing.hybrid.tiles import covered, occupancy, tiles_over, without_pinholes

CLOSE_MM = 2.0
"""Pings whose own height is this near to a plane may have met it."""
LEAST_PINGS = 3
EVEN = 0.5
CANDIDATES = 3
APART_MM = 3.0
"""So many heights are tried, so far apart."""
TURNED_MM = 0.8
"""An eighth of a wavelength."""
VANISHED = 0.8
"""Missing echoes must bring the residual energy below this share of what it was."""


def seeds_by_height(state: State, cluster: NDArray[np.int64]) -> list[Seed]:
    """A level and a tilted plane through the heights of some pings, for echoes from which no contact can be told."""
    found, out = state.found, list[Seed]()
    narrow = is_narrow(found)
    heights = ping_heights(found, cluster, None if narrow else state.predicted[cluster])
    centre = centres_mm(found)[cluster]
    planes = [fit_plane(found, heights, False), fit_plane(found, heights, True)]
    if not narrow:
        level = _level(state, cluster, heights.candidates(CANDIDATES, APART_MM))
        off_mm = np.abs(heights.height_mm - level.z_mm)
        out.append(Seed(level, cluster, found.foot_mm[cluster], 1.4826 * min(CLOSE_MM, float(np.median(off_mm)))))
    for plane in planes[1:] if planes[1].level and out else planes:
        off_mm = np.abs(heights.height_mm - plane.at(centre[:, 0], centre[:, 1]))
        close = off_mm <= CLOSE_MM
        if close.sum() >= LEAST_PINGS:
            spread_mm = 1.4826 * float(np.median(off_mm[close]))
            out.append(Seed(plane, cluster[close], found.foot_mm[cluster], spread_mm))
    return out


def _level(state: State, cluster: NDArray[np.int64], heights_mm: list[float]) -> Plane:
    """The level plane of which tiles explain most, near to one of some heights.

    Notes
    -----
    The echo of something smaller than the first Fresnel zone is turned by up to a quarter of a period against that of
    an endless plate, so its height is off by up to an eighth of a wavelength.
    """
    found, field = state.found, state.scene.field
    x, y = found.foot_mm[cluster].mean(axis=0)
    window = cells_near(found.foot_mm[cluster], field, NEIGHBOUR_MM)
    judges, tiles = pings_near(found, window, field, JUDGED_MM), tiles_over(window)

    def left(z_mm: float) -> float:
        plane = Plane(float(x), float(y), z_mm)
        return occupancy(found, state.scene, state.predicted[judges], judges, plane, tiles).explained

    best_mm = min(heights_mm, key=left)
    return Plane(float(x), float(y), min((best_mm - TURNED_MM, best_mm, best_mm + TURNED_MM), key=left))


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
    mask = _without_crumbs(covered(missing.share, tiles, window.shape, field.cell_mm), field.cell_mm)
    if not mask.any():
        return None
    # only inwards: at its rim sound is weak, not gone
    fine = rim_shares(state, state.without(mask), mask, None, judges) > EVEN
    inner = _without_crumbs(without_pinholes(mask & fine, field.cell_mm), field.cell_mm)
    return inner if inner.any() else mask


def _without_crumbs(mask: Mask, cell_mm: float) -> Mask:
    """Its pieces that are large enough for a surface."""
    labels, _ = labelled(mask)
    large = np.bincount(labels.ravel()) * cell_mm**2 >= LEAST_MM2
    large[0] = False
    return large[labels]


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
