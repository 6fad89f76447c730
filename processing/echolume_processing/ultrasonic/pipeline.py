"""One ping in, contact points in the rig frame out; the same for measured and for predicted echoes."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration, Calibration
from echolume_messages.geometry import apply, require_shape, robot_from_flange
from echolume_messages.types import ULTRASONIC_POINT, EchoBlock, Structured
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.air import carried_mps
from echolume_processing.ultrasonic.baseband import Baseband, baseband
from echolume_processing.ultrasonic.contact import contact
from echolume_processing.ultrasonic.cycles import settled
from echolume_processing.ultrasonic.envelope import Waveforms, energy, paper_envelope
from echolume_processing.ultrasonic.flight import MAX_PHASE_RAD, Arrivals, first_arrivals
from echolume_processing.ultrasonic.matched_filter import (
    PLAIN,
    ComplexEnvelope,
    MatchedFilter,
    matched_filter,
    padded_length,
)
from echolume_processing.ultrasonic.onset import leading_edge, onsets
from echolume_processing.ultrasonic.record_kernels import without_offset
from echolume_processing.ultrasonic.several import Echoes, several_echoes

MIN_PATH_MM = 110.0
"""Shorter paths drown in the cross-talk and its ringing."""
MAX_PATH_MM = 900.0
SURFACE = 0.45
"""Share of a wide plate's amplitude at the same distance that makes an echo a surface's: half at a straight edge, a
little less to keep bars narrower than the Fresnel zone."""
PATH_FLOOR_MM = 0.05
"""What the model leaves unexplained of a path on a clean plane."""
COMMON_PATH_MM = 0.05
"""What all paths of a ping share: the robot's repeatability and the air."""
COVARIANCE = {
    "xx_mm2": (0, 0), "xy_mm2": (0, 1), "xz_mm2": (0, 2), "yy_mm2": (1, 1), "yz_mm2": (1, 2), "zz_mm2": (2, 2),
}  # fmt: skip
UPSAMPLING = 4


def speed_of_sound_mps(calibration: ArrayCalibration, air_temperature_c: float) -> float:
    """Calibrated speed of sound, carried to another air temperature (ideal gas)."""
    return carried_mps(calibration.speed_of_sound_mps, calibration.temperature_c, air_temperature_c)


def waveforms_from_counts(echoes: EchoBlock) -> Waveforms:
    """Digitiser counts (receivers, samples) to float32 without each channel's mean."""
    require_shape("echoes", echoes, (None, None))
    out = np.empty(echoes.shape, dtype=np.float32)
    without_offset(echoes, out)
    return out


