"""A small echo predictor for the calibration block: the plate's mirror image, less the floor under the block, plus
its top as Kirchhoff facets. No shadow, no double bounce."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy import fft

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.geometry import Points3
from echolume_processing.ultrasonic.acoustics import directivity
from echolume_processing.ultrasonic.envelope import Waveforms

OVERSAMPLING = 8


class BlockPredictor:
    """Predicts the echoes of a plate at z = 0 with raised facets on it.

    Parameters
    ----------
    calibration : ArrayCalibration
    centres_mm : (facets, 3) float64
        Centres of the raised, horizontal facets, rig frame.
    area_mm2 : (facets,) float64
    """

    def __init__(
        self, calibration: ArrayCalibration, centres_mm: Points3, area_mm2: NDArray[np.float64], samples: int
    ) -> None:
        found = self._calibration = calibration
        floor = centres_mm * np.array([1.0, 1.0, 0.0])
        self._centres_mm = np.concatenate([centres_mm, floor])
        self._area_mm2 = np.concatenate([area_mm2, -area_mm2])
        self._samples = samples
        self._rate_hz = found.sample_rate_hz
        self._length = int(fft.next_fast_len(samples + len(found.templates[0]), real=True) or 0)
        self._frequency_hz = np.fft.rfftfreq(self._length, 1 / self._rate_hz)
        spectrum = np.asarray(fft.rfft(np.array(found.templates), self._length, axis=1))
        origin_s = found.template_origin / self._rate_hz
        phase = np.exp(2j * np.pi * self._frequency_hz * (origin_s + np.array(found.delays_s)[:, None] * -1))
        self._source = spectrum * phase * 2 * found.reference_mm
        self._emitter_mm = np.array(found.emitter_mm)
        self._receivers_mm = np.array(found.receivers_mm)
        self._late_mm2 = 0.5 * found.radius_mm**2
        """Lateness of the echo between two disks, times its path; at the reference it belongs to the delays."""
        self._reference_late_mm = self._late_mm2 / (2 * found.reference_mm)

    def predict(self, rig_from_array: NDArray[np.float64], start_s: float, speed_mps: float) -> Waveforms:
        """Echoes at one array pose (4, 4), float32 counts (receivers, samples)."""
        speed = 1e3 * speed_mps
        centre_hz = 0.5 * (self._calibration.low_hz + self._calibration.high_hz)
        ka = 2 * np.pi * centre_hz / speed * self._calibration.radius_mm
        rotation, place = rig_from_array[:3, :3], rig_from_array[:3, 3]
        emitter = rotation @ self._emitter_mm + place
        receivers = self._receivers_mm @ rotation.T + place
        axis = rotation[:, 2]
        response = self._image(emitter, receivers, axis, ka, speed, start_s)
        if len(self._centres_mm):
            response = response + self._facets(emitter, receivers, axis, ka, speed, start_s)
        out: Waveforms = np.asarray(fft.irfft(self._source * response, self._length, axis=1), dtype=np.float32)
        return out[:, : self._samples]

    def _image(
        self,
        emitter: NDArray[np.float64],
        receivers: Points3,
        axis: NDArray[np.float64],
        ka: float,
        speed: float,
        start_s: float,
    ) -> NDArray[np.complex128]:
        image = emitter * np.array([1.0, 1.0, -1.0])
        way = receivers - image
        path = np.linalg.norm(way, axis=1)
        sine_in = np.sqrt(np.maximum(1 - (way @ axis / path) ** 2, 0.0))
        out_way = way * np.array([1.0, 1.0, -1.0])
        sine_out = np.sqrt(np.maximum(1 - (out_way @ axis / path) ** 2, 0.0))
        level = directivity(ka * sine_in) * directivity(ka * sine_out) / path
        late = path + self._late_mm2 / path - self._reference_late_mm
        return level[:, None] * np.exp(-2j * np.pi * self._frequency_hz * (late / speed - start_s)[:, None])

    def _facets(
        self,
        emitter: NDArray[np.float64],
        receivers: Points3,
        axis: NDArray[np.float64],
        ka: float,
        speed: float,
        start_s: float,
    ) -> NDArray[np.complex128]:
        centres = self._centres_mm
        down = centres - emitter
        there = np.linalg.norm(down, axis=1)
        level_out = directivity(ka * np.sqrt(np.maximum(1 - (down @ axis / there) ** 2, 0.0))) / there
        bins = self._length * OVERSAMPLING
        rate = self._rate_hz * OVERSAMPLING
        rows: list[NDArray[np.float64]] = []
        for receiver in receivers:
            up = receiver - centres
            back = np.linalg.norm(up, axis=1)
            level_in = directivity(ka * np.sqrt(np.maximum(1 - (up @ axis / back) ** 2, 0.0))) / back
            obliquity = 0.5 * (np.abs(down[:, 2]) / there + np.abs(up[:, 2]) / back)
            weight = level_out * level_in * obliquity * (self._area_mm2 / (2 * np.pi * speed))
            # A disk is late by R^2 / (4 r) at each point; summed over a plate, far-field beams take half of it away.
            late = there + back + 0.5 * self._late_mm2 * (1 / there + 1 / back) - self._reference_late_mm
            at = (late / speed - start_s) * rate
            whole = at.astype(np.int64)
            part = at - whole
            row = np.asarray(np.bincount(whole, weight * (1 - part), bins), dtype=np.float64)[:bins]
            rows.append(row + np.bincount(whole + 1, weight * part, bins)[:bins])
        spectrum = np.asarray(fft.rfft(np.array(rows), axis=1))[:, : len(self._frequency_hz)]
        return np.asarray(spectrum * (2j * np.pi * self._frequency_hz), dtype=np.complex128)
