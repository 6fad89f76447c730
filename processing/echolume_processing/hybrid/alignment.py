"""How measured and predicted echoes lie to each other: the scan's likeness over shifts, its linear equations, gains."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_processing.hybrid.channel import Gate
from echolume_processing.hybrid.setup_error import NAMES, SHARED, SPEED, UNSURE_FIRST, Solution

GAIN_TERMS = 4
HEARD = 1e-3
"""Below this share of its largest, a response is taken to be none."""
HALF_PRIOR = 0.5
"""An error counts as determined if the echoes leave less than this share of its prior's sigma,"""
LEAST_OWN = 3e-3
"""nor, if it is the speed of sound, with less than this share of its effect not the height's too. Over level ground
the two do the same to each ping, and what little is left is no more than the predictor's waveforms are off."""
SURE = 3.0
"""An error within so many sigmas is none."""
TUNING = 1.345
"""Huber's constant: 95 % of the efficiency on clean data."""
REWEIGHTED = 5


def at_assumed_speed(
    gate: Gate,
    response: NDArray[np.complex64],
    measured: NDArray[np.complex64],
    faster: NDArray[np.float64],
) -> NDArray[np.complex64]:
    """Measured waveforms as they would have been at the assumed speed of sound.

    Parameters
    ----------
    gate
        Of the waveforms.
    response : (receivers, bins) complex64
        Of the channels and the band filter: they do not stretch with the air.
    measured : (pings, receivers, samples) complex64
        Gated.
    faster : (pings,) float64
        By what share sound was faster than assumed in each ping; some per cent at most.

    Returns
    -------
    (pings, receivers, samples) complex64
    """
    if not faster.any():
        return measured
    frequency_hz = gate.band.frequency_hz
    time_s = (gate.first + np.arange(gate.last - gate.first)) * gate.band.length / gate.band.sample_rate_hz
    time_s = time_s / gate.samples
    floor = HEARD * np.abs(response).max(axis=1, keepdims=True)
    out = np.empty_like(measured)
    for k, share in enumerate(faster):
        heard_hz = frequency_hz * (1 + share)
        turn = np.exp(2j * np.pi * (frequency_hz[0] - heard_hz)[:, None] * time_s)
        spectrum = measured[k] @ turn.T.astype(np.complex64)
        there = _between(frequency_hz, response, heard_hz)
        heard = np.abs(there) > floor
        spectrum *= np.where(heard, response / np.where(heard, there, 1.0), 1.0)
        out[k] = gate.samples_of(spectrum.astype(np.complex64))
    return out