class UltrasonicPipeline:
    """The echo chain of one calibrated array.

    Parameters
    ----------
    calibration : Calibration or ArrayCalibration
    surface : float
        Share of the reference plate's amplitude that counts as the first echo of a surface.
    gate_mm : (shortest, longest)
        Paths that may be a surface's.
    """

    def __init__(
        self,
        calibration: Calibration | ArrayCalibration,
        surface: float = SURFACE,
        gate_mm: tuple[float, float] = (MIN_PATH_MM, MAX_PATH_MM),
    ) -> None:
        self.calibration = calibration.array if isinstance(calibration, Calibration) else calibration
        found = self.calibration
        self._templates = np.array(found.templates, dtype=np.float32)
        self._delays_s = np.array(found.delays_s, dtype=np.float64)
        self._emitter_mm = np.array(found.emitter_mm, dtype=np.float64)
        self._receivers_mm = np.array(found.receivers_mm, dtype=np.float64) - self._emitter_mm
        self._robot_pose, self._array_pose = found.robot_pose, found.array_pose
        self._surface = surface
        self._gate_mm = gate_mm
        self._banks: dict[tuple[int, float | None], MatchedFilter] = {}
        whole = energy(paper_envelope(self._templates, found.sample_rate_hz), found.sample_rate_hz)
        self._template_energy = np.maximum(whole, np.finfo(np.float64).tiny)
        centre_hz = self._bank(self._templates.shape[1], found.sample_rate_hz).centre_hz
        self._edge = leading_edge(self._templates, found.template_origin, found.sample_rate_hz, centre_hz)

    def process(self, ping: Ping) -> Structured:
        """Contact points of one measured ping, ULTRASONIC_POINT (n <= receivers,), rig frame."""
        return self.process_echoes(
            waveforms_from_counts(ping.echoes),
            ping.robot_pose,
            ping.sample_rate_hz,
            ping.start_s,
            ping.air_temperature_c,
        )

    def rig_from_array(self, robot_pose: NDArray[np.float64]) -> NDArray[np.float64]:
        """4x4 pose of the array at a robot pose (x, y, z in mm; rx, ry, rz in rad)."""
        return self._robot_pose @ robot_from_flange(robot_pose) @ self._array_pose

    def compress(self, waveforms: Waveforms, sample_rate_hz: float) -> ComplexEnvelope:
        """Matched-filter output (receivers, UPSAMPLING * samples), 1 at an echo like the reference plate's."""
        return self._bank(waveforms.shape[1], sample_rate_hz).compress(waveforms)

    def arrivals(
        self,
        waveforms: Waveforms,
        sample_rate_hz: float,
        start_s: float,
        air_temperature_c: float,
        *,
        strongest: bool = False,
        gate_mm: tuple[float, float] | None = None,
    ) -> tuple[Arrivals, NDArray[np.float64]]:
        """Echo of each channel and its path length in mm (receivers,); not a number where there is none."""
        gate = self._gate_mm if gate_mm is None else gate_mm
        speed = 1e3 * speed_of_sound_mps(self.calibration, air_temperature_c)  # mm/s
        echoes, cut_s = self._baseband(waveforms, sample_rate_hz, start_s, speed, gate)
        return self._arrivals(waveforms, echoes, cut_s, start_s, speed, gate, strongest)

    def several_echoes(
        self,
        waveforms: Waveforms,
        sample_rate_hz: float,
        start_s: float,
        air_temperature_c: float,
        *,
        gate_mm: tuple[float, float] | None = None,
        most: int = 4,
    ) -> list[tuple[Echoes, NDArray[np.float64]]]:
        """Echoes of each channel, overlapping ones too, and their path lengths in mm (echoes,).

        Runs the plain matched filter; see `several.several_echoes`.
        """
        gate = self._gate_mm if gate_mm is None else gate_mm
        speed = 1e3 * speed_of_sound_mps(self.calibration, air_temperature_c)
        echoes, cut_s = self._baseband(waveforms, sample_rate_hz, start_s, speed, gate, whitening=PLAIN)
        offset_s = cut_s + start_s - float(self._delays_s.mean())
        gate_s = gate[0] / speed - offset_s, gate[1] / speed - offset_s
        level = np.ones(echoes.magnitude.shape[1], dtype=np.float32)
        noise = first_arrivals(echoes, gate_s, level, floor=0.0, strongest=True).noise
        out: list[tuple[Echoes, NDArray[np.float64]]] = []
        for found, delay_s in zip(several_echoes(echoes, gate_s, noise, most=most), self._delays_s, strict=True):
            time_s = found.time_s + cut_s
            out.append((replace(found, time_s=time_s), (time_s + start_s - delay_s) * speed))
        return out

    def strongest(self, ping: Ping, gate_mm: tuple[float, float]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Arrival after the emission (delay included) and amplitude of the strongest echo in a gate, (receivers,).

        The arrival is not a number where envelope and phase contradict each other.
        """
        waveforms = waveforms_from_counts(ping.echoes)
        found, _ = self.arrivals(
            waveforms, ping.sample_rate_hz, ping.start_s, ping.air_temperature_c, strongest=True, gate_mm=gate_mm
        )
        sure = np.abs(found.phase_rad) <= MAX_PHASE_RAD
        return np.where(sure, found.time_s + ping.start_s, np.nan), found.amplitude

    def band_weights(self, samples: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Frequencies (n,) in Hz and how much of the compressed pulse lies at each (n,), their sum 1."""
        bank = self._bank(samples, self.calibration.sample_rate_hz)
        return bank.frequency_hz, bank.response

    def process_echoes(
        self,
        waveforms: Waveforms,
        robot_pose: NDArray[np.float64],
        sample_rate_hz: float,
        start_s: float,
        air_temperature_c: float,
    ) -> Structured:
        """Contact points of echoes as float32 counts (receivers, samples): measured, or predicted from a surface.

        Returns
        -------
        ULTRASONIC_POINT (n,)
            In the rig frame, one per receiver that the ping's model rests on; `energy` is that below the paper's
            envelope relative to the reference plate, `lobes` counts the matched filter's echoes.
        """
        require_shape("waveforms", waveforms, (len(self._receivers_mm), None))
        speed = 1e3 * speed_of_sound_mps(self.calibration, air_temperature_c)
        echoes, cut_s = self._baseband(waveforms, sample_rate_hz, start_s, speed, self._gate_mm)
        found, paths_mm = self._arrivals(waveforms, echoes, cut_s, start_s, speed, self._gate_mm, strongest=False)
        if found.doubtful.any():
            period_s = 1 / echoes.bank.centre_hz
            found, paths_mm = settled(found, paths_mm, self._receivers_mm, period_s, speed, PATH_FLOOR_MM)
        sigma_mm = np.hypot(PATH_FLOOR_MM, np.where(found.found, found.sigma_s * speed, 0.0))
        result = contact(self._receivers_mm, paths_mm, sigma_mm, common_sigma_mm=COMMON_PATH_MM)
        pose = self.rig_from_array(robot_pose)
        used = np.flatnonzero(result.used)
        points = apply(pose, result.points_mm[used] + self._emitter_mm)
        normals = result.normals[used] @ pose[:3, :3].T
        out: Structured = np.zeros(len(used), dtype=ULTRASONIC_POINT)
        for name, values in zip(("x_mm", "y_mm", "z_mm"), points.T, strict=True):
            out[name] = values
        for name, values in zip(("nx", "ny", "nz"), normals.T, strict=True):
            out[name] = values
        turned = pose[:3, :3] @ result.point_covariances[used] @ pose[:3, :3].T
        for name, (i, j) in COVARIANCE.items():
            out[name] = turned[:, i, j]
        out["sigma_mm"] = 0.5 * sigma_mm[used]
        out["path_mm"] = paths_mm[used]
        first_s, last_s = (length / speed - start_s - cut_s for length in self._gate_mm)
        last_s += self._templates.shape[1] / sample_rate_hz
        out["energy"] = (echoes.energy(first_s, last_s) / self._template_energy)[used]
        out["lobes"] = found.lobes[used]
        out["receiver"] = used
        out["kind"] = result.kind
        return out

    def _baseband(
        self,
        waveforms: Waveforms,
        sample_rate_hz: float,
        start_s: float,
        speed: float,
        gate_mm: tuple[float, float],
        whitening: float | None = None,
    ) -> tuple[Baseband, float]:
        """The part of the record that the gate needs after the matched filter, and when it begins in the record."""
        margin = self._templates.shape[1]
        edges_s = gate_mm[0] / speed - start_s, gate_mm[1] / speed + float(self._delays_s.max()) - start_s
        first = min(max(0, int(edges_s[0] * sample_rate_hz) - margin), waveforms.shape[1])
        last = max(first, min(waveforms.shape[1], int(edges_s[1] * sample_rate_hz) + 2 * margin))
        bank = self._bank(last - first, sample_rate_hz, whitening)
        return baseband(bank, waveforms[:, first:last]), first / sample_rate_hz

    def _arrivals(
        self,
        waveforms: Waveforms,
        echoes: Baseband,
        cut_s: float,
        start_s: float,
        speed: float,
        gate_mm: tuple[float, float],
        strongest: bool,
    ) -> tuple[Arrivals, NDArray[np.float64]]:
        offset_s = cut_s + start_s - float(self._delays_s.mean())
        path_mm = np.maximum((echoes.times_s + offset_s) * speed, 1.0)
        threshold = (self._surface * 2 * self.calibration.reference_mm / path_mm).astype(np.float32)
        gate_s = gate_mm[0] / speed - offset_s, gate_mm[1] / speed - offset_s
        found = first_arrivals(echoes, gate_s, threshold, strongest=strongest)
        time_s = found.time_s + cut_s
        onset_s, onset_sigma_s = onsets(waveforms, self._edge, time_s, found.white_noise)
        moved = replace(
            found,
            time_s=time_s,
            envelope_s=found.envelope_s + cut_s,
            onset_s=onset_s,
            onset_sigma_s=onset_sigma_s,
        )
        return moved, (time_s + start_s - self._delays_s) * speed

    def _bank(self, samples: int, sample_rate_hz: float, whitening: float | None = None) -> MatchedFilter:
        found = self.calibration
        if abs(sample_rate_hz - found.sample_rate_hz) > 1e-6 * found.sample_rate_hz:
            raise ValueError(
                f"the array was calibrated at {found.sample_rate_hz} Hz, these echoes have {sample_rate_hz}"
            )
        key = padded_length(samples, self._templates.shape[1]), whitening
        if key not in self._banks:
            self._banks[key] = matched_filter(
                self._templates,
                found.template_origin,
                sample_rate_hz,
                (found.low_hz, found.high_hz),
                samples,
                upsampling=UPSAMPLING,
                whitening=whitening,
            )
        return self._banks[key]
