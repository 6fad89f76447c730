"""Echoes with known arrivals for the figures of the echo chain, made without the chain's own code."""

from __future__ import annotations

import numpy as np

RATE_HZ = 250e3
SPEED_MM_PER_S = 343.2e3
CARRIER_HZ = 40e3
CYCLES = 8
FINE = 8


def resonator(f_hz: np.ndarray, centre_hz: float, quality: float) -> np.ndarray:
    f = np.maximum(f_hz, 1.0)
    return 1 / (1 + 1j * quality * (f / centre_hz - centre_hz / f))


def resonant(f_hz: np.ndarray, quality: float = 20.0, centre_hz: float = CARRIER_HZ) -> np.ndarray:
    """Eight cycles of 40 kHz through an emitter of the given resonance and a receiver of 40 kHz and Q 20."""
    f = np.where(f_hz == CARRIER_HZ, CARRIER_HZ + 1e-3, f_hz)
    burst = (1 - np.exp(-2j * np.pi * f * CYCLES / CARRIER_HZ)) / (CARRIER_HZ**2 - f**2)
    return burst * resonator(f, centre_hz, quality) * resonator(f, CARRIER_HZ, 20.0)


def wideband(f_hz: np.ndarray) -> np.ndarray:
    """30 to 60 kHz at -6 dB, raised-cosine edges 10 kHz wide."""
    rise, fall = np.clip((f_hz - 25e3) / 10e3, 0, 1), np.clip((65e3 - f_hz) / 10e3, 0, 1)
    return (np.sin(np.pi / 2 * rise) * np.sin(np.pi / 2 * fall)) ** 2 + 0j


class Pulse:
    """A pulse of peak 1 that can be put anywhere."""

    def __init__(self, spectrum, samples: int = 1024, **changed: float) -> None:
        self.samples, self.length = samples, 4 * samples
        self.f_hz = np.fft.rfftfreq(self.length, 1 / RATE_HZ)
        raw = spectrum(self.f_hz, **changed)
        fine = np.fft.irfft(raw, self.length * FINE) * FINE
        self.spectrum = raw / np.abs(fine).max()
        power = np.abs(self.spectrum) ** 2
        self.centre_hz = float(np.sum(power * self.f_hz) / np.sum(power))
        self.rms_hz = float(np.sqrt(np.sum(power * (self.f_hz - self.centre_hz) ** 2) / np.sum(power)))
        self.root_energy = float(np.sqrt(np.sum(np.fft.irfft(self.spectrum, self.length) ** 2)))

    def at(self, arrivals: np.ndarray, heights: np.ndarray | float = 1.0) -> np.ndarray:
        """Echoes (n, samples) at fractional samples (n,) with complex heights."""
        turned = np.exp(-2j * np.pi * self.f_hz * np.atleast_1d(arrivals)[:, None] / RATE_HZ)
        spectra = self.spectrum * turned * np.reshape(heights, (-1, 1))
        return np.fft.irfft(spectra, self.length)[:, : self.samples]

    def envelope_bound_mm(self, noise: float) -> float:
        """Cramer-Rao bound of the range by the complex envelope alone."""
        return 0.5 * SPEED_MM_PER_S / (2 * np.pi * self.rms_hz * self.root_energy / noise)

    def phase_bound_mm(self, noise: float) -> float:
        """The same where the carrier's phase is known."""
        both_hz = np.hypot(self.rms_hz, self.centre_hz)
        return 0.5 * SPEED_MM_PER_S / (2 * np.pi * both_hz * self.root_energy / noise)


def noise_of(snr_db: float) -> float:
    """Rms of the noise for a peak of 1."""
    return 10 ** (-snr_db / 20)
