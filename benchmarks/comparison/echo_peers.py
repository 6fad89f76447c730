"""Usual ways to a time of flight, each as samples (n,) of echoes (n, samples) with peaks near 1."""

from __future__ import annotations

import numpy as np
from scipy import signal

from comparison.pulses import RATE_HZ

LOW_PASS = signal.butter(3, 1000, fs=RATE_HZ, output="sos")
BAND = signal.butter(3, [36e3, 44e3], "bandpass", fs=RATE_HZ, output="sos")


def crossing(envelope: np.ndarray, level: np.ndarray | float) -> np.ndarray:
    """First sample, interpolated, at which each envelope reaches a level."""
    above = envelope >= np.reshape(level, (-1, 1))
    first = np.maximum(above.argmax(axis=1), 1)
    rows = np.arange(len(envelope))
    before, after = envelope[rows, first - 1], envelope[rows, first]
    wanted = np.broadcast_to(level, before.shape)
    part = np.clip((wanted - before) / np.where(after > before, after - before, 1), 0, 1)
    return np.where(above.any(axis=1), first - 1 + part, np.nan)


def hilbert_threshold(echoes: np.ndarray) -> np.ndarray:
    """Band-pass, scipy.signal.hilbert, half of the peak."""
    envelope = np.abs(signal.hilbert(signal.sosfiltfilt(BAND, echoes, axis=1), axis=1))
    return crossing(envelope, 0.5 * envelope.max(axis=1))


def paper_threshold(echoes: np.ndarray) -> np.ndarray:
    """The paper's rectified low-pass without a band-pass, a fifth of the peak."""
    envelope = signal.sosfilt(LOW_PASS, np.abs(echoes), axis=1)
    envelope = envelope - envelope[:, 60:140].mean(axis=1, keepdims=True)
    return crossing(envelope[:, 150:], 0.2 * envelope.max(axis=1)) + 150


def fixed_threshold(echoes: np.ndarray) -> np.ndarray:
    """The same envelope at a level that does not follow the echo."""
    return crossing(signal.sosfilt(LOW_PASS, np.abs(echoes), axis=1), 0.1)


def onset_parabola(echoes: np.ndarray) -> np.ndarray:
    """Vertex of the parabola through the rise of the band-passed envelope, 15 to 60 % of its peak."""
    envelope = np.abs(signal.hilbert(signal.sosfiltfilt(BAND, echoes, axis=1), axis=1))
    out = np.empty(len(echoes))
    for n, row in enumerate(envelope):
        peak = int(row.argmax())
        low = np.flatnonzero(row[:peak] < 0.15 * row[peak])
        high = np.flatnonzero(row[:peak] < 0.6 * row[peak])
        at = np.arange(low[-1] + 1 if low.size else 0, high[-1] + 2 if high.size else peak)
        slope, offset = np.polyfit(at, np.sqrt(row[at]), 1) if at.size > 2 else (np.nan, np.nan)
        out[n] = -offset / slope
    return out


def correlated(echoes: np.ndarray, template: np.ndarray, origin: float, finer: int = 8) -> np.ndarray:
    """Highest sample of scipy.signal.correlate with the template, both resampled, and a parabola, no envelope."""
    out = np.empty(len(echoes))
    fine_template = signal.resample(template, finer * len(template))
    for n, row in enumerate(signal.resample(echoes, finer * echoes.shape[1], axis=1)):
        score = signal.correlate(row, fine_template, mode="full", method="fft")
        k = int(np.clip(score.argmax(), 1, len(score) - 2))
        bend = score[k - 1] - 2 * score[k] + score[k + 1]
        vertex = k + 0.5 * (score[k - 1] - score[k + 1]) / bend
        out[n] = (vertex - (len(fine_template) - 1)) / finer + origin
    return out


def peaks_of(magnitude: np.ndarray, count: int = 2) -> np.ndarray:
    """Positions of the highest local maxima, ascending; not a number where there are fewer."""
    found, _ = signal.find_peaks(magnitude)
    best = np.sort(found[np.argsort(-magnitude[found])[:count]]).astype(np.float64)
    return np.concatenate([best, np.full(count - len(best), np.nan)])


def clean(compressed: np.ndarray, pulse: np.ndarray, count: int = 2) -> np.ndarray:
    """CLEAN: the highest peak of the complex output, its pulse (complex, centred) taken out, and again."""
    left, half, found = compressed.copy(), len(pulse) // 2, []
    for _ in range(count):
        k = int(np.abs(left).argmax())
        found.append(k)
        first, last = max(0, k - half), min(len(left), k + half + 1)
        left[first:last] -= left[k] * pulse[first - k + half : last - k + half]
    return np.sort(np.array(found, dtype=np.float64))
