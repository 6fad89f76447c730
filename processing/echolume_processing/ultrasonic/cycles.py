"""Cycle slips of all channels of a ping resolved together: the whole numbers of cycles that one surface explains."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import combinations, product
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, require_shape
from echolume_messages.types import EchoKind
from echolume_processing.ultrasonic.contacts import MAX_CHI_SQUARED, MAX_TILT_RAD, contacts
from echolume_processing.ultrasonic.flight import LEAST_NOISE, Arrivals
from echolume_processing.ultrasonic.layout import layout_of

SURE = 9.0
"""By this much of chi-squared the best answer must beat the next."""
ENVELOPE_FLOOR_MM = 0.2
"""What the model leaves unexplained of a path by its envelope alone."""
MIN_CHANNELS = 5
"""Three unknowns, and two more to contradict a wrong cycle."""
MODELS: tuple[Literal["plane"], Literal["point"]] = ("plane", "point")


@dataclass(frozen=True)
class Cycles:
    """Whole cycles that each channel was off, and how far to believe them."""

    cycles: NDArray[np.int64]
    """To be taken away from each channel, times the wavelength, (receivers,)."""
    paths_mm: NDArray[np.float64]
    """Without them, (receivers,)."""
    kind: EchoKind
    chi_squared: float
    """Of the surface's fit to these paths, per degree of freedom."""
    margin: float
    """Chi-squared of the next best whole numbers above that of these."""

    @property
    def resolved(self) -> bool:
        """Whether a surface explains the paths, and no other whole numbers do about as well."""
        return self.kind != EchoKind.NONE and self.margin >= SURE


def _pivots(receivers_mm: Points3, heard: NDArray[np.intp]) -> list[int]:
    """Three channels that span the largest triangle."""

    def area(three: tuple[int, ...]) -> float:
        a, b, c = receivers_mm[list(three), :2]
        return abs(float((b[0] - a[0]) * (c[1] - a[1]) - (b[1] - a[1]) * (c[0] - a[0])))

    best = max(combinations(heard.tolist(), 3), key=area)
    if area(best) == 0:
        raise ValueError("receivers_mm: expected three that are not on a line; a line cannot tell slips from tilts")
    return list(best)


def _candidates(
    receivers_mm: Points3, paths_mm: NDArray[np.float64], wavelength_mm: float, most: int
) -> NDArray[np.int64]:
    """Whole numbers (candidates, receivers): any for three channels, what the surface through these says for the
    others."""
    heard = np.isfinite(paths_mm)
    three = _pivots(receivers_mm, np.flatnonzero(heard))
    tried = np.array(list(product(range(-most, most + 1), repeat=3)))  # (tried, 3)
    ways = paths_mm[three] - wavelength_mm * tried
    out = [np.zeros((1, len(paths_mm)), dtype=np.int64)]
    for model in MODELS:
        fit = contacts(receivers_mm[three], ways, np.ones(3), max_tilt_rad=MAX_TILT_RAD, model=model, untested=True)
        target = fit.foot_mm[fit.kind != EchoKind.NONE]
        if model == "plane":
            base, target = np.zeros(len(target)), 2 * target
        else:
            base = np.linalg.norm(target, axis=1)
        predicted = base[:, None] + np.linalg.norm(receivers_mm - target[:, None], axis=2)
        cycles = np.where(heard, (paths_mm - predicted) / wavelength_mm, 0.0)
        whole = np.rint(cycles).astype(np.int64)
        out.append(whole)
    return np.unique(np.concatenate(out), axis=0)


