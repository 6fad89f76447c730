"""Several echoes per channel, overlapping or not, by least squares with the channel's own template."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_processing.ultrasonic.baseband import Baseband
from echolume_processing.ultrasonic.several_kernels import fit_echoes, pair_start

WORTH_A_TRY = 4.0
"""Half the square of a residual's peak over its noise, from which one more echo is tried."""
FIRST = 12.0
"""The same of the first echo: by chance one in some thousands of records has so much."""
SIGNIFICANT = 18.0
"""Chi-squared that one more echo (two of height, one of time) must explain to be believed."""
UNEXPLAINED = 0.01
"""Share of the strongest echo that template and air leave unexplained around it."""
PAIR_POINTS = 61
PAIR_REACH = 2.5
"""Two echoes within this many times 1 / (2 pi bandwidth) are looked for together."""


@dataclass(frozen=True)
class Echoes:
    """Echoes of one channel in the order of their arrival; every array has shape (echoes,)."""

    time_s: NDArray[np.float64]
    """After the first sample, delay of the channel included; from the envelopes alone."""
    amplitude: NDArray[np.float64]
    """Relative to the template's."""
    phase_rad: NDArray[np.float64]
    """Zero for an exact copy of the template."""
    sigma_s: NDArray[np.float64]
    """Of `time_s`, neighbours included: the Cramer-Rao bound."""
    residual: float
    """Half the square of the largest residual over its noise; less than 12 is noise."""


@dataclass(frozen=True)
class _Fit:
    angles: NDArray[np.float64]
    heights: NDArray[np.complex128]
    covariance: NDArray[np.float64]
    explained: float


def several_echoes(
    echoes: Baseband, gate_s: tuple[float, float], noise: NDArray[np.float64], *, most: int = 4
) -> list[Echoes]:
    """Take echoes out of each channel until the rest is noise.

    Parameters
    ----------
    echoes : Baseband
        Of a plain matched filter (`PLAIN`): only there least squares are its peaks.
    gate_s : (first, last)
        Times after the first sample between which echoes may lie.
    noise : (receivers,) float64
        Standard deviation of the filter's output, real or imaginary.
    most : int
        Echoes per channel at most.

    Returns
    -------
    list of Echoes, one per channel; empty where nothing stands out of the noise.

    Notes
    -----
    A second echo is fitted only where the residual of the first exceeds the noise by chi-squared. It starts from the
    residual's peak and from the best pair on a grid around the first; heights are complex, so an echo may have any
    phase (edges turn it). Two echoes closer than about half the template's rise trade against each other; their sigma
    says so.
    """
    bank = echoes.bank
    turn = 2 * np.pi * bank.sample_rate_hz / bank.length
    limits = gate_s[0] * turn, gate_s[1] * turn
    return [_channel(echoes, r, limits, max(float(noise[r]), 1e-12), most) for r in range(len(noise))]


def _channel(echoes: Baseband, channel: int, limits: tuple[float, float], noise: float, most: int) -> Echoes:
    bank = echoes.bank
    turn = 2 * np.pi * bank.sample_rate_hz / bank.length
    products = echoes.products[channel]
    pulse = bank.pulse[channel].astype(np.complex64)
    bin_of_centre = float(bank.centre_hz[channel] * 2 * np.pi / turn)
    centre = bin_of_centre - bank.first_bin
    reach = PAIR_REACH * turn / (2 * np.pi * float(bank.bandwidth_hz[channel]))
    fit = _Fit(np.empty(0), np.empty(0, dtype=np.complex128), np.empty((0, 0)), 0.0)
    height, at = _residual(echoes, channel, centre, fit, limits)
    while len(fit.angles) < most:
        strongest = float(np.abs(fit.heights).max(initial=0.0))
        needed = max(noise * np.sqrt(2 * (WORTH_A_TRY if len(fit.angles) else FIRST)), UNEXPLAINED * strongest)
        if height < needed:
            break
        starts = [np.append(fit.angles, at)]
        if len(fit.angles):
            nearest = int(np.argmin(np.abs(fit.angles - at)))
            pair = np.empty(2)
            others = np.delete(fit.angles, nearest)
            rest = _less(products, pulse, centre, others, np.delete(fit.heights, nearest))
            pair_start(rest, pulse, centre, float(fit.angles[nearest]), reach, PAIR_POINTS, pair)
            starts.append(np.concatenate([others, pair]))
        found = [_fitted(products, pulse, centre, limits, start) for start in starts]
        best = max(found, key=lambda one: one.explained)
        if best.explained - fit.explained < SIGNIFICANT * noise**2:
            break
        fit = best
        height, at = _residual(echoes, channel, centre, fit, limits)
    order = np.argsort(fit.angles)
    angles = fit.angles[order]
    turned = fit.heights[order] * np.exp(1j * bin_of_centre * angles)
    sigma = noise * np.sqrt(np.diag(fit.covariance)[order]) / turn
    return Echoes(angles / turn, np.abs(turned), np.angle(turned), sigma, 0.5 * (height / noise) ** 2)


def _fitted(
    products: NDArray[np.complex64],
    pulse: NDArray[np.complex64],
    centre: float,
    limits: tuple[float, float],
    start: NDArray[np.float64],
) -> _Fit:
    angles, count = start.copy(), len(start)
    heights, covariance = np.empty(count, dtype=np.complex128), np.empty((count, count))
    explained = fit_echoes(products, pulse, centre, *limits, angles, heights, covariance)
    return _Fit(angles, heights, covariance, explained)


def _less(
    products: NDArray[np.complex64],
    pulse: NDArray[np.complex64],
    centre: float,
    angles: NDArray[np.float64],
    heights: NDArray[np.complex128],
) -> NDArray[np.complex64]:
    """Spectrum of the compressed record without these echoes."""
    if not len(angles):
        return products
    turned = np.exp(-1j * np.outer(np.arange(len(products)) - centre, angles)) @ heights
    return np.asarray(products - pulse * turned, dtype=np.complex64)


def _residual(
    echoes: Baseband, channel: int, centre: float, fit: _Fit, limits: tuple[float, float]
) -> tuple[float, float]:
    """Largest magnitude that the echoes leave within the limits, and its angle."""
    bank = echoes.bank
    pulse = bank.pulse[channel].astype(np.complex64)
    magnitude = echoes.magnitude_of(_less(echoes.products[channel], pulse, centre, fit.angles, fit.heights))
    per_angle = echoes.rate_hz * bank.length / (2 * np.pi * bank.sample_rate_hz)
    first = max(0, int(np.ceil(limits[0] * per_angle)))
    last = max(first + 1, min(len(magnitude), int(limits[1] * per_angle)))
    peak = first + int(np.argmax(magnitude[first:last]))
    return float(magnitude[peak]), peak / per_angle
