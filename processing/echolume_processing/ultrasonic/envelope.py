"""Envelopes of echoes: band-pass, the paper's rectified low-pass, and the matched filter's complex envelope."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from echolume_messages.geometry import require_shape

Waveforms: TypeAlias = NDArray[np.float32]
"""Echoes of all receivers, shape (receivers, samples)."""
ComplexEnvelope: TypeAlias = NDArray[np.complex64]

FILLED_WHITENING, RESONANT_WHITENING = 0.05, 3.0
CUTOFF_HZ = 1000.0
"""Cut-off of the paper's third-order Butterworth low-pass."""


def band_weights(frequency_hz: NDArray[np.floating], low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Zero-phase band-pass: 1 within the band, cosine flanks of a fifth of the band's width outside it, shape (n,)."""
    flank_hz = max(0.2 * (high_hz - low_hz), 2000.0)
    outside_hz = np.maximum(np.maximum(low_hz - frequency_hz, frequency_hz - high_hz), 0.0)
    return np.asarray(0.5 * (1.0 + np.cos(np.pi * np.minimum(outside_hz / flank_hz, 1.0))), dtype=np.float64)


def _fast_length(at_least: int) -> int:
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
    length = _fast_length(samples + samples // 4)
    spectrum = np.asarray(fft.rfft(waveforms, length, axis=1))
    weights = band_weights(np.fft.rfftfreq(length, 1.0 / sample_rate_hz), low_hz, high_hz).astype(np.float32)
    out: Waveforms = np.asarray(fft.irfft(spectrum * weights, length, axis=1), dtype=np.float32)
    return out[:, :samples]


@lru_cache(maxsize=8)
def _low_pass(sample_rate_hz: float) -> NDArray[np.float64]:
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
    smooth = np.asarray(signal.sosfilt(_low_pass(sample_rate_hz), rectified, axis=1), dtype=np.float32)
    return np.float32(np.pi / 2) * smooth[:, shift:]


def decimated(envelope: Waveforms, sample_rate_hz: float) -> tuple[Waveforms, float]:
    """Keep every sample that a 1 kHz envelope needs (eight times its cut-off), and the rate that is left."""
    step = max(1, int(sample_rate_hz / (8 * CUTOFF_HZ)))
    return np.ascontiguousarray(envelope[:, ::step]), sample_rate_hz / step


@dataclass(frozen=True)
class MatchedFilter:
    """Compresses each channel's echoes with that channel's own template.

    The output is 1 (phase 0) at the arrival of an exact copy of the template. `weights` (receivers, length) are
    one-sided, so the output is analytic; `upsampling` output samples fall on one input sample.
    """

    weights: NDArray[np.complex64]
    length: int
    upsampling: int
    centre_hz: NDArray[np.float64]
    bandwidth_hz: NDArray[np.float64]
    """Effective (rms) bandwidth about the centre, per channel."""
    frequency_hz: NDArray[np.float64]
    response: NDArray[np.float64]
    """Share of the compressed pulse at each of twelve frequencies, mean of all channels."""

    def compress(self, waveforms: Waveforms) -> ComplexEnvelope:
        """Complex matched-filter output, shape (receivers, upsampling * samples)."""
        samples = waveforms.shape[1]
        spectrum = np.asarray(fft.rfft(waveforms, self.length, axis=1))
        bins = self.weights.shape[1]
        full = np.zeros((waveforms.shape[0], self.length * self.upsampling), dtype=np.complex64)
        full[:, :bins] = spectrum[:, :bins] * self.weights
        out: ComplexEnvelope = np.asarray(fft.ifft(full, axis=1, overwrite_x=True), dtype=np.complex64)
        return out[:, : samples * self.upsampling]


def _whitening(power: NDArray[np.float64], taper: NDArray[np.float64]) -> float:
    """Whitening that suits the templates: a band is filled where power is within 10 dB of the largest."""
    inside = taper > 0.5
    filled = float(np.mean(power[:, inside] > 0.1 * power.max(axis=1, keepdims=True)))
    return FILLED_WHITENING if filled > 0.6 else RESONANT_WHITENING


def matched_filter(
    templates: Waveforms,
    origin: float,
    sample_rate_hz: float,
    band_hz: tuple[float, float],
    samples: int,
    *,
    upsampling: int = 4,
    whitening: float | None = None,
) -> MatchedFilter:
    """Make the matched filter of a set of templates.

    Parameters
    ----------
    templates : (receivers, length) float32
        Echo of a perpendicular plate per channel.
    origin : float
        Sample of the template that belongs to the arrival time.
    band_hz : (low, high)
    samples : int
        Length of the echoes to come.
    whitening : float
        Spectral power, relative to the largest, below which the template is not flattened any further; large values
        give the plain matched filter (least noise), small ones the shortest compressed pulse. By default small for
        templates that fill their band, large for resonant ones.

    Notes
    -----
    The weighted matched filter is the Wiener inverse filter, tapered over the band to keep side lobes low.
    """
    require_shape("templates", templates, (None, None))
    length = _fast_length(samples + templates.shape[1])
    frequency_hz = np.fft.rfftfreq(length, 1.0 / sample_rate_hz)
    spectrum = np.asarray(fft.rfft(templates.astype(np.float64), length, axis=1))
    power = np.abs(spectrum) ** 2
    taper = band_weights(frequency_hz, *band_hz)
    floor = (_whitening(power, taper) if whitening is None else whitening) * power.max(axis=1, keepdims=True)
    inverse = taper * np.conj(spectrum) / (power + floor)
    inverse = inverse * np.exp(-2j * np.pi * frequency_hz * origin / sample_rate_hz)
    response = np.maximum((taper * power / (power + floor)), 0.0)
    total = response.sum(axis=1, keepdims=True)
    centre_hz = (response * frequency_hz).sum(axis=1) / total[:, 0]
    spread = (response * (frequency_hz - centre_hz[:, None]) ** 2).sum(axis=1) / total[:, 0]
    # One-sided sum / total = 1 at the arrival; ifft divides by its length.
    weights = inverse * (length * upsampling) / total
    inside = np.flatnonzero(taper > 0)
    pieces = np.array_split(inside, 12)
    share = (response / total).mean(axis=0)
    return MatchedFilter(
        weights.astype(np.complex64),
        length,
        upsampling,
        centre_hz,
        np.sqrt(spread),
        np.array([frequency_hz[p].mean() for p in pieces]),
        np.array([share[p].sum() for p in pieces]),
    )


def energy(envelope: NDArray[np.float32], sample_rate_hz: float) -> NDArray[np.float64]:
    """Energy below an envelope, the integral of its square over time, per channel (receivers,).

    References
    ----------
    The paper, equation 8.
    """
    require_shape("envelope", envelope, (None, None))
    return np.sum(envelope.astype(np.float64) ** 2, axis=1) / sample_rate_hz
