"""Whole waves of a narrow band: what the leading edges of neighbouring echoes say of each contact point's height."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration
from echolume_messages.types import ULTRASONIC_POINT, Structured
from echolume_processing.hybrid.rules.band import wavelength_mm
from echolume_processing.hybrid.scipy_typed import NearestPoints
from echolume_processing.hybrid.witnesses import Triggers
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline, speed_of_sound_mps, waveforms_from_counts

AROUND_MM = 12.0
"""Contact points within this radius are heard together: a few dozen, over less than a footprint."""


def by_onset(pings: Sequence[Ping], calibration: Calibration) -> tuple[Structured, Triggers]:
    """Contact points of pings, moved by whole half wavelengths to where the echoes around them begin.

    Parameters
    ----------
    pings
        In any order.
    calibration
        What they were made with.

    Returns
    -------
    points, triggers
        ``ULTRASONIC_POINT`` (n,), and the trigger of the ping of each. Heights that do not move keep their bits.

    Notes
    -----
    A long pulse of what lies below runs into the peak of an echo, but not into its beginning. One leading edge is good
    to 1.5 mm, the median of those around a point to less than a quarter of a wave. Where nothing is in front - over a
    wide bench beside higher things - the beginning is another surface's, and the choice is worse than the peak's: so
    gates take heights from here, and ask the peaks where there is a plate.
    """
    pipeline = UltrasonicPipeline(calibration)
    found = [(pipeline.process(ping), ping) for ping in pings]
    points = np.concatenate([part for part, _ in found]) if found else np.zeros(0, dtype=ULTRASONIC_POINT)
    triggers = np.repeat(np.array([ping.trigger for _, ping in found], dtype=np.uint32), [p.size for p, _ in found])
    if not points.size:
        return points, triggers
    begun_mm = np.concatenate([_begun_mm(pipeline, part, ping) for part, ping in found])
    place = np.column_stack((points["x_mm"], points["y_mm"])).astype(np.float64)
    known = np.isfinite(place).all(axis=1) & np.isfinite(begun_mm)
    if not known.any():
        return points, triggers
    tree, begun_mm = NearestPoints(place[known]), begun_mm[known]
    half_mm = 0.5 * wavelength_mm(calibration.array)
    for k in np.flatnonzero(known):
        around_mm = float(np.median(begun_mm[tree.around(place[k], AROUND_MM)]))
        points["z_mm"][k] += np.float32(half_mm * np.round((around_mm - float(points["z_mm"][k])) / half_mm))
    return points, triggers


def _begun_mm(pipeline: UltrasonicPipeline, points: Structured, ping: Ping) -> NDArray[np.float64]:
    """Height that the leading edge of each contact point's channel tells (n,); nan where it tells none."""
    array = pipeline.calibration
    found, _ = pipeline.arrivals(
        waveforms_from_counts(ping.echoes), ping.sample_rate_hz, ping.start_s, ping.air_temperature_c
    )
    speed_mm = 1e3 * speed_of_sound_mps(array, ping.air_temperature_c)
    begun_mm = (found.onset_s + ping.start_s - np.array(array.delays_s)) * speed_mm
    return points["z_mm"] + 0.5 * (points["path_mm"] - begun_mm[points["receiver"]])