def _between(
    frequency_hz: NDArray[np.float64], response: NDArray[np.complex64], wanted_hz: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """A response between its bins, shape (receivers, wanted)."""
    real = [np.interp(wanted_hz, frequency_hz, row) for row in response.real]
    imaginary = [np.interp(wanted_hz, frequency_hz, row) for row in response.imag]
    return np.array(real) + 1j * np.array(imaginary)


def likeness(
    gate: Gate, measured: NDArray[np.complex64], predicted: NDArray[np.complex64], turns: NDArray[np.complex64]
) -> NDArray[np.float64]:
    """Normalised real correlation of each ping with its prediction under each turn (turns, bins): (pings, turns)."""
    spectrum = gate.spectrum(measured)
    cross = (spectrum * predicted.conj()).sum(axis=1)  # (pings, bins): summed over the receivers
    power = (np.abs(spectrum) ** 2).sum(axis=(1, 2)) * (np.abs(predicted) ** 2).sum(axis=(1, 2))
    return (cross @ turns.conj().T).real / np.sqrt(np.maximum(power, np.finfo(np.float32).tiny))[:, None]


@dataclass(frozen=True)
class Equations:
    """Each ping's normal equations of the errors, for waveforms of energy 1."""

    normal: NDArray[np.float64]
    """(pings, errors, errors)."""
    right: NDArray[np.float64]
    """(pings, errors)."""
    residual: NDArray[np.float64]
    """(pings,): energy that the prediction leaves, the level of each channel being free."""


def equations(
    measured: NDArray[np.complex64], predicted: NDArray[np.complex64], columns: NDArray[np.complex64]
) -> Equations:
    """Linearise measured = predicted + columns . errors, the level of each channel of each ping being free.

    Parameters
    ----------
    measured, predicted : (pings, receivers, samples) complex64
    columns : (errors, pings, receivers, samples) complex64
        Derivative of the prediction by each error.
    """
    energy = np.maximum((np.abs(predicted) ** 2).sum(axis=2), np.finfo(np.float32).tiny)
    level = (measured.conj() * predicted).real.sum(axis=2) / energy
    left = measured - level[..., None] * predicted
    scaled = columns * level[..., None]
    along = (scaled.conj() * predicted).real.sum(axis=3) / energy
    scaled = scaled - along[..., None] * predicted
    whole = np.maximum((np.abs(measured) ** 2).sum(axis=(1, 2)), np.finfo(np.float32).tiny).astype(np.float64)
    flat = np.moveaxis(scaled, 0, 1).reshape(len(measured), len(columns), measured[0].size)
    flat = np.concatenate((flat.real, flat.imag), axis=2)
    rest = left.reshape(len(measured), -1)
    rest = np.concatenate((rest.real, rest.imag), axis=1)
    normal = flat @ flat.transpose(0, 2, 1) / whole[:, None, None]
    right = (flat @ rest[..., None])[..., 0] / whole[:, None]
    return Equations(normal.astype(np.float64), right.astype(np.float64), (np.abs(left) ** 2).sum(axis=(1, 2)) / whole)


def solve(
    some: Equations, weight: NDArray[np.float64], prior: NDArray[np.float64], sought: NDArray[np.bool_]
) -> Solution:
    """Errors that explain the pings best; what the echoes do not tell, or do not contradict, stays as calibrated.

    Parameters
    ----------
    some
        Of the pings that vote.
    weight : (pings,) float64
        Of each ping, before it is judged by its own delay.
    prior : (errors,) float64
        Sigma of each error around 0.
    sought : (errors,) bool
        Those that the equations are about.

    Notes
    -----
    The covariance is the sandwich of the pings' own scores, so errors of the predictor count as they scatter over
    the pings. What all pings share is not in it: that is `SHARED`, and an error within `SURE` of both sigmas is no
    error of the set-up.
    """
    free, held = sought.copy(), np.zeros(sought.size, dtype=np.bool_)
    sigma = np.where(sought, 0.0, prior)
    while True:
        value, spread, own = _reweighted(some, weight, prior, free)
        vague = spread > HALF_PRIOR * prior
        vague[SPEED] |= own < LEAST_OWN
        unsure = [j for j in UNSURE_FIRST if free[j] and vague[j]]
        if unsure:
            free[unsure[0]], sigma[unsure[0]] = False, prior[unsure[0]]
            continue
        whole = np.hypot(spread, SHARED)
        ratio = np.where(free & (SHARED > 0), np.abs(value) / np.maximum(whole, 1e-12), np.inf)
        least = int(ratio.argmin())
        if ratio[least] >= SURE:
            return Solution(value, np.where(free, whole, sigma), free | held)
        free[least], held[least], sigma[least] = False, True, whole[least]


def _reweighted(
    some: Equations, weight: NDArray[np.float64], prior: NDArray[np.float64], free: NDArray[np.bool_]
) -> tuple[NDArray[np.float64], NDArray[np.float64], float]:
    """Value and sigma of the free errors, 0 elsewhere; and how much of the speed's effect is its own."""
    at = np.nonzero(free)[0]
    normal, right = some.normal[:, at][:, :, at], some.right[:, at]
    height = some.normal[:, 0, 0]
    step, prior_information = np.zeros(at.size), np.diag(prior[at] ** -2)
    each = weight / max(float((weight * height).sum()), np.finfo(np.float64).tiny)
    for _ in range(REWEIGHTED):
        information = (each[:, None, None] * normal).sum(axis=0) + prior_information
        step = np.linalg.solve(information, (each[:, None] * right).sum(axis=0))
        own_mm = (some.right[:, 0] - some.normal[:, 0][:, at] @ step) / height
        spread_mm = max(1e-4, 1.4826 * float(np.median(np.abs(own_mm[weight > 0]))))
        robust = np.minimum(1.0, TUNING * spread_mm / np.maximum(np.abs(own_mm), 1e-9))
        # a ping of usual weight tells the height to `spread_mm`
        each = weight * robust / (float(np.median((weight * height)[weight > 0])) * spread_mm**2)
    told = (each[:, None, None] * normal).sum(axis=0)
    inverse = np.linalg.inv(told + prior_information)
    step = inverse @ (each[:, None] * right).sum(axis=0)
    scores = each[:, None] * (right - normal @ step)
    value, spread = np.zeros(len(NAMES)), np.zeros(len(NAMES))
    value[at] = step
    spread[at] = np.sqrt(np.diag(inverse @ (scores.T @ scores + prior_information) @ inverse))
    return value, spread, _own_share(told, at)


def _own_share(told: NDArray[np.float64], at: NDArray[np.int64]) -> float:
    """Which share of the effect of the speed of sound the height has not; 1 where the speed is not free."""
    if SPEED not in at:
        return 1.0
    speed = int(np.nonzero(at == SPEED)[0][0])
    return float(1 - told[0, speed] ** 2 / (told[0, 0] * told[speed, speed]))


def smooth_gain(
    gate: Gate, predicted: NDArray[np.complex64], measured: NDArray[np.complex64]
) -> NDArray[np.complex128]:
    """Complex gain of each channel, a polynomial over the band, shape (receivers, bins)."""
    seen = gate.spectrum(measured)
    thought = gate.spectrum(gate.waveform(predicted))
    at = np.linspace(-1, 1, gate.band.bins.size)
    terms = np.polynomial.chebyshev.chebvander(at, GAIN_TERMS - 1)  # (bins, terms)
    cross = (seen * thought.conj()).sum(axis=0, dtype=np.complex128)  # (receivers, bins)
    power = (np.abs(thought).astype(np.float64) ** 2).sum(axis=0)
    out = np.empty(cross.shape, dtype=np.complex128)
    for channel in range(cross.shape[0]):
        normal = terms.T @ (power[channel, :, None] * terms)
        out[channel] = terms @ np.linalg.solve(normal, terms.T @ cross[channel])
    return out
