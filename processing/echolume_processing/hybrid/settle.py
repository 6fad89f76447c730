"""Which of some planes explains the echoes best, and its height and tilt by what they leave over."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from echolume_processing.hybrid.channel import BAND_MARGIN
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.scipy_typed import Mask
from echolume_processing.hybrid.sounding import Sounding
from echolume_processing.hybrid.state import State, pings_near, residual_of

JUDGES = 16
"""So many pings settle a plane."""
STEP_MM = 0.3
"""Step of the parabola through three heights."""
STEP_TILT = 0.006
"""Step of the parabola through three slopes."""
STEP_BEND_PER_MM = 0.001
"""Step of the parabola through three bends."""
BENT_STEPS = (4.0, 2.0, 1.0)
"""A bent surface is refined so many times, in steps so many times those: its first fit is a coarse one."""
LEVEL_FIRST = 0.95
"""A tilted plane must explain so much better than a level one."""
NARROW = 0.3
"""Below this relative bandwidth a height is only known up to half a wavelength, unless the echoes say more."""
WAVES = 3
"""So many half wavelengths up and down are tried."""
HEARS_MM = 30.0
"""Pings whose foot or mirror point is this near to a surface say which of those heights it has: its edges tell."""
SURE = 2.0
"""A rival must leave more over, in the mean of the pings, by so many standard errors of that mean."""

Cost = Callable[[Plane], float]


def is_narrow(found: Sounding) -> bool:
    """Whether the band is too narrow for one height to be told from the next."""
    low_hz, high_hz = found.band.low_hz / (1 - BAND_MARGIN), found.band.high_hz / (1 + BAND_MARGIN)
    return high_hz - low_hz < NARROW * low_hz


def settle(
    state: State, mask: Mask, planes: list[Plane], over: NDArray[np.int64], *, turns: bool = False
) -> tuple[Plane, bool]:
    """The best of some planes over a mask, refined by the pings right over it.

    Parameters
    ----------
    over
        Those pings.
    turns
        Refine the tilt as well, not only the height.

    Returns
    -------
    Plane
        The plane.
    bool
        Whether another height, half a wavelength off, is as good.
    """
    judges = over[:: max(1, over.size // JUDGES)]
    near = state.scene_with(mask, planes[0])

    def cost(plane: Plane) -> float:
        return residual_of(state.found, state.found.predict(state.scene_with(mask, plane, near), judges), judges)

    narrow = is_narrow(state.found)
    if narrow:  # a third of a millimetre is a tenth of a wave, and decides
        planes = [_parabola(p, cost, Plane.raised, STEP_MM)[0] for p in planes]
    costs = [cost(p) * (1.0 if p.level else 1 / LEVEL_FIRST) for p in planes]
    plane = planes[int(np.argmin(costs))]
    if narrow:
        return _of_whole_waves(state, mask, plane, cost)
    plane = _parabola(plane, cost, Plane.raised, STEP_MM)[0]
    if turns and plane.bent:
        return _bent_to_fit(plane, cost), False
    if turns and not plane.level:
        plane = _about_middle(plane, state, mask)
        for turn in (_turned_x, _turned_y):
            plane = _parabola(plane, cost, turn, STEP_TILT)[0]
        plane = _parabola(plane, cost, Plane.raised, STEP_MM)[0]
    return plane, False


def _of_whole_waves(state: State, mask: Mask, plane: Plane, cost: Cost) -> tuple[Plane, bool]:
    """The best of the heights that differ by half wavelengths, and whether another one is as good.

    Right over a surface they return almost the same echo; its edges do not, so that every ping around has a say.
    """
    found = state.found
    half_wave_mm = 1e3 * found.speed_mps / (found.band.low_hz + found.band.high_hz)
    rivals = [plane.raised(n * half_wave_mm) for n in range(-WAVES, WAVES + 1)]
    rivals = [_parabola(p, cost, Plane.raised, STEP_MM)[0] for p in rivals]
    near = pings_near(found, mask, state.scene.field, HEARS_MM, plane)
    like = state.scene_with(mask, plane)
    left = np.array([found.residual(found.predict(state.scene_with(mask, p, like), near), near) for p in rivals])
    best = int(np.argmin(left @ found.energy[near]))
    more = np.delete(left, best, axis=0) - left[best]
    error = more.std(axis=1) / np.sqrt(near.size)
    return rivals[best], bool((more.mean(axis=1) < SURE * error).any())


def _bent_to_fit(plane: Plane, cost: Cost) -> Plane:
    """A bent surface with its slopes, bends and height by what they leave over, in steps that become smaller."""
    for times in BENT_STEPS:
        for turn in (_turned_x, _turned_y):
            plane = _parabola(plane, cost, turn, times * STEP_TILT)[0]
        for bend in (_bent_xx, _bent_yy):
            plane = _parabola(plane, cost, bend, times * STEP_BEND_PER_MM)[0]
        plane = _parabola(plane, cost, Plane.raised, STEP_MM)[0]
    return plane


def _bent_xx(plane: Plane, by_per_mm: float) -> Plane:
    return replace(plane, bend_xx=plane.bend_xx + by_per_mm)


def _bent_yy(plane: Plane, by_per_mm: float) -> Plane:
    return replace(plane, bend_yy=plane.bend_yy + by_per_mm)


def _about_middle(plane: Plane, state: State, mask: Mask) -> Plane:
    """The same plane, told by the middle of a mask: there a tilt does not change its height."""
    x_mm, y_mm = cell_centres_mm(state.scene.field)
    x, y = np.array([float(x_mm[mask.any(axis=0)].mean())]), np.array([float(y_mm[mask.any(axis=1)].mean())])
    return replace(plane, x_mm=float(x[0]), y_mm=float(y[0]), z_mm=float(plane.at(x, y)[0]))


def _turned_x(plane: Plane, by: float) -> Plane:
    return replace(plane, slope_x=plane.slope_x + by)


def _turned_y(plane: Plane, by: float) -> Plane:
    return replace(plane, slope_y=plane.slope_y + by)


def _parabola(plane: Plane, cost: Cost, moved: Callable[[Plane, float], Plane], step: float) -> tuple[Plane, float]:
    """Refine a plane by the parabola through three residuals, at most a step away."""
    below, level, above = (cost(moved(plane, by)) for by in (-step, 0.0, step))
    bend = below - 2 * level + above
    if bend <= 0:
        return plane, level
    shift = float(np.clip(0.5 * (below - above) / bend, -1.0, 1.0)) * step
    return moved(plane, shift), level - 0.125 * (below - above) ** 2 / bend
