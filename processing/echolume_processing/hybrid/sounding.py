"""All pings of a scan beside what a surface would have returned: the forward-model comparison."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_processing.hybrid.channel import Channels, Gate, band_of, channels, gate, speed_of_sound
from echolume_processing.hybrid.model import Registration
from echolume_processing.hybrid.predict import Aperture, Band, Predictor, aperture
from echolume_processing.hybrid.surface import Surface
from echolume_processing.ping import Ping

CEILING_MM = 70.0
"""No scene is higher than this above the bench."""
FLOOR_MM = -20.0
PULSE_ENERGY = 0.98
SEARCH_MM = 1.5
"""Self-registration looks this far up and down."""
STEP_MM = 0.02
GAIN_TERMS = 4
BEST_SHARE = 1 / 3
"""So many pings, the best ones, register the array; the others may look at what light cannot see."""

Waveforms = NDArray[np.complex64]
"""Gated complex waveforms (pings, receivers, samples)."""
Spectra = NDArray[np.complex64]
"""Band spectra (pings, receivers, bins)."""


@dataclass(frozen=True)
class Sounding:
    """The pings of a scan in the form in which they are compared."""

    band: Band
    predictor: Predictor
    channels: Channels
    gate: Gate
    speed_mps: float
    apertures: tuple[Aperture, ...]
    measured: Waveforms
    """Gated waveforms of every ping, per receiver, the channels' delays removed."""
    energy: NDArray[np.float64]
    """(pings,)"""

    @property
    def foot_mm(self) -> NDArray[np.float64]:
        """Where the axis of each ping meets the bench, shape (pings, 2)."""
        centre = np.array([a.elements_mm[0] for a in self.apertures])
        axis = np.array([a.axis for a in self.apertures])
        return centre[:, :2] - axis[:, :2] / axis[:, 2:] * centre[:, 2:]

    def predict(self, scene: Surface, which: Sequence[int] | NDArray[np.int64]) -> Spectra:
        """Predicted band spectra in counts of some pings over a surface, each by itself, side by side on the cores."""

        def one(k: int) -> NDArray[np.complex64]:
            return self.channels.predicted(self.predictor.spectra(scene, self.apertures[k]))

        with ThreadPoolExecutor(os.cpu_count()) as pool:
            return np.stack(list(pool.map(one, [int(k) for k in which])))

    def residual(self, predicted: Spectra, which: NDArray[np.int64]) -> NDArray[np.float64]:
        """Energy of measured minus predicted over the measured energy, one number a ping."""
        difference = self.measured[which] - self.gate.waveform(predicted)
        return (np.abs(difference) ** 2).sum(axis=(1, 2)) / self.energy[which]


def sounding(pings: Sequence[Ping], calibration: ArrayCalibration) -> Sounding:
    """Bring pings of one digitiser setting, sorted by trigger, into comparable form.

    Raises
    ------
    ValueError
        If there is no ping, or the pings differ in length or sample rate.
    """
    kinds = {(p.echoes.shape, p.sample_rate_hz) for p in pings}
    if len(kinds) != 1:
        raise ValueError(f"pings: expected one length and sample rate, got {sorted(kinds)}")
    band = band_of(calibration, pings[0])
    speed_mps = speed_of_sound(calibration, float(np.median([p.air_temperature_c for p in pings])))
    predictor = Predictor(calibration.radius_mm, speed_mps, band)
    raw = channels(calibration, band, predictor)
    early = np.exp(2j * np.pi * band.frequency_hz * np.array(calibration.delays_s)[:, None]).astype(np.complex64)
    response = replace(raw, response=raw.response * early)
    apertures = tuple(aperture(calibration, p.robot_pose) for p in pings)
    z_mm = np.array([a.elements_mm[:, 2] for a in apertures])
    window = gate(
        band,
        2 * max(float(z_mm.min()) - CEILING_MM, 0.3 * float(z_mm.min())) / (speed_mps * 1e3),
        2 * (float(z_mm.max()) - FLOOR_MM) / (speed_mps * 1e3) + _pulse_s(calibration),
    )
    measured = np.stack([window.waveform(response.measured(p) * early) for p in pings])
    energy = (np.abs(measured).astype(np.float64) ** 2).sum(axis=(1, 2))
    return Sounding(band, predictor, response, window, speed_mps, apertures, measured, energy)


