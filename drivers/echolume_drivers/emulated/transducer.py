"""Emitter and receivers: pulse, frequency response per channel, piston directivity."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from echolume_drivers.emulated.array_truth import ArrayTruth
from echolume_messages.rig import ArraySettings

CARRIER_HZ = 40e3
"""The paper's kind of transducer."""
CYCLES = 8
EMITTER_QUALITY = 20.0
BANDS = {"wideband": (26e3, 35e3, 45e3, 55e3, 64e3), "paper": (32e3, 36e3, 40e3, 44e3, 48e3)}
"""Frequencies at which directivity is taken; between them the spectra are interpolated."""
TABLE = 1025
"""Entries of the directivity table over sin^2 of the angle."""


def speed_of_sound_mps(temperature_c: float) -> float:
    """Speed of sound in air, 331.3 sqrt(1 + T / 273.15)."""
    return float(331.3 * np.sqrt(1 + temperature_c / 273.15))


def directivity(sine_squared: NDArray[np.float64], ka: float | NDArray[np.float64]) -> NDArray[np.float64]:
    """Far-field directivity 2 J1(x) / x of a piston, x = ka sin(angle), at any shape of `sine_squared`."""
    x = np.maximum(ka * np.sqrt(np.maximum(sine_squared, 0)), 1e-9)
    return 2 * j1(x) / x


def directivity_table(bands_hz: NDArray[np.float64], radius_mm: float, speed_mps: float) -> NDArray[np.float32]:
    """One-way directivity over sin^2 from 0 to 1 at each band, shape (TABLE, bands)."""
    sine_squared = np.linspace(0, 1, TABLE)
    wavenumbers = 2 * np.pi * bands_hz / speed_mps
    columns = [directivity(sine_squared, float(k) * radius_mm * 1e-3) for k in wavenumbers]
    return np.stack(columns, axis=1).astype(np.float32)


def band_weights(frequencies_hz: NDArray[np.float64], bands_hz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Lagrange weights in f^2 that carry values from the bands to each frequency, shape (bands, frequencies).

    Directivity and facet apertures are even, entire functions of frequency; outside the bands the nearest value
    is held.
    """
    at = np.clip(frequencies_hz, bands_hz[0], bands_hz[-1]) ** 2
    nodes = bands_hz**2
    rows = [
        np.prod([(at - other) / (node - other) for other in nodes if other != node], axis=0) for node in nodes.tolist()
    ]
    return np.stack(rows)


def _resonator(frequencies_hz: NDArray[np.float64], centre_hz: float, quality: float) -> NDArray[np.complex128]:
    f = np.maximum(frequencies_hz, 1.0)
    return np.asarray(1 / (1 + 1j * quality * (f / centre_hz - centre_hz / f)), dtype=np.complex128)


def _burst(frequencies_hz: NDArray[np.float64]) -> NDArray[np.complex128]:
    """Fourier integral of whole cycles of a sine."""
    f = np.where(frequencies_hz == CARRIER_HZ, CARRIER_HZ + 1e-3, frequencies_hz)
    turned = np.exp(-2j * np.pi * f * (CYCLES / CARRIER_HZ))
    return np.asarray((1 - turned) * CARRIER_HZ / (2 * np.pi * (CARRIER_HZ**2 - f**2)), dtype=np.complex128)


def _band(frequencies_hz: NDArray[np.float64], low_hz: float, high_hz: float) -> NDArray[np.float64]:
    """Band with raised-cosine edges 10 kHz wide, -6 dB at its limits."""
    rise = np.clip((frequencies_hz - (low_hz - 5e3)) / 10e3, 0, 1)
    fall = np.clip(((high_hz + 5e3) - frequencies_hz) / 10e3, 0, 1)
    return np.asarray(np.sin(np.pi / 2 * rise) ** 2 * np.sin(np.pi / 2 * fall) ** 2, dtype=np.float64)


def channel_spectra(
    array: ArraySettings, truth: ArrayTruth, frequencies_hz: NDArray[np.float64]
) -> NDArray[np.complex128]:
    """Spectrum of the received pulse of each channel, peak 1 in time for the nominal one, shape (n, frequencies).

    Includes each channel's delay, gain and spread. The wideband pulse is centred on its arrival; the narrow-band
    burst starts there.
    """
    wideband = array.pulse == "wideband"
    rows: list[NDArray[np.complex128]] = []
    for n, shift in enumerate(truth.centre_shift.tolist()):
        if wideband:
            layout = array.layout
            centre_hz = (layout.low_hz + layout.high_hz) / 2 * (1 + shift)
            pulse = _band(frequencies_hz / (1 + shift), layout.low_hz, layout.high_hz) * (
                1 + complex(truth.ripple[n]) * _resonator(frequencies_hz, centre_hz, 6.0)
            )
        else:
            pulse = (
                _burst(frequencies_hz)
                * _resonator(frequencies_hz, CARRIER_HZ, EMITTER_QUALITY)
                * _resonator(frequencies_hz, CARRIER_HZ * (1 + 0.3 * shift), float(truth.quality[n]))
            )
        rows.append(truth.gains[n] * pulse * np.exp(-2j * np.pi * frequencies_hz * truth.delays_s[n]))
    return np.stack(rows) / _nominal_peak(array.pulse, array.layout.low_hz, array.layout.high_hz)


@lru_cache
def _nominal_peak(pulse: str, low_hz: float, high_hz: float) -> float:
    """Largest value in time of the nominal channel's pulse."""
    step_hz, fine = 50.0, 40_000
    f = np.arange(0, 125e3, step_hz)
    if pulse == "wideband":
        spectrum = _band(f, low_hz, high_hz).astype(np.complex128)
    else:
        spectrum = _burst(f) * _resonator(f, CARRIER_HZ, EMITTER_QUALITY) ** 2
    return float(np.max(np.abs(np.fft.irfft(spectrum, n=fine)))) * fine * step_hz
