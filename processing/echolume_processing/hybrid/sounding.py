"""All pings of a scan beside what a surface would have returned: the forward-model comparison."""

from __future__ import annotations

import os
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_processing.hybrid.alignment import at_assumed_speed
from echolume_processing.hybrid.channel import Channels, Gate, gate, speed_of_sound
from echolume_processing.hybrid.listening import Listening, kind_of
from echolume_processing.hybrid.predict import Aperture, Band, Predictor, aperture
from echolume_processing.hybrid.setup_error import prior_sigma
from echolume_processing.hybrid.surface import Surface
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pose_covariance import array_pose_covariance

CEILING_MM = 70.0
"""No scene is higher than this above the bench."""
FLOOR_MM = -20.0
PULSE_ENERGY = 0.98
LEAST_FOR_A_LINE = 10
"""Fewer pings than this say nothing about a drift of the air."""

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
    """At which the predictions are made, and to which the measured echoes are brought."""
    air_mps: float
    """In the middle of the scan, by the thermometer."""
    triggers: tuple[int, ...]
    """Of each ping, sorted."""
    apertures: tuple[Aperture, ...]
    measured: Waveforms
    """Gated waveforms of every ping, per receiver, the channels' delays removed."""
    energy: NDArray[np.float64]
    """(pings,)"""
    order: NDArray[np.float64]
    """Place of each ping in the scan, by its trigger: -1 for the first, 1 for the last."""
    prior: NDArray[np.float64]
    """One sigma of how far the set-up may be off, in the order of `setup_error.NAMES`."""

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


def sounding(
    pings: Sequence[Ping],
    calibration: ArrayCalibration,
    listening: Listening | None = None,
    spectra: Sequence[NDArray[np.complex64]] | None = None,
) -> Sounding:
    """Bring pings of one digitiser setting, sorted by trigger, into comparable form.

    Parameters
    ----------
    pings
        All of a scan.
    calibration
        What they were made with.
    listening, spectra
        What `listening_to` returns for them, and its `measured` of each ping, where that is known already.

    Raises
    ------
    ValueError
        If there is no ping, or the pings differ in length or sample rate.
    """
    ears = listening or listening_to(pings, calibration)
    if spectra is None:
        spectra = [ears.measured(p) for p in pings]
    order = _order(pings)
    air_mps, faster = _speeds(pings, order, calibration, ears.speed_mps)
    apertures = tuple(aperture(calibration, p.robot_pose) for p in pings)
    z_mm = np.array([a.elements_mm[:, 2] for a in apertures])
    window = gate(
        ears.band,
        2 * max(float(z_mm.min()) - CEILING_MM, 0.3 * float(z_mm.min())) / (ears.speed_mps * 1e3),
        2 * (float(z_mm.max()) - FLOOR_MM) / (ears.speed_mps * 1e3) + _pulse_s(calibration),
    )
    measured = np.stack([window.waveform(spectrum) for spectrum in spectra])
    measured = at_assumed_speed(window, ears.channels.response * ears.channels.filter, measured, faster)
    energy = (np.abs(measured).astype(np.float64) ** 2).sum(axis=(1, 2))
    middle = np.mean([p.robot_pose for p in pings], axis=0)
    drift_mps = 0.5 * float(np.ptp(faster)) * ears.speed_mps
    prior = prior_sigma(array_pose_covariance(calibration, middle), drift_mps, ears.speed_mps)
    return Sounding(
        ears.band, ears.predictor, ears.channels, window, ears.speed_mps, air_mps, tuple(p.trigger for p in pings),
        apertures, measured, energy, order, prior,
    )  # fmt: skip


def listening_to(pings: Sequence[Ping], calibration: ArrayCalibration) -> Listening:
    """What some pings are compared with: their setting, and air of the median of what they read, whole degrees.

    Raises
    ------
    ValueError
        If there is no ping, or the pings differ in length or sample rate.
    """
    kinds = {kind_of(p) for p in pings}
    if len(kinds) != 1:
        raise ValueError(f"pings: expected one length and sample rate, got {sorted(kinds)}")
    return Listening.to(pings[0], calibration, float(np.median([p.air_temperature_c for p in pings])))


def _order(pings: Sequence[Ping]) -> NDArray[np.float64]:
    """Triggers, laid from -1 to 1."""
    trigger = np.array([p.trigger for p in pings], dtype=np.float64)
    half = 0.5 * float(trigger[-1] - trigger[0])
    return (trigger - trigger[0]) / half - 1 if half > 0 else np.zeros(trigger.size)


def _speeds(
    pings: Sequence[Ping], order: NDArray[np.float64], calibration: ArrayCalibration, assumed_mps: float
) -> tuple[float, NDArray[np.float64]]:
    """Speed of sound in the middle of the scan (m/s), and by what share it was faster than assumed in each ping.

    A line through the thermometer's readings: one of them is no better than some hundredths of a kelvin.
    """
    read_c = np.array([p.air_temperature_c for p in pings])
    slope_c = 0.0
    if len(pings) >= LEAST_FOR_A_LINE and (order**2).sum() > 0:
        slope_c = float(((read_c - read_c.mean()) * order).sum() / ((order - order.mean()) ** 2).sum())
    middle_c = float(np.median(read_c - slope_c * order))
    each_mps = np.array([speed_of_sound(calibration, middle_c + slope_c * float(o)) for o in order])
    return speed_of_sound(calibration, middle_c), each_mps / assumed_mps - 1


def _pulse_s(calibration: ArrayCalibration) -> float:
    """How long the echo of a plate lasts after its arrival."""
    power = (np.array(calibration.templates, dtype=np.float64) ** 2).sum(axis=0)
    after = np.cumsum(power) / power.sum()
    last = int(np.searchsorted(after, PULSE_ENERGY))
    return max(0.0, (last - calibration.template_origin) / calibration.sample_rate_hz)
