"""The rules under a calibration that is not the array's: beam, speed of sound, frequency; and with more noise.

Recorded echoes stay as they are, only the calibration is altered; of the last row the noise is, and nothing else.
"""

from __future__ import annotations

from collections.abc import Generator, Mapping, Sequence
from dataclasses import replace

import msgspec
import numpy as np

from comparison.hybrid_asked import DISTURBED
from comparison.hybrid_scans import Recorded
from comparison.hybrid_scores import Row, fused, mean_of, row
from echolume_messages.calibration import ArrayCalibration, Calibration
from echolume_messages.geometry import rotation_from_vector, transform
from echolume_processing.hybrid.rules.band import footprint_mm
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline

QUIET_SHARE = 0.1
"""The last part of a record, where no echo comes any more."""
SIX_DB = 2.0
OFF_MM = np.array([-0.5, -0.5, 0.5])
OFF_DEG = np.array([-0.2, 0.2, -0.2])
OFF_K = 3.0


def _beam(array: ArrayCalibration, scale: float) -> ArrayCalibration:
    """A beam is as wide as its aperture is small: `radius_mm` is the piston's, from which echoes are predicted."""
    footprint = footprint_mm(array)[0] * scale
    return msgspec.structs.replace(array, radius_mm=array.radius_mm / scale, footprint_mm=footprint)


def _speed(array: ArrayCalibration, scale: float) -> ArrayCalibration:
    return msgspec.structs.replace(array, speed_of_sound_mps=array.speed_of_sound_mps * scale)


def _frequency(array: ArrayCalibration, scale: float) -> ArrayCalibration:
    """Templates of transducers that are tuned otherwise: the same pulse, faster."""
    at = np.arange(len(array.templates[0]), dtype=np.float64)
    wanted = array.template_origin + (at - array.template_origin) * scale
    templates = [np.interp(wanted, at, channel).tolist() for channel in array.templates]
    return msgspec.structs.replace(
        array, templates=templates, low_hz=array.low_hz * scale, high_hz=array.high_hz * scale
    )


def _set_up(array: ArrayCalibration, scale: float) -> ArrayCalibration:
    """A robot whose frame is off by `OFF_MM` and `OFF_DEG`, in air that is `OFF_K` warmer or colder than thought."""
    off = transform(rotation_from_vector(np.radians(OFF_DEG) * scale), OFF_MM * scale)
    return msgspec.structs.replace(
        array, rig_from_robot=(off @ array.robot_pose).tolist(), temperature_c=array.temperature_c + OFF_K * scale
    )


ARRAYS: Mapping[str, tuple[str, float]] = {
    "as calibrated": ("beam", 1.0),
    "beam 30 % wider": ("beam", 1.3),
    "beam 30 % narrower": ("beam", 0.7),
    "speed of sound + 0.5 %": ("speed", 1.005),
    "speed of sound - 0.5 %": ("speed", 0.995),
    "frequency + 2 %": ("frequency", 1.02),
    "noise + 6 dB": ("noise", SIX_DB),
    DISTURBED: ("set-up", 1.0),
    f"{DISTURBED}, the other way": ("set-up", -1.0),
}
"""What is altered, and by which factor; the first is altered in nothing."""
ALTER = {"beam": _beam, "speed": _speed, "frequency": _frequency, "set-up": _set_up}


def altered(calibration: Calibration, kind: str, scale: float) -> Calibration:
    """The calibration of an array that is not the one that was scanned with."""
    if kind not in ALTER:
        return calibration
    return msgspec.structs.replace(calibration, array=ALTER[kind](calibration.array, scale))


def noisier(ping: Ping, times: float) -> Ping:
    """A ping whose noise is so many times what its quiet end shows."""
    quiet = ping.echoes[:, -max(8, int(QUIET_SHARE * ping.echoes.shape[1])) :].astype(np.float64)
    sigma = 1.4826 * np.median(np.abs(quiet - np.median(quiet, axis=1, keepdims=True)), axis=1, keepdims=True)
    added = np.random.default_rng(ping.trigger).normal(size=ping.echoes.shape) * sigma * np.sqrt(times**2 - 1)
    limits = np.iinfo(np.int16)
    return replace(ping, echoes=np.clip(np.rint(ping.echoes + added), limits.min, limits.max).astype(np.int16))


def mismatch_rows(scans: Sequence[Recorded], rules: Sequence[str]) -> Generator[tuple[str, dict[str, Row]]]:
    """What was altered, and the figures by rule, mean over the scans."""
    for name, (kind, scale) in ARRAYS.items():
        rows: dict[str, list[Row]] = {rule: [] for rule in rules}
        for recorded in scans:
            calibration = altered(recorded.evidence.calibration, kind, scale)
            pings = recorded.evidence.all_pings()
            if kind == "noise":
                pings = [noisier(p, scale) for p in pings]
            pipeline = UltrasonicPipeline(calibration)
            points = np.concatenate([pipeline.process(p) for p in pings])
            for rule in rules:
                rows[rule].append(row(fused(rule, recorded, calibration, pings, points)[0], recorded))
        yield name, {rule: mean_of(each) for rule, each in rows.items()}
