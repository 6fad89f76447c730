"""Likelihood of an envelope for an echo's arrival and level, the phase between echo and background followed.

An envelope is |b + e exp(i phi)|: background b, echo e, phase phi unknown. Both are sums of waves of one narrow band,
so phi changes little from one sample to the next: it is a hidden random walk, summed over by the forward recursion.
Only its cosine is seen, so half a turn is enough.
"""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

PULSE_STEP = 0.05
PULSE_FIRST = -8.0
"""A pulse is sampled this finely, from this many samples before its crest."""


@njit(cache=True)
def _cauchy(y: float, b: float) -> float:
    """Log density of a sample behind the echo: its shadow and its own late echoes."""
    scale = 0.35 * b + 60.0
    return -math.log(scale) - math.log1p(((y - b) / scale) ** 2) - 0.22


@njit(cache=True)
def echo_kernel(
    frame: NDArray[np.float64],  # (samples,)
    background: NDArray[np.float64],  # (samples,)
    pulse: NDArray[np.float64],  # (fine,) largest value 1
    arrivals: NDArray[np.float64],  # (arrivals,) crest, in samples
    levels: NDArray[np.float64],  # (levels,) logarithm of the crest's height
    cosines: NDArray[np.float64],  # (phases,)
    walk: NDArray[np.float64],  # (phases, phases), row: from
    settings: tuple[float, float, float, float, int],  # noise, share, before, after, blind
    out: NDArray[np.float64],  # (arrivals, levels) log likelihood
) -> None:
    """Student's t with 6 degrees of freedom around each sample's magnitude."""
    noise, share, before, after, blind = settings
    samples = len(frame)
    phases = len(cosines)
    early = np.zeros(samples + 1)
    late = np.zeros(samples + 1)
    for t in range(samples):
        early[t + 1], late[t + 1] = early[t], late[t]
        if t >= blind:
            u = 1.0 + ((frame[t] - background[t]) / noise) ** 2 / 6.0
            early[t + 1] -= 3.5 * math.log(u) + math.log(noise)
            late[t + 1] += _cauchy(frame[t], background[t])
    prior = np.empty(phases)
    weight = np.empty(phases)
    echo = np.empty(samples)
    for a in range(len(arrivals)):
        lo = max(blind, math.ceil(arrivals[a] - before))
        hi = min(samples, math.floor(arrivals[a] + after) + 1)
        base = early[lo] + late[samples] - late[max(lo, hi)]
        for t in range(lo, hi):
            x = (t - arrivals[a] - PULSE_FIRST) / PULSE_STEP
            k = int(x)
            echo[t] = pulse[k] + (x - k) * (pulse[k + 1] - pulse[k])
        for level in range(len(levels)):
            crest = math.exp(levels[level])
            variance = noise * noise + (share * crest) ** 2
            total = base
            prior[:] = 1.0 / phases
            for t in range(lo, hi):
                e, b, y = crest * echo[t], background[t], frame[t]
                power, cross, mass = b * b + e * e, 2.0 * b * e, 0.0
                for k in range(phases):
                    come = 0.0
                    for j in range(phases):
                        come += walk[j, k] * prior[j]
                    away = y - math.sqrt(max(power + cross * cosines[k], 0.0))
                    u = 1.0 + away * away / (6.0 * variance)
                    weight[k] = come / (u * u * u * math.sqrt(u))
                    mass += weight[k]
                total += math.log(mass) - 0.5 * math.log(variance)
                for k in range(phases):
                    prior[k] = weight[k] / mass
            out[a, level] = total


@njit(cache=True)
def place_kernel(
    tables: NDArray[np.float32],  # (channels, arrivals, levels) likelihood over its mean
    at_arrival: NDArray[np.float64],  # (places, channels) index, may lie between two
    at_level: NDArray[np.float64],  # (places, channels)
    lost: float,
    out: NDArray[np.float64],  # (places,) log likelihood
) -> None:
    """Sum of the channels' log likelihoods; each may be deaf to the target with probability `lost`."""
    channels, arrivals, levels = tables.shape
    for p in range(len(out)):
        total = 0.0
        for c in range(channels):
            x = min(max(at_arrival[p, c], 0.0), arrivals - 1.001)
            y = min(max(at_level[p, c], 0.0), levels - 1.001)
            i, j = int(x), int(y)
            u, v = x - i, y - j
            here = tables[c, i, j] + v * (tables[c, i, j + 1] - tables[c, i, j])
            there = tables[c, i + 1, j] + v * (tables[c, i + 1, j + 1] - tables[c, i + 1, j])
            total += math.log(lost + (1.0 - lost) * (here + u * (there - here)))
        out[p] = total