def resolve_cycles(
    receivers_mm: Points3,
    paths_mm: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    wavelength_mm: float,
    envelope_mm: NDArray[np.float64],
    envelope_sigma_mm: NDArray[np.float64],
    *,
    most: int = 2,
) -> Cycles:
    """Find the whole cycles of each channel that one plane or point and the envelopes explain best.

    Parameters
    ----------
    receivers_mm : (receivers, 3) float64
        Relative to the emitter.
    paths_mm : (receivers,) float64
        By phase: precise, but perhaps off by whole wavelengths; not a number where there is no echo.
    sigma_mm : (receivers,) float64
        Of the paths, slips apart.
    wavelength_mm : float
        What one slip adds to a path.
    envelope_mm, envelope_sigma_mm : (receivers,) float64
        Paths by envelope alone, and their sigma.
    most : int
        Cycles that each of the three channels tried can be off; the others may be off by any number.

    Returns
    -------
    Cycles
        `kind` NONE where no whole numbers make a surface: then a channel holds another echo.

    Raises
    ------
    ValueError
        If fewer than four channels have an echo (nothing would be left to test), or all of them are on a line.

    Notes
    -----
    Three channels are given every combination, the surface through them gives the others theirs, and chi-squared of
    surface and envelopes decides. A slip common to all channels, or one that grows evenly across the array like a
    tilt, moves the surface and fits as well: only the envelopes decide about these, by the mean of all channels.
    """
    n = len(receivers_mm)
    for name, values in (("paths_mm", paths_mm), ("sigma_mm", sigma_mm)):
        require_shape(name, values, (n,))
    for name, values in (("envelope_mm", envelope_mm), ("envelope_sigma_mm", envelope_sigma_mm)):
        require_shape(name, values, (n,))
    heard = int(np.count_nonzero(np.isfinite(paths_mm)))
    if heard < 4:
        raise ValueError(f"paths_mm: expected echoes of four channels at least, got {heard}")
    whole = _candidates(receivers_mm, paths_mm, wavelength_mm, most)
    ways = paths_mm - wavelength_mm * whole  # (candidates, receivers)
    fits = contacts(receivers_mm, ways, sigma_mm, max_chi_squared=np.inf, leave_out=False)
    surface = np.fmin(fits.plane_chi_squared, fits.point_chi_squared)
    surface = np.where(fits.kind == EchoKind.NONE, np.inf, surface)
    envelopes = np.nansum(((ways - envelope_mm) / envelope_sigma_mm) ** 2, axis=1)
    score = (heard - 3) * surface + envelopes
    order = np.argsort(score, kind="stable")
    best = int(order[0])
    margin = np.inf
    if len(order) > 1:
        margin = float(score[order[1]] - score[best]) if np.isfinite(score[best]) else 0.0
    believed = bool(surface[best] <= MAX_CHI_SQUARED)
    kind = EchoKind(int(fits.kind[best])) if believed else EchoKind.NONE
    return Cycles(whole[best], ways[best], kind, float(surface[best]), margin)


def settled(
    found: Arrivals,
    paths_mm: NDArray[np.float64],
    receivers_mm: Points3,
    period_s: NDArray[np.float64],
    speed_mm_per_s: float,
    floor_mm: float,
) -> tuple[Arrivals, NDArray[np.float64]]:
    """Arrivals and paths after all channels have settled their cycles together; unchanged where no surface fits.

    Parameters
    ----------
    found : Arrivals
    paths_mm : (receivers,) float64
    receivers_mm : (receivers, 3) float64
        Relative to the emitter.
    period_s : (receivers,) float64
        Of each channel's compressed pulse.
    speed_mm_per_s : float
    floor_mm : float
        What a smooth surface leaves unexplained of a path.
    """
    doubtful = found.doubtful
    heard = np.isfinite(paths_mm)
    if np.count_nonzero(heard) < MIN_CHANNELS or layout_of(receivers_mm[heard]).rank < 3:
        return found, paths_mm
    turned_s = np.where(doubtful, -found.phase_rad / (2 * np.pi) * period_s, 0.0)
    agreed = resolve_cycles(
        receivers_mm,
        paths_mm + turned_s * speed_mm_per_s,
        np.full(len(paths_mm), floor_mm),
        float(period_s.mean()) * speed_mm_per_s,
        paths_mm + (found.envelope_s - found.time_s) * speed_mm_per_s,
        np.hypot(found.envelope_sigma_s * speed_mm_per_s, ENVELOPE_FLOOR_MM),
    )
    if not agreed.resolved:
        return found, paths_mm
    relative = np.maximum(found.noise / np.where(found.found, found.amplitude, 1.0), LEAST_NOISE)
    after = replace(
        found,
        time_s=found.time_s + (agreed.paths_mm - paths_mm) / speed_mm_per_s,
        phase_rad=np.where(doubtful, 0.0, found.phase_rad),
        sigma_s=np.where(doubtful, relative * period_s / (2 * np.pi), found.sigma_s),
    )
    return after, agreed.paths_mm
