"""Compiled inner loops of the echo chain."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

Values = NDArray[np.float64]
Spectra = NDArray[np.complex64]

ENOUGH = 512
"""Samples that tell the noise to 3 %."""
NEAR = 0.02
"""Of the step between samples: the peak is then reached by one more step."""
RUN = 32
"""Bins whose phases come from one table."""


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


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"reassoc", "contract", "nsz"})
def moments(row: Spectra, centre: float, step: float, out: Values) -> None:
    """y, y' and y'' over the angle of sum_k row[k] exp(i (k - centre) step), each real and imaginary, in bins.

    The phases of a run of bins are a table times the phase of its first, so that the inner loop has no recursion.
    """
    table_re = np.empty(RUN, dtype=np.float32)
    table_im = np.empty(RUN, dtype=np.float32)
    c1, s1 = math.cos(step), math.sin(step)
    c, s = 1.0, 0.0
    for k in range(RUN):
        table_re[k] = c
        table_im[k] = s
        c, s = c * c1 - s * s1, c * s1 + s * c1
    cr, sr = c, s  # one run further
    c, s = math.cos(-centre * step), math.sin(-centre * step)
    for k in range(6):
        out[k] = 0.0
    bins = len(row)
    for start in range(0, bins, RUN):
        a_re = a_im = b_re = b_im = d_re = d_im = np.float32(0.0)
        for k in range(min(RUN, bins - start)):
            v = row[start + k]
            x = v.real * table_re[k] - v.imag * table_im[k]
            y = v.real * table_im[k] + v.imag * table_re[k]
            at = np.float32(k)
            a_re += x
            a_im += y
            b_re += at * x
            b_im += at * y
            d_re += at * at * x
            d_im += at * at * y
        away = start - centre
        # sums over (k + away) and its square
        e_re, e_im = b_re + away * a_re, b_im + away * a_im
        f_re = d_re + 2 * away * b_re + away * away * a_re
        f_im = d_im + 2 * away * b_im + away * away * a_im
        out[0] += a_re * c - a_im * s
        out[1] += a_re * s + a_im * c
        # i times the sum
        out[2] -= e_re * s + e_im * c
        out[3] += e_re * c - e_im * s
        out[4] -= f_re * c - f_im * s
        out[5] -= f_re * s + f_im * c
        c, s = c * cr - s * sr, c * sr + s * cr


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
def climb(values: NDArray[np.float32], start: int) -> int:
    """The local maximum uphill of a sample: the threshold's slope moves the maxima of their ratio."""
    peak = start
    while peak > 0 and values[peak - 1] > values[peak]:
        peak -= 1
    while peak + 1 < len(values) and values[peak + 1] > values[peak]:
        peak += 1
    return peak


@njit(cache=True, nogil=True, error_model="numpy")
def search(
    magnitude: NDArray[np.float32],
    inverse_threshold: NDArray[np.float32],
    first: int,
    last: int,
    floor: float,
    strongest: bool,
    start: Values,
    count: NDArray[np.uint8],
) -> None:
    """First maximum of each channel that reaches the threshold, else its highest; -1 where that is below the floor."""
    for r in range(magnitude.shape[0]):
        row = magnitude[r]
        best, best_at, reached, lobes = 0.0, -1, -1, 0
        for k in range(first, last):
            middle = row[k] * inverse_threshold[k]
            if middle < 0.8 * floor:  # noise, mostly; a maximum between two samples is not that much higher
                continue
            left = row[k - 1] * inverse_threshold[k - 1]
            right = row[k + 1] * inverse_threshold[k + 1]
            if middle <= left or middle < right:
                continue
            lean = left - right
            height = middle - 0.125 * lean * lean / (left - 2 * middle + right)
            if height >= 0.5:
                lobes += 1
            if height > best:
                best, best_at = height, k
            if reached < 0 and height >= 1.0:
                reached = k
        count[r] = min(255, lobes)
        start[r] = -1.0
        if best_at < 0 or best < floor:
            continue
        k = climb(row, best_at if strongest or reached < 0 else reached)
        start[r] = k
        if 0 < k < len(row) - 1:
            bend = row[k - 1] - 2 * row[k] + row[k + 1]
            if bend < 0:
                start[r] += 0.5 * (row[k - 1] - row[k + 1]) / bend