def _pulse_s(calibration: ArrayCalibration) -> float:
    """How long the echo of a plate lasts after its arrival."""
    power = (np.array(calibration.templates, dtype=np.float64) ** 2).sum(axis=0)
    after = np.cumsum(power) / power.sum()
    last = int(np.searchsorted(after, PULSE_ENERGY))
    return max(0.0, (last - calibration.template_origin) / calibration.sample_rate_hz)


def register(found: Sounding, predicted: Spectra) -> tuple[Sounding, Spectra, Registration]:
    """Bring predictions of all pings onto the measured echoes: one height offset, one smooth gain per channel.

    Returns
    -------
    tuple
        The sounding with the correction in its channels, the corrected predictions, and what was found.

    Notes
    -----
    The offset is the median, over the best third of the pings, of the shift that fits each best, so pings over
    glass do not take part. It also takes up most of an error in the speed of sound, since all ranges of a scan
    are alike. The gain is a complex polynomial over frequency, fitted on the same pings.
    """
    everything = np.arange(len(found.apertures))
    shifts_mm = np.arange(-SEARCH_MM, SEARCH_MM + STEP_MM / 2, STEP_MM)
    slow = 2j * np.pi * found.band.frequency_hz * 2 / (found.speed_mps * 1e3)
    like = _likeness(found, predicted, np.exp(-slow * shifts_mm[:, None]).astype(np.complex64))
    best = like.argmax(axis=1)
    peak = like[everything, best]
    good = peak >= np.quantile(peak, 1 - BEST_SHARE)
    dz_mm = float(np.median(shifts_mm[best[good]]))
    turn = np.exp(-slow * dz_mm).astype(np.complex64)
    gain = _gain(found, predicted[good] * turn, found.measured[good])
    correction = (turn * gain).astype(np.complex64)
    moved = replace(found, channels=replace(found.channels, response=found.channels.response * correction))
    corrected = predicted * correction
    residual = moved.residual(corrected[good], np.nonzero(good)[0])
    return (
        moved,
        corrected,
        Registration(dz_mm, found.speed_mps, int(good.sum()), float(10 * np.log10(np.median(residual)))),
    )


def _likeness(found: Sounding, predicted: Spectra, turns: NDArray[np.complex64]) -> NDArray[np.float64]:
    """Normalised real correlation of each ping with its prediction under each turn, shape (pings, turns)."""
    spectrum = found.gate.spectrum(found.measured)
    cross = (spectrum * predicted.conj()).sum(axis=1)  # (pings, bins): summed over the receivers
    power = (np.abs(spectrum) ** 2).sum(axis=(1, 2)) * (np.abs(predicted) ** 2).sum(axis=(1, 2))
    return (cross @ turns.conj().T).real / np.sqrt(power)[:, None]


def _gain(found: Sounding, predicted: Spectra, measured: Waveforms) -> NDArray[np.complex128]:
    """Complex gain of each channel, a polynomial over the band, shape (receivers, bins)."""
    seen = found.gate.spectrum(measured)
    thought = found.gate.spectrum(found.gate.waveform(predicted))
    at = np.linspace(-1, 1, found.band.bins.size)
    terms = np.polynomial.chebyshev.chebvander(at, GAIN_TERMS - 1)  # (bins, terms)
    cross = (seen * thought.conj()).sum(axis=0, dtype=np.complex128)  # (receivers, bins)
    power = (np.abs(thought).astype(np.float64) ** 2).sum(axis=0)
    out = np.empty(cross.shape, dtype=np.complex128)
    for channel in range(cross.shape[0]):
        normal = terms.T @ (power[channel, :, None] * terms)
        out[channel] = terms @ np.linalg.solve(normal, terms.T @ cross[channel])
    return out
