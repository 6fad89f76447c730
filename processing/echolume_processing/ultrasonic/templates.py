"""Templates: what each channel hears of a perpendicular plate."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.signal.windows import tukey

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import robot_from_flange
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.envelope import Waveforms, band_pass
from echolume_processing.ultrasonic.pipeline import waveforms_from_counts

SAME_POSE_MM = 0.2
FADED = 0.02
"""A template ends where its envelope has fallen to this share of its peak."""


@dataclass(frozen=True)
class Templates:
    """Templates of all channels, cut at common samples of the reference pings."""

    waveforms: Waveforms
    first_sample: int
    """Sample of the ping at which the templates start."""
    peaks: NDArray[np.float64]
    """Height of each channel's envelope in counts, (receivers,)."""
    pings: list[int]
    """Which of the pings they were averaged from."""


def reference_pings(pings: Sequence[Ping], nominal_up: NDArray[np.float64], height_mm: float) -> list[int]:
    """Pings that stand perpendicular to the bench at the pose nearest to `height_mm` over the middle.

    Raises
    ------
    CalibrationRejectedError
        If no ping stands within 0.6 degrees of perpendicular (`nominal_up`: the array's axis on the flange).
    """
    axes = np.array([robot_from_flange(p.robot_pose)[:3, :3] @ nominal_up for p in pings]).reshape(-1, 3)
    straight = np.flatnonzero(-axes[:, 2] > np.cos(np.radians(0.6)))
    if not straight.size:
        raise CalibrationRejectedError(
            "array calibration: no ping of the pass 'plate' stands perpendicular to the plate; the templates need one"
        )
    poses = np.array([p.robot_pose for p in pings])
    cost = np.abs(poses[straight, 2] - height_mm) + 0.01 * np.hypot(poses[straight, 0], poses[straight, 1])
    best = poses[straight[np.argmin(cost)], :3]
    near = np.linalg.norm(poses[straight, :3] - best, axis=1) < SAME_POSE_MM
    return [int(k) for k in straight[near]]


def cut_templates(
    pings: Sequence[Ping], chosen: list[int], band_hz: tuple[float, float], after_s: float, before_s: float
) -> Templates:
    """Average the chosen pings and cut out the plate's echo, between two times after the emission.

    Parameters
    ----------
    band_hz : (low, high)
    after_s, before_s : float
        Gate in which the echo's peak must lie.
    """
    first = pings[chosen[0]]
    rate_hz = first.sample_rate_hz
    mean = np.mean([waveforms_from_counts(pings[k].echoes) for k in chosen], axis=0, dtype=np.float32)
    passed = band_pass(np.asarray(mean, dtype=np.float32), rate_hz, *band_hz)
    envelope = np.abs(np.asarray(signal.hilbert(passed, axis=1)))
    low = max(0, int((after_s - first.start_s) * rate_hz))
    high = min(passed.shape[1], int((before_s - first.start_s) * rate_hz))
    if high - low < 16:
        raise CalibrationRejectedError(
            f"array calibration: the echo of the plate lies outside the record ({after_s} s)"
        )
    peak_at = low + np.argmax(envelope[:, low:high], axis=1)
    peaks = envelope[np.arange(len(passed)), peak_at]
    noise = np.median(envelope[:, -max(16, passed.shape[1] // 8) :], axis=1)
    weak = np.flatnonzero(peaks < 10 * noise)
    if weak.size:
        raise CalibrationRejectedError(
            f"array calibration: receivers {weak.tolist()} hear the plate less than 20 dB above their noise; check "
            "their wires"
        )
    relative = (envelope / peaks[:, None]).max(axis=0)
    before, after = int(peak_at.min()), int(peak_at.max())
    quiet_before = np.flatnonzero(relative[low:before] < FADED)
    quiet_after = np.flatnonzero(relative[after:] < FADED)
    margin = round(30e-6 * rate_hz)
    start = max(0, (low + int(quiet_before[-1]) if quiet_before.size else low) - margin)
    stop = min(passed.shape[1], (after + int(quiet_after[0]) if quiet_after.size else passed.shape[1]) + margin)
    cut = passed[:, start:stop] * tukey(stop - start, 2 * margin / (stop - start))
    return Templates(np.asarray(cut, dtype=np.float32), start, peaks.astype(np.float64), chosen)