@njit(cache=True, nogil=True, error_model="numpy")
def peak_of(row: Spectra, centre: float, start: float, reach: float, work: Values) -> float:
    """Angle near `start` where the magnitude of the sum over a band is largest; `work` then holds it."""
    angle = start
    for _ in range(8):
        moments(row, centre, angle, work)
        slope = work[0] * work[2] + work[1] * work[3]
        bend = work[2] ** 2 + work[3] ** 2 + work[0] * work[4] + work[1] * work[5]
        if bend >= 0:
            break
        change = min(max(-slope / bend, -0.5 * reach), 0.5 * reach)
        if abs(angle + change - start) > 2 * reach:
            break
        angle += change
        if abs(change) < NEAR * reach:
            for k in range(4):
                work[k] += change * (work[k + 2] + (0.5 * change * work[k + 4] if k < 2 else 0.0))
            break
    return angle


@njit(cache=True, nogil=True, error_model="numpy")
def refine(
    products: Spectra, first_bin: int, centre: Values, start: Values, reach: float, max_phase: float, out: Values
) -> None:
    """Angles (time times 2 pi times the bins' spacing) of envelope and phase, amplitude and phase, (receivers, 4)."""
    work = np.empty(6)
    for r in range(products.shape[0]):
        if not start[r] >= 0:
            out[r] = math.nan
            continue
        row = products[r]
        peak = peak_of(row, centre[r] - first_bin, start[r], reach, work)
        amplitude = math.hypot(work[0], work[1])
        angle, phase = peak, 0.0
        for turn in range(3):
            whole = math.atan2(work[1], work[0]) + centre[r] * angle
            wrapped = whole - 2 * math.pi * math.floor(whole / (2 * math.pi) + 0.5)
            if turn == 0:
                phase = wrapped
                if abs(phase) > max_phase:
                    break
            square = work[0] ** 2 + work[1] ** 2
            drift = (work[0] * work[3] - work[1] * work[2]) / square if square > 0 else 0.0
            drift = min(max(drift, -0.1 * centre[r]), 0.1 * centre[r])
            angle -= wrapped / (centre[r] + drift)
            if abs(wrapped) < 1e-3 or turn == 2:
                break
            moments(row, centre[r] - first_bin, angle, work)
        out[r, 0], out[r, 1], out[r, 2], out[r, 3] = peak, angle, amplitude, phase


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
def leading_edges(
    waveforms: NDArray[np.float32],
    height: Spectra,
    slope: Spectra,
    lengths: NDArray[np.int64],
    start: Values,
    out: Values,
) -> None:
    """Where the first part of each channel's template fits best, from the sample `start` at which it is expected.

    Parameters are the filters for the height and for its product with the negative shift, (receivers, samples); `out`
    receives the shift in samples and the magnitude of the height, (receivers, 2).
    """
    for r in range(waveforms.shape[0]):
        out[r, 0] = out[r, 1] = math.nan
        shift = 0.0
        if not math.isfinite(start[r]):
            continue
        for _ in range(4):
            first = math.floor(start[r] + shift + 0.5)
            if first < 0 or first + lengths[r] > waveforms.shape[1]:
                break
            a_re = a_im = d_re = d_im = np.float32(0.0)
            for k in range(lengths[r]):
                value = waveforms[r, first + k]
                a_re += value * height[r, k].real
                a_im += value * height[r, k].imag
                d_re += value * slope[r, k].real
                d_im += value * slope[r, k].imag
            square = a_re * a_re + a_im * a_im
            if square <= 0:
                break
            change = min(max(-(a_re * d_re + a_im * d_im) / square, -8.0), 8.0)
            before = shift
            shift = first - start[r] + change
            out[r, 0], out[r, 1] = shift, math.sqrt(square)
            if abs(shift - before) < 0.5:
                break


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
