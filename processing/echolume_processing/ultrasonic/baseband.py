"""A record after the matched filter, at the few samples that the band needs."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from echolume_messages.geometry import require_shape
from echolume_processing.ultrasonic.envelope import Waveforms, low_pass, paper_delay_s
from echolume_processing.ultrasonic.matched_filter import MatchedFilter
from echolume_processing.ultrasonic.record_kernels import (
    band_of,
    fill,
    magnitudes,
    quietest,
    smoothed_energy,
    without_echo,
)

PER_BAND = 1.6
"""Samples of the baseband for each one that its width needs."""
FREEDOM = 1.4
NOISE_BINS = 256
"""Bins in the band's middle that tell the noise to 4 %."""


@dataclass(frozen=True)
class Baseband:
    """One record after the matched filter."""

    bank: MatchedFilter
    spectrum: NDArray[np.complex64]
    """Of the record, (receivers, length // 2 + 1)."""
    products: NDArray[np.complex64]
    """The compressed echoes' spectrum over the band, (receivers, bins): from it they follow at any instant."""
    magnitude: NDArray[np.float32]
    """Of the compressed echoes, (receivers, samples at `rate_hz`)."""
    rate_hz: float

    @property
    def times_s(self) -> NDArray[np.float64]:
        """Of the samples of `magnitude`, after the first sample of the record."""
        return np.arange(self.magnitude.shape[1]) / self.rate_hz

    def magnitude_of(self, products: NDArray[np.complex64]) -> NDArray[np.float32]:
        """Magnitude (samples at `rate_hz`,) of one channel's compressed echoes from their spectrum (bins,)."""
        padded = np.zeros((1, _complex_length(int(PER_BAND * len(products)))), dtype=np.complex64)
        padded[0, : len(products)] = products
        return magnitude_of(padded)[0, : self.magnitude.shape[1]]

    @cached_property
    def passed(self) -> NDArray[np.complex64]:
        """Spectrum of the band-passed record, an analytic signal of the record's own height, (receivers, bins)."""
        receivers, bins = self.bank.weights.shape
        out = np.empty((receivers, bins), dtype=np.complex64)
        band_of(self.spectrum, self.bank.first_bin, self.bank.taper, 2 / self.bank.length, out)
        return out

    @property
    def passed_rate_hz(self) -> float:
        """Rate of signals made from `passed`."""
        return self.bank.sample_rate_hz * _passed_length(self.bank.weights.shape[1]) / self.bank.length

    def white_noise(self, time_s: NDArray[np.float64], gate_s: tuple[float, float]) -> NDArray[np.float64]:
        """Standard deviation of a sample's noise, were it white, per channel (receivers,).

        Parameters
        ----------
        time_s : (receivers,) float64
            Echo that is taken out first; not a number where there is none.
        gate_s : (first, last)
            Where to look.

        Notes
        -----
        From the quieter half of what is left in the band; other echoes than the one taken out may fill the other half.
        """
        bank = self.bank
        receivers, bins = bank.weights.shape
        kept = min(bins, NOISE_BINS)
        begin = (bins - kept) // 2
        padded = np.empty((receivers, _passed_length(kept)), dtype=np.complex64)
        angle = time_s * (2 * np.pi * bank.sample_rate_hz / bank.length)
        without_echo(self.products, self.passed, bank.templates, bank.first_bin, begin, kept, angle, padded)
        rate_hz = bank.sample_rate_hz * padded.shape[1] / bank.length
        first = max(0, int(np.ceil(gate_s[0] * rate_hz)))
        last = min(padded.shape[1], int(gate_s[1] * rate_hz))
        out = np.empty(receivers)
        quietest(magnitude_of(padded), first, max(first, last), out)
        passed = bank.taper[begin : begin + kept].astype(np.float64)
        # As Student's t: errors over a sigma from few values scatter by more than 1. The half's mean square is worth
        # FREEDOM degrees of freedom for each independent value.
        freedom = max(FREEDOM * (last - first) * kept / padded.shape[1], 4.0)
        return out * np.sqrt(bank.length / (2 * np.sum(passed**2)) * freedom / (freedom - 2))

    def energy(self, first_s: float, last_s: float) -> NDArray[np.float64]:
        """Energy below the paper's envelope of the band-passed record between two times, per channel (receivers,).

        Notes
        -----
        The rectified echo, smoothed, is 2 / pi of the magnitude of its analytic signal, smoothed: the harmonics of the
        carrier, which rectifying adds, are far beyond 1 kHz. That signal needs few samples. Equals
        ``energy(paper_envelope(band_pass(...)))`` within 2 %, most of it the sampled rectifier's own aliases.

        References
        ----------
        The paper, section 3.1 and equation 8.
        """
        receivers, bins = self.passed.shape
        padded = np.zeros((receivers, _passed_length(bins)), dtype=np.complex64)
        padded[:, :bins] = self.passed
        rate_hz = self.passed_rate_hz
        first, last = max(0, round(first_s * rate_hz)), max(0, round(last_s * rate_hz))
        out = np.empty(receivers)
        envelope = magnitude_of(padded)[:, first:last]
        smoothed_energy(envelope, low_pass(rate_hz), round(paper_delay_s() * rate_hz), out)
        return out / rate_hz


def baseband(bank: MatchedFilter, waveforms: Waveforms) -> Baseband:
    """Compressed echoes at the few samples that the band needs, with the spectrum that they come from."""
    require_shape("waveforms", waveforms, (len(bank.weights), None))
    spectrum = np.asarray(fft.rfft(waveforms, bank.length, axis=1))
    receivers, bins = bank.weights.shape
    length = _complex_length(int(PER_BAND * bins))
    products = np.empty((receivers, bins), dtype=np.complex64)
    padded = np.empty((receivers, length), dtype=np.complex64)
    fill(spectrum, bank.first_bin, bank.weights, products, padded)
    magnitude = magnitude_of(padded)
    rate_hz = bank.sample_rate_hz * length / bank.length
    kept = min(length, round(waveforms.shape[1] / bank.sample_rate_hz * rate_hz))
    return Baseband(bank, spectrum, products, magnitude[:, :kept], rate_hz)


def magnitude_of(padded: NDArray[np.complex64]) -> NDArray[np.float32]:
    """Magnitude in time of spectra (receivers, bins), which are overwritten."""
    compressed = np.asarray(fft.ifft(padded, axis=1, norm="forward", overwrite_x=True))
    magnitude = np.empty(padded.shape, dtype=np.float32)
    magnitudes(compressed, magnitude)
    return magnitude


def _passed_length(bins: int) -> int:
    return _complex_length(bins + bins // 4)


def _complex_length(at_least: int) -> int:
    return int(fft.next_fast_len(at_least) or at_least)
