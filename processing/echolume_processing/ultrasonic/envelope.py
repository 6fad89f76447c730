"""Band-pass, the paper's rectified and smoothed envelope, and the energy below it."""

from __future__ import annotations

from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft, interpolate, signal

from echolume_messages.geometry import require_shape

Waveforms: TypeAlias = NDArray[np.float32]
"""Echoes of all receivers, shape (receivers, samples)."""

CUTOFF_HZ = 1000.0
"""Cut-off of the paper's third-order Butterworth low-pass."""
KEPT = 24
"""Samples of the decimated envelope for each period of the cut-off."""


def band_weights(frequency_hz: NDArray[np.floating], low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Zero-phase band-pass: 1 within the band, cosine flanks of a fifth of the band's width outside it, shape (n,)."""
    flank_hz = max(0.2 * (high_hz - low_hz), 2000.0)
    outside_hz = np.maximum(np.maximum(low_hz - frequency_hz, frequency_hz - high_hz), 0.0)
    return np.asarray(0.5 * (1.0 + np.cos(np.pi * np.minimum(outside_hz / flank_hz, 1.0))), dtype=np.float64)


def fast_length(at_least: int) -> int:
    """A length that real transforms are quick at."""
    return int(fft.next_fast_len(at_least, real=True) or at_least)


def band_pass(waveforms: Waveforms, sample_rate_hz: float, low_hz: float, high_hz: float) -> Waveforms:
    """Keep the transducers' band without delaying it.

    Parameters
    ----------
    waveforms : (receivers, samples) float32
    sample_rate_hz, low_hz, high_hz : float

    Returns
    -------
    (receivers, samples) float32
    """
    require_shape("waveforms", waveforms, (None, None))
    samples = waveforms.shape[1]
    length = fast_length(samples + samples // 4)
    spectrum = np.asarray(fft.rfft(waveforms, length, axis=1))
    weights = band_weights(np.fft.rfftfreq(length, 1.0 / sample_rate_hz), low_hz, high_hz).astype(np.float32)
    out: Waveforms = np.asarray(fft.irfft(spectrum * weights, length, axis=1), dtype=np.float32)
    return out[:, :samples]


@lru_cache(maxsize=64)
def low_pass(sample_rate_hz: float) -> NDArray[np.float64]:
    """The paper's third-order Butterworth low-pass as second-order sections (2, 6)."""
    return np.asarray(signal.butter(3, CUTOFF_HZ, fs=sample_rate_hz, output="sos"), dtype=np.float64)


def paper_delay_s() -> float:
    """Delay of the third-order 1 kHz Butterworth at low frequency: 2 / (2 pi f), 318 us or 54.6 mm of range."""
    return 2.0 / (2.0 * np.pi * CUTOFF_HZ)


def paper_envelope(waveforms: Waveforms, sample_rate_hz: float) -> Waveforms:
    """Rectify and low-pass at 1 kHz, third-order Butterworth, its delay taken out.

    Parameters
    ----------
    waveforms : (receivers, samples) float32
        Band-passed echoes.
    sample_rate_hz : float

    Returns
    -------
    (receivers, samples) float32
        Scaled by pi/2, so a steady tone gives its amplitude. Sample k belongs to input sample k.

    Notes
    -----
    Echoes closer than about 200 mm of range merge.

    References
    ----------
    The paper, section 3.1 and figure 4.
    """
    require_shape("waveforms", waveforms, (None, None))
    shift = round(paper_delay_s() * sample_rate_hz)
    rectified = np.abs(np.pad(waveforms, ((0, 0), (0, shift))))
    smooth = np.asarray(signal.sosfilt(low_pass(sample_rate_hz), rectified, axis=1), dtype=np.float32)
    return np.float32(np.pi / 2) * smooth[:, shift:]


def decimated(envelope: Waveforms, sample_rate_hz: float) -> tuple[Waveforms, float]:
    """Keep the samples that the paper's envelope needs, 24 for each period of its cut-off, and the rate that is left.

    Notes
    -----
    `restored` gives every sample back within 0.2 % of the envelope's peak. The third-order low-pass falls slowly: 8
    samples a period would leave 2 % for a short pulse, 16 still 0.3 %.
    """
    step = max(1, int(sample_rate_hz / (KEPT * CUTOFF_HZ)))
    return np.ascontiguousarray(envelope[:, ::step]), sample_rate_hz / step


def restored(few: Waveforms, few_rate_hz: float, samples: int, sample_rate_hz: float) -> Waveforms:
    """Every sample of a decimated envelope (receivers, samples), by splines of fifth order."""
    require_shape("few", few, (None, None))
    spline = interpolate.make_interp_spline(np.arange(few.shape[1]) / few_rate_hz, few.astype(np.float64), 5, axis=1)
    at_s = np.minimum(np.arange(samples) / sample_rate_hz, (few.shape[1] - 1) / few_rate_hz)
    return np.asarray(spline(at_s), dtype=np.float32)


def energy(envelope: NDArray[np.float32], sample_rate_hz: float) -> NDArray[np.float64]:
    """Energy below an envelope, the integral of its square over time, per channel (receivers,).

    References
    ----------
    The paper, equation 8.
    """
    require_shape("envelope", envelope, (None, None))
    return np.sum(envelope.astype(np.float64) ** 2, axis=1) / sample_rate_hz
