"""Compiled loops over records and their spectra: offset, band, noise, energy."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_processing.ultrasonic.echo_kernels import RUN, moments

Values = NDArray[np.float64]
Spectra = NDArray[np.complex64]

ENOUGH = 512
"""Samples that tell the noise to 3 %."""


@njit(cache=True, nogil=True)
def without_offset(counts: NDArray[Any], out: NDArray[np.float32]) -> None:
    """Counts (receivers, samples) less the mean of each channel."""
    for r in range(counts.shape[0]):
        total = 0
        for k in range(counts.shape[1]):
            total += counts[r, k]
        mean = np.float32(total / max(counts.shape[1], 1))
        for k in range(counts.shape[1]):
            out[r, k] = np.float32(counts[r, k]) - mean


@njit(cache=True, nogil=True)
def fill(spectrum: Spectra, first: int, weights: Spectra, products: Spectra, padded: Spectra) -> None:
    """Weighted bins of the band, and the same followed by zeros."""
    bins = weights.shape[1]
    for r in range(weights.shape[0]):
        for k in range(bins):
            value = spectrum[r, first + k] * weights[r, k]
            products[r, k] = value
            padded[r, k] = value
        for k in range(bins, padded.shape[1]):
            padded[r, k] = 0.0


@njit(cache=True, nogil=True)
def band_of(spectrum: Spectra, first: int, taper: NDArray[np.float32], scale: float, padded: Spectra) -> None:
    """Bins of the band times one taper for all channels, followed by zeros."""
    bins = len(taper)
    for r in range(padded.shape[0]):
        for k in range(bins):
            padded[r, k] = spectrum[r, first + k] * np.float32(taper[k] * scale)
        padded[r, bins:] = 0.0


@njit(cache=True, nogil=True, fastmath=True)
def magnitudes(values: Spectra, out: NDArray[np.float32]) -> None:
    """Absolute values, (receivers, samples)."""
    for r in range(values.shape[0]):
        for k in range(values.shape[1]):
            v = values[r, k]
            out[r, k] = math.sqrt(v.real * v.real + v.imag * v.imag)


@njit(cache=True, nogil=True)
def select(values: NDArray[np.float32], rank: int) -> float:
    """The value that `rank` others are not above; reorders `values`."""
    low, high = 0, len(values) - 1
    while low < high:
        pivot = values[(low + high) // 2]
        i, j = low, high
        while i <= j:
            while values[i] < pivot:
                i += 1
            while values[j] > pivot:
                j -= 1
            if i <= j:
                values[i], values[j] = values[j], values[i]
                i += 1
                j -= 1
        if rank <= j:
            high = j
        elif rank >= i:
            low = i
        else:
            break
    return float(values[rank])


@njit(cache=True, nogil=True)
def quietest(magnitude: NDArray[np.float32], first: int, last: int, noise: Values) -> None:
    """Standard deviation of the real part of each channel's noise, from the quieter half of its magnitudes.

    The mean square of the half of Rayleigh-distributed magnitudes below their median is 2 sigma^2 (1 - ln 2).
    """
    stride = max(1, (last - first) // ENOUGH)
    count = (last - first) // stride
    scratch = np.empty(max(count, 1), dtype=np.float32)
    for r in range(magnitude.shape[0]):
        noise[r] = 0.0
        if count < 2:
            continue
        for k in range(count):
            scratch[k] = magnitude[r, first + k * stride]
        select(scratch, count // 2)
        total = 0.0
        for k in range(count // 2):
            total += scratch[k] * scratch[k]
        noise[r] = math.sqrt(total / (count // 2) / (2 * (1 - math.log(2.0))))


@njit(cache=True, nogil=True, error_model="numpy")
def without_echo(
    products: Spectra,
    passed: Spectra,
    templates: Spectra,
    first_bin: int,
    begin: int,
    kept: int,
    angle: Values,
    padded: Spectra,
) -> None:
    """Band-passed spectrum `passed` less the echo at each channel's angle, `kept` bins from `begin` on.

    The echo's complex amplitude is the sum over `products` there; `templates` are the spectra of one that arrives at
    the first sample.
    """
    work = np.empty(6)
    table = np.empty(RUN, dtype=np.complex64)
    one = complex(1.0, 0.0)
    for r in range(products.shape[0]):
        for k in range(kept):
            padded[r, k] = passed[r, begin + k]
        padded[r, kept:] = 0.0
        if not math.isfinite(angle[r]):
            continue
        moments(products[r], -float(first_bin), angle[r], work)
        rest = (first_bin + begin) * angle[r]
        turned = complex(work[0], work[1]) * complex(math.cos(rest), -math.sin(rest))
        step = complex(math.cos(angle[r]), -math.sin(angle[r]))
        for start in range(0, kept, RUN):
            if start == 0:
                table[0] = 1.0
                one = complex(1.0, 0.0)
                for k in range(1, RUN):
                    one *= step
                    table[k] = one
                one *= step
            height = np.complex64(turned)
            for k in range(min(RUN, kept - start)):
                padded[r, start + k] -= templates[r, begin + start + k] * (table[k] * height)
            turned *= one


@njit(cache=True, nogil=True, error_model="numpy")
def smoothed_energy(envelope: NDArray[np.float32], sections: Values, delay: int, out: Values) -> None:
    """Sum of squares of each channel's envelope (receivers, samples) after two second-order sections (2, 6).

    As if the envelope went on with zeros for `delay` samples, and as many outputs at its beginning were dropped.
    """
    b0, b1, b2, a1, a2 = sections[0, 0], sections[0, 1], sections[0, 2], sections[0, 4], sections[0, 5]
    c0, c1, c2, e1, e2 = sections[1, 0], sections[1, 1], sections[1, 2], sections[1, 4], sections[1, 5]
    samples = envelope.shape[1]
    for r in range(envelope.shape[0]):
        p, q, u, v, total = 0.0, 0.0, 0.0, 0.0, 0.0
        for k in range(samples + delay):
            x = float(envelope[r, k]) if k < samples else 0.0
            y = b0 * x + p
            p = b1 * x - a1 * y + q
            q = b2 * x - a2 * y
            z = c0 * y + u
            u = c1 * y - e1 * z + v
            v = c2 * y - e2 * z
            if k >= delay:
                total += z * z
        out[r] = total
