"""Echoes with known arrivals, made without the code under test."""

from __future__ import annotations

import numpy as np

RATE_HZ = 250e3
SPEED_MM_PER_S = 343.2e3
SAMPLES, LENGTH = 1024, 4096
ORIGIN = 60
F_HZ = np.fft.rfftfreq(LENGTH, 1 / RATE_HZ)


def resonator(centre_hz: float, quality: float) -> np.ndarray:
    f = np.maximum(F_HZ, 1.0)
    return 1 / (1 + 1j * quality * (f / centre_hz - centre_hz / f))


def resonant(quality: float = 20.0, centre_hz: float = 40e3) -> np.ndarray:
    """Spectrum of eight cycles of 40 kHz through a changed emitter and a receiver of 40 kHz and Q 20, peak 1."""
    f = F_HZ + 1e-3
    burst = (1 - np.exp(-2j * np.pi * f * 8 / 40e3)) / (40e3**2 - f**2)
    return scaled(burst * resonator(centre_hz, quality) * resonator(40e3, 20.0))


def wideband() -> np.ndarray:
    """Spectrum of a pulse of 30 to 60 kHz at -6 dB, peak 1."""
    edges = np.clip((F_HZ - 25e3) / 10e3, 0, 1), np.clip((65e3 - F_HZ) / 10e3, 0, 1)
    return scaled(np.sin(np.pi / 2 * edges[0]) ** 2 * np.sin(np.pi / 2 * edges[1]) ** 2 + 0j)


def scaled(spectrum: np.ndarray) -> np.ndarray:
    return spectrum / np.abs(np.fft.irfft(spectrum, 16 * LENGTH) * 16).max()


def echoes(spectrum: np.ndarray, arrivals: np.ndarray, heights: np.ndarray | float = 1.0) -> np.ndarray:
    """Echoes (n, SAMPLES) at fractional samples (n,) with complex heights."""
    turned = np.exp(-2j * np.pi * F_HZ * np.atleast_1d(arrivals)[:, None] / RATE_HZ)
    return np.fft.irfft(spectrum * turned * np.reshape(heights, (-1, 1)), LENGTH)[:, :SAMPLES]


def bounds_s(spectrum: np.ndarray, noise: float) -> tuple[float, float]:
    """Cramer-Rao bounds of the arrival by the complex envelope alone, and with a known phase."""
    power = np.abs(spectrum) ** 2
    centre_hz = np.sum(power * F_HZ) / np.sum(power)
    rms_hz = np.sqrt(np.sum(power * (F_HZ - centre_hz) ** 2) / np.sum(power))
    snr = np.sqrt(np.sum(np.fft.irfft(spectrum, LENGTH) ** 2)) / noise
    return 1 / (2 * np.pi * rms_hz * snr), 1 / (2 * np.pi * np.hypot(rms_hz, centre_hz) * snr)
