"""Compiled search and refinement of echoes in the matched filter's output."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Values = NDArray[np.float64]
Spectra = NDArray[np.complex64]

NEAR = 0.02
"""Of the step between samples: the peak is then reached by one more step."""
RUN = 32
"""Bins whose phases come from one table."""


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
