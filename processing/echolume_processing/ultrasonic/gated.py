"""Gated complex baseband: what delay-and-sum needs of the echoes, on one axis of path lengths for all pings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, apply, require_shape
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.envelope import band_weights
from echolume_processing.ultrasonic.matched_filter import ComplexEnvelope
from echolume_processing.ultrasonic.pipeline import (
    UPSAMPLING,
    UltrasonicPipeline,
    speed_of_sound_mps,
    waveforms_from_counts,
)

OVERSAMPLING = 4.0
"""Samples per reciprocal bandwidth, so that interpolation between two of them will do."""
FADE = 3
"""Samples over which both ends of the gate fade: nothing may stop at once."""
SILENT = 2
"""Samples of silence at either end; paths outside the gate read them."""


@dataclass(frozen=True)
class GatedEchoes:
    """Echoes of a whole scan over the path emitter -> surface -> receiver.

    Sample n of every row belongs to the path `first_mm` + n `step_mm`; the analytic signal there is
    iq[n] exp(j `wavenumber` path). An echo's phase is 0 at its path.
    """

    iq: NDArray[np.complex64]
    """(poses, receivers, samples)."""
    first_mm: float
    step_mm: float
    wavenumber: float
    """Of the carrier, rad/mm."""
    bandwidth: float
    """Full width of the baseband, waves per mm of path; the echoes hold nothing outside half of it to either side."""
    emitters_mm: Points3
    """Emitter of each pose, rig frame, (poses, 3)."""
    receivers_mm: NDArray[np.float64]
    """Receivers of each pose, rig frame, (poses, receivers, 3)."""
    axes: Points3
    """Unit vectors along which the array looks, (poses, 3)."""

    def __post_init__(self) -> None:
        require_shape("iq", self.iq, (None, None, None))
        poses, receivers, _ = self.iq.shape
        require_shape("emitters_mm", self.emitters_mm, (poses, 3))
        require_shape("receivers_mm", self.receivers_mm, (poses, receivers, 3))
        require_shape("axes", self.axes, (poses, 3))
        if not poses or not receivers:
            raise ValueError("delay-and-sum: there are no echoes; it needs at least one ping and one receiver")

    @property
    def wavelength_mm(self) -> float:
        """Of the carrier."""
        return 2 * np.pi / self.wavenumber


@dataclass(frozen=True)
class Band:
    """The band that is kept, with flanks, and the speed of sound that ties its carrier to a wavenumber."""

    low_hz: float
    high_hz: float
    speed_mps: float

    @property
    def centre_hz(self) -> float:
        """The carrier."""
        return 0.5 * (self.low_hz + self.high_hz)

    @property
    def wavenumber(self) -> float:
        """Of the carrier, rad/mm."""
        return 2 * np.pi * self.centre_hz / (1e3 * self.speed_mps)

    @property
    def width(self) -> float:
        """Full width, flanks included, waves per mm."""
        flank_hz = max(0.2 * (self.high_hz - self.low_hz), 2000.0)
        return (self.high_hz - self.low_hz + 2 * flank_hz) / (1e3 * self.speed_mps)

    @property
    def step_mm(self) -> float:
        """Path from sample to sample: four per reciprocal bandwidth, and at most one wave of the carrier."""
        return min(1 / (OVERSAMPLING * self.width), 2 * np.pi / self.wavenumber)


class PathGate:
    """Turns analytic signals over time into baseband over path lengths.

    Parameters
    ----------
    band : Band
    paths_mm : (shortest, longest)
    delays_s : (receivers,)
        Added by each channel to the acoustic time of flight; taken out.
    """

    def __init__(self, band: Band, paths_mm: tuple[float, float], delays_s: NDArray[np.float64]) -> None:
        if not 0 <= paths_mm[0] < paths_mm[1]:
            raise ValueError(f"gate: expected paths in mm, the shorter first, got {paths_mm}")
        self.band = band
        self.step_mm = band.step_mm
        self.first_mm = paths_mm[0] - SILENT * self.step_mm
        self.samples = int(np.ceil((paths_mm[1] - paths_mm[0]) / self.step_mm)) + 1 + 2 * SILENT
        self._delays_s = delays_s
        path_mm = self.first_mm + self.step_mm * np.arange(self.samples)
        ends = np.minimum(np.arange(self.samples), np.arange(self.samples)[::-1]) - SILENT + 1
        self._window = np.sin(0.5 * np.pi * np.clip(ends / FADE, 0, 1)) ** 2
        self._carrier = np.exp(-1j * band.wavenumber * path_mm)
        self._path_mm = path_mm
        self._waves = lru_cache(maxsize=4)(self._compute_waves)

    def baseband(
        self, analytic: ComplexEnvelope, rate_hz: float, start_s: float, speed_mps: float
    ) -> NDArray[np.complex64]:
        """Baseband (receivers, samples) of one ping.

        Parameters
        ----------
        analytic : (receivers, n) complex64
            One-sided signals, the first sample `start_s` after the emission; echoes have phase 0 at their arrival.
        rate_hz, start_s : float
        speed_mps : float
            Speed of sound during this ping.

        Notes
        -----
        Exact for the kept band: the spectrum is evaluated at each path's own time, whatever the ping's speed of sound.
        Paths beyond the record are silent.
        """
        require_shape("analytic", analytic, (len(self._delays_s), None))
        count = analytic.shape[1]
        inside, waves = self._waves(count, rate_hz, start_s, speed_mps)
        frequency_hz = inside * (rate_hz / count)
        spectrum = np.fft.fft(analytic, axis=1)[:, inside] / count
        spectrum = spectrum * np.exp(2j * np.pi * frequency_hz * self._delays_s[:, None])
        out = np.asarray(spectrum @ waves, dtype=np.complex64)
        time_s = self._path_mm / (1e3 * speed_mps) + self._delays_s[:, None] - start_s
        out[(time_s < 0) | (time_s > (count - 1) / rate_hz)] = 0
        return out

    def _compute_waves(
        self, count: int, rate_hz: float, start_s: float, speed_mps: float
    ) -> tuple[NDArray[np.int64], NDArray[np.complex128]]:
        """Bins in the band, and the wave of each at the gate's paths without the carrier, (bins, samples)."""
        frequency_hz = np.arange(count // 2) * (rate_hz / count)
        inside = np.flatnonzero(band_weights(frequency_hz, self.band.low_hz, self.band.high_hz) > 0)
        time_s = self._path_mm / (1e3 * speed_mps) - start_s
        waves = np.exp(2j * np.pi * frequency_hz[inside, None] * time_s) * (self._carrier * self._window)
        return inside, waves


def gate_pings(pings: Sequence[Ping], pipeline: UltrasonicPipeline, paths_mm: tuple[float, float]) -> GatedEchoes:
    """Compressed, gated baseband of a scan; 1 is the echo of a perpendicular plate at any distance.

    Parameters
    ----------
    pings : n pings
    pipeline : UltrasonicPipeline
        Of the array's calibration.
    paths_mm : (shortest, longest)
        Paths to keep.

    Raises
    ------
    ValueError
        If there are no pings, or the paths are none.
    """
    found = pipeline.calibration
    if not pings:
        raise ValueError("delay-and-sum: there are no pings; scan with a pass of kind 'ultrasonic' first")
    speeds_mps = [speed_of_sound_mps(found, ping.air_temperature_c) for ping in pings]
    gate = PathGate(Band(found.low_hz, found.high_hz, float(np.mean(speeds_mps))), paths_mm, np.array(found.delays_s))
    iq = np.empty((len(pings), len(found.receivers_mm), gate.samples), dtype=np.complex64)
    for row, ping, speed_mps in zip(iq, pings, speeds_mps, strict=True):
        analytic = pipeline.compress(waveforms_from_counts(ping.echoes), ping.sample_rate_hz)
        row[:] = gate.baseband(analytic, ping.sample_rate_hz * UPSAMPLING, ping.start_s, speed_mps)
    path_mm = gate.first_mm + gate.step_mm * np.arange(gate.samples)
    iq *= (np.maximum(path_mm, 0) / (2 * found.reference_mm)).astype(np.float32)
    poses = [pipeline.rig_from_array(ping.robot_pose) for ping in pings]
    elements = np.array([found.emitter_mm, *found.receivers_mm], dtype=np.float64)
    places = np.array([apply(pose, elements) for pose in poses])
    return GatedEchoes(
        iq, gate.first_mm, gate.step_mm, gate.band.wavenumber, gate.band.width, places[:, 0], places[:, 1:],
        np.array([pose[:3, 2] for pose in poses]),
    )  # fmt: skip
