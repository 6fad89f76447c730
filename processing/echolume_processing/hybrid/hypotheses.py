"""Surfaces that only sound knows: absorbing ones that fill optical holes, and plates that light goes through."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_processing.hybrid.grid import cell_index
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.plates import PingHeights, Plane, fit_plane, ping_heights
from echolume_processing.hybrid.scipy_typed import NearestPoints, depth_inside, labelled
from echolume_processing.hybrid.sounding import Sounding, Spectra
from echolume_processing.hybrid.surface import Surface, reshaped
from echolume_processing.hybrid.tiles import Mask, covered, occupancy, tiles_over

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
"""Pings whose foot is this near to a region judge it."""
NOTICED_MM = 50.0
"""Pings further than this from a change hardly notice it."""
JUDGES = 80
"""So many judges are enough to accept or refuse a plate."""
STEP_MM = 0.3
"""Step of the parabola through three heights."""
ACCEPTED = 0.6
"""A plate must bring the residual energy below this share of what it was."""
TILT_GAIN = 0.95
LEAST_SLOPE = 0.01
LEAST_MM2 = 150.0
LEAST_RISE_MM = 1.5
NEIGHBOUR_MM = 12.0
"""Cells this near to an anomalous ping may belong to a plate."""
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


@dataclass(frozen=True)
class State:
    """The surface as it is believed so far, and the echoes that it predicts for all pings."""

    found: Sounding
    scene: Surface
    predicted: Spectra

    def residual(self) -> NDArray[np.float64]:
        """Residual energy of each ping over its measured energy."""
        return self.found.residual(self.predicted, np.arange(len(self.found.apertures)))

    def with_height(self, height_mm: NDArray[np.float64], changed: Mask) -> State:
        """The state after some cells got another height; only the pings that can notice are predicted anew."""
        scene = reshaped(self.scene, height_mm)
        which = pings_near(self.found, changed, self.scene.field, NOTICED_MM)
        predicted = self.predicted.copy()
        if which.size:
            predicted[which] = self.found.predict(scene, which)
        return State(self.found, scene, predicted)


def pings_near(found: Sounding, mask: Mask, field: MapField, distance_mm: float) -> NDArray[np.int64]:
    """Pings whose foot is within a distance of a mask, sorted."""
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(field))
    away, _ = NearestPoints(np.column_stack((x_mm[mask], y_mm[mask]))).nearest(found.foot_mm)
    return np.nonzero(away <= distance_mm)[0]


def pings_inside(found: Sounding, mask: Mask, field: MapField, depth_mm: float) -> NDArray[np.int64]:
    """Pings whose foot is at least so deep inside a mask, sorted."""
    depth = depth_inside(mask) * field.cell_mm
    foot = found.foot_mm
    cell = cell_index(field, foot[:, 0], foot[:, 1])
    return np.nonzero((cell >= 0) & (depth.ravel()[cell] > depth_mm))[0]


def absorbing(state: State, hole: Mask) -> Patch | None:
    """Height of the surface that fills an optical hole; None if sound does not see it either."""
    found, field = state.found, state.scene.field
    deepest_mm = float(depth_inside(hole).max()) * field.cell_mm
    over = pings_inside(found, hole, field, min(INSIDE_MM, 0.3 * deepest_mm))
    if over.size < LEAST_OVER_HOLE:
        return None
    heights = ping_heights(found, over)
    middle = found.foot_mm[over].mean(axis=0)
    level = [Plane(float(middle[0]), float(middle[1]), z) for z in heights.candidates(CANDIDATES, APART_MM)]
    patch = _settle(state, hole, [*level, fit_plane(found, heights, True)], heights)
    after = _residual(found, found.predict(_with_patch(state.scene, hole, patch.plane), over), over)
    return patch if after < max(EXPLAINED, ACCEPTED * _residual(found, state.predicted[over], over)) else None


def transparent(state: State, cluster: NDArray[np.int64]) -> Patch | None:
    """The plate that explains a cluster of anomalous pings; None if none does.

    Parameters
    ----------
    state
        What is believed so far; it predicts these pings badly.
    cluster
        Pings of one connected region.
    """
    found, field = state.found, state.scene.field
    window = _around(found, cluster, field)
    judges = pings_near(found, window, field, JUDGED_MM)
    heights = ping_heights(found, cluster)
    jury = judges[:: max(1, judges.size // JUDGES)]
    before = _residual(found, state.predicted[jury], jury)
    best: Patch | None = None
    best_after = ACCEPTED * before
    for tilted in (False, True):
        plane = fit_plane(found, heights, tilted)
        if tilted and np.hypot(plane.slope_x, plane.slope_y) < LEAST_SLOPE:
            continue
        mask = _extent(state, window, judges, plane)
        if mask.sum() * field.cell_mm**2 < LEAST_MM2:
            continue
        inside = np.isin(heights.which, pings_inside(found, mask, field, 0.0))
        if inside.sum() < LEAST_PINGS:
            continue
        patch = _settle(state, mask, [plane], heights.some(inside))
        rise_mm = float(np.median((patch.plane.image(field) - state.scene.height_mm)[mask]))
        if rise_mm < LEAST_RISE_MM:
            continue
        after = _residual(found, found.predict(_with_patch(state.scene, mask, patch.plane), jury), jury)
        if after < best_after:
            best, best_after = patch, TILT_GAIN * after
    return best


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


def _around(found: Sounding, cluster: NDArray[np.int64], field: MapField) -> Mask:
    """Cells near to the feet of a cluster."""
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(field))
    away, _ = NearestPoints(found.foot_mm[cluster]).nearest(np.column_stack((x_mm.ravel(), y_mm.ravel())))
    return (away <= NEIGHBOUR_MM).reshape(field.shape)


def _extent(state: State, window: Mask, judges: NDArray[np.int64], plane: Plane) -> Mask:
    """Cells that a plate in a given plane covers: the largest connected piece."""
    tiles = tiles_over(window)
    share = occupancy(state.found, state.scene, state.predicted[judges], judges, plane, tiles)
    mask = covered(share, tiles, window.shape)
    labels, number = labelled(mask)
    if number <= 1:
        return mask
    sizes = np.bincount(labels.ravel())
    sizes[0] = 0
    return labels == int(sizes.argmax())


def _with_patch(scene: Surface, mask: Mask, plane: Plane) -> Surface:
    return reshaped(scene, np.where(mask, plane.image(scene.field), scene.height_mm))


def _residual(found: Sounding, predicted: Spectra, which: NDArray[np.int64]) -> float:
    """Residual energy of some pings over their measured energy, as one number."""
    energy = found.energy[which]
    return float((found.residual(predicted, which) * energy).sum() / energy.sum())


def _settle(state: State, mask: Mask, planes: list[Plane], over: PingHeights) -> Patch:
    """Choose a plane and refine its height on the pings right over it."""
    judges = over.which[:: max(1, over.which.size // 16)]
    near = _with_patch(state.scene, mask, planes[0])

    def cost(plane: Plane) -> float:
        return _residual(state.found, state.found.predict(_with_patch(near, mask, plane), judges), judges)

    costs = [cost(p) * (1.0 if p.slope_x == p.slope_y == 0.0 else 1 / TILT_GAIN) for p in planes]
    best = int(np.argmin(costs))
    plane, level = planes[best], costs[best]
    half_wave_mm = 1e3 * state.found.speed_mps / (state.found.band.low_hz + state.found.band.high_hz)
    narrow = (state.found.band.high_hz - state.found.band.low_hz) < NARROW * state.found.band.low_hz
    if narrow:
        plane, level = _slip(plane, level, half_wave_mm, cost)
    plane, level = _parabola(plane, level, cost)
    rivals = [cost(plane.raised(s * half_wave_mm)) for s in (-1, 1)] if narrow else []
    spread_mm = _spread(state.found, plane, over)
    return Patch(mask, plane, spread_mm, int(over.which.size), any(r < RIVAL * level for r in rivals))


def _slip(plane: Plane, level: float, half_wave_mm: float, cost: Callable[[Plane], float]) -> tuple[Plane, float]:
    """The best of the heights that differ by whole half wavelengths."""
    rivals = [plane.raised(n * half_wave_mm) for n in (-3, -2, -1, 1, 2, 3)]
    costs = [cost(r) for r in rivals]
    k = int(np.argmin(costs))
    return (rivals[k], costs[k]) if costs[k] < level else (plane, level)


def _parabola(plane: Plane, level: float, cost: Callable[[Plane], float]) -> tuple[Plane, float]:
    """Refine a height by the parabola through three residuals, at most `STEP_MM` away."""
    below, above = cost(plane.raised(-STEP_MM)), cost(plane.raised(STEP_MM))
    bend = below - 2 * level + above
    if bend <= 0:
        return plane, level
    shift_mm = float(np.clip(0.5 * (below - above) / bend, -1.0, 1.0)) * STEP_MM
    return plane.raised(shift_mm), level - 0.125 * (below - above) ** 2 / bend


def _spread(found: Sounding, plane: Plane, over: PingHeights) -> float:
    """Standard deviation of a plane's height: robust spread of its pings' own heights over the root of their number."""
    centre = np.array([found.apertures[int(k)].elements_mm[0] for k in over.which])
    spread_mm = 1.4826 * float(np.median(np.abs(over.height_mm - plane.at(centre[:, 0], centre[:, 1]))))
    return max(0.05, spread_mm / float(np.sqrt(over.which.size)))
