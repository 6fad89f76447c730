"""Matched filters with one template per channel, over the bins of the transducers' band only."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from echolume_messages.geometry import require_shape
from echolume_processing.ultrasonic.envelope import Waveforms, band_weights, fast_length

ComplexEnvelope: TypeAlias = NDArray[np.complex64]

FILLED_WHITENING, RESONANT_WHITENING = 0.05, np.inf
"""Short pulses are flattened to tell close echoes apart; of resonant ones nothing is gained, only noise."""
PLAIN = np.inf
"""Whitening of the plain matched filter, which sits on the Cramer-Rao bound."""
LEAST_TAPER = 0.02
"""Share of the band-pass below which a template says nothing of the transducer."""
LENGTH_STEP = 256
"""Records are padded to multiples of this, so that few lengths need a filter of their own."""


@dataclass(frozen=True)
class MatchedFilter:
    """Compresses each channel's echoes with that channel's own template.

    The output is 1 (phase 0) at the arrival of an exact copy of the template. `weights` (receivers, bins) are those of
    the bins from `first_bin` on of a transform of `length` samples; `upsampling` output samples of `compress` fall on
    one input sample.
    """

    weights: NDArray[np.complex64]
    first_bin: int
    length: int
    sample_rate_hz: float
    upsampling: int
    taper: NDArray[np.float32]
    """The band-pass itself, (bins,)."""
    templates: NDArray[np.complex64]
    """Band-passed analytic spectrum of a template that arrives at the first sample, (receivers, bins)."""
    pulse: NDArray[np.float64]
    """Spectrum of the compressed pulse, its sum is 1, (receivers, bins)."""

    @cached_property
    def bins_hz(self) -> NDArray[np.float64]:
        """Frequency of each bin, (bins,)."""
        return (self.first_bin + np.arange(self.weights.shape[1])) * (self.sample_rate_hz / self.length)

    @cached_property
    def centre_hz(self) -> NDArray[np.float64]:
        """Mean frequency of the compressed pulse, (receivers,)."""
        return np.asarray(self.pulse @ self.bins_hz, dtype=np.float64)

    @cached_property
    def bandwidth_hz(self) -> NDArray[np.float64]:
        """Effective (rms) bandwidth of the compressed pulse about its centre, (receivers,)."""
        spread_hz = self.bins_hz - self.centre_hz[:, None]
        return np.sqrt(np.sum(self.pulse * spread_hz**2, axis=1))

    @cached_property
    def noise_gain(self) -> NDArray[np.float64]:
        """Standard deviation of the output, real or imaginary, for white noise of 1 in each sample, (receivers,)."""
        power = np.sum(np.abs(self.weights.astype(np.complex128)) ** 2, axis=1)
        return np.sqrt(0.5 * self.length * power)

    @cached_property
    def envelope_error_hz(self) -> NDArray[np.float64]:
        """What the envelope's time of arrival scatters by is 1 / (2 pi SNR) over this, (receivers,).

        The bandwidth itself for the plain matched filter, less than it where the template was flattened.
        """
        power = np.abs(self.weights.astype(np.complex128)) ** 2
        spread_hz = self.bins_hz - self.centre_hz[:, None]
        noise_hz = np.sqrt(np.sum(power * spread_hz**2, axis=1) / np.sum(power, axis=1))
        return self.bandwidth_hz**2 / noise_hz

    @cached_property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Mean frequencies of twelve pieces of the band."""
        return np.array([self.bins_hz[p].mean() for p in self._pieces()])

    @cached_property
    def response(self) -> NDArray[np.float64]:
        """Share of the compressed pulse in each of the twelve pieces, mean of all channels."""
        share = self.pulse.mean(axis=0)
        return np.array([share[p].sum() for p in self._pieces()])

    def _pieces(self) -> list[NDArray[np.intp]]:
        return np.array_split(np.arange(self.weights.shape[1]), 12)

    def compress(self, waveforms: Waveforms) -> ComplexEnvelope:
        """Complex matched-filter output, shape (receivers, upsampling * samples)."""
        require_shape("waveforms", waveforms, (len(self.weights), None))
        spectrum = np.asarray(fft.rfft(waveforms, self.length, axis=1))
        inside = slice(self.first_bin, self.first_bin + self.weights.shape[1])
        full = np.zeros((waveforms.shape[0], self.length * self.upsampling), dtype=np.complex64)
        full[:, inside] = spectrum[:, inside] * self.weights
        out = np.asarray(fft.ifft(full, axis=1, norm="forward", overwrite_x=True), dtype=np.complex64)
        return out[:, : waveforms.shape[1] * self.upsampling]


def _whitening(power: NDArray[np.float64], taper: NDArray[np.float64]) -> float:
    """Whitening that suits the templates: a band is filled where power is within 10 dB of the largest."""
    inside = taper > 0.5
    filled = float(np.mean(power[:, inside] > 0.1 * power.max(axis=1, keepdims=True)))
    return FILLED_WHITENING if filled > 0.6 else RESONANT_WHITENING


def padded_length(samples: int, template: int) -> int:
    """Length of the transform that compresses a record without wrapping it round."""
    return fast_length(-(-(samples + template) // LENGTH_STEP) * LENGTH_STEP)


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
        Echo of a perpendicular plate per channel, band-passed.
    origin : float
        Sample of the template that belongs to the arrival time.
    band_hz : (low, high)
    samples : int
        Length of the echoes to come; shorter ones may be given too.
    whitening : float
        Spectral power, relative to the largest, below which the template is not flattened any further: infinite for
        the plain matched filter (least noise), small for the shortest compressed pulse. By default small for templates
        that fill their band, infinite for resonant ones.

    Notes
    -----
    The weighted matched filter is the Wiener inverse filter, tapered over the band to keep side lobes low. The taper
    has passed over the templates once: an echo is as high in the band's flanks as its template before it was passed.
    """
    require_shape("templates", templates, (None, None))
    length = padded_length(samples, templates.shape[1])
    frequency_hz = np.fft.rfftfreq(length, 1.0 / sample_rate_hz)
    taper = band_weights(frequency_hz, *band_hz)
    inside = np.flatnonzero(taper > LEAST_TAPER)
    first, last = int(inside[0]), int(inside[-1]) + 1
    frequency_hz, taper = frequency_hz[first:last], taper[first:last]
    spectrum = np.asarray(fft.rfft(templates.astype(np.float64), length, axis=1))[:, first:last]
    power = np.abs(spectrum) ** 2
    chosen = _whitening(power, taper) if whitening is None else whitening
    largest = power.max(axis=1, keepdims=True)
    flattened = np.ones_like(power) if np.isinf(chosen) else largest / (power + chosen * largest)
    pulse = power * flattened
    total = pulse.sum(axis=1, keepdims=True)
    turned = np.exp(-2j * np.pi * frequency_hz * origin / sample_rate_hz)
    weights = taper * np.conj(spectrum) * flattened * turned / total
    return MatchedFilter(
        weights.astype(np.complex64),
        first,
        length,
        sample_rate_hz,
        upsampling,
        taper.astype(np.float32),
        (spectrum * np.conj(turned) * 2 / length).astype(np.complex64),
        pulse / total,
    )
