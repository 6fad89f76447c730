"""How wide the array sees: the footprint from the echo's fall over the block's edges, beside what physics expects.

Over a flat target the echo comes from the first Fresnel zone, whose radius is sqrt(wavelength height / 2). Where part
of the target is missing, the zones that are left add up to the Fresnel integral over them; its scale is fitted.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Points3, apply, require_shape
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.block_facets import raised_facets
from echolume_processing.ultrasonic.pipeline import (
    UPSAMPLING,
    UltrasonicPipeline,
    speed_of_sound_mps,
    waveforms_from_counts,
)

FACET_MM = 1.0
SAME_TOP_MM = 1.0
"""Facets this much lower than the highest are no part of the top."""
NEAR_MM = 6.0
"""Path around the top's in which its echo is the strongest."""
MAX_TILT = float(np.cos(np.radians(3.0)))
MIN_SAMPLES = 24
MIN_CONTRAST = 0.2
"""Largest less smallest amplitude: fewer say nothing of an edge."""
DISAGREES = 0.3


@dataclass(frozen=True)
class Footprint:
    """Radius of the first Fresnel zone, measured and expected."""

    radius_mm: float
    sigma_mm: float
    height_mm: float
    """Distance from the array to the surface at which it holds; it goes with the root of the distance."""
    frequency_hz: float
    expected_mm: float
    """sqrt(wavelength height / 2)."""
    scatter: float
    """Root mean square of the amplitudes that the edge response leaves over; a plate's echo is 1."""
    samples: int

    @property
    def agrees(self) -> bool:
        """Measured and expected radius differ by less than `DISAGREES`."""
        return abs(self.radius_mm / self.expected_mm - 1) < DISAGREES

    def at(self, height_mm: float) -> tuple[float, float]:
        """Radius and sigma at another height."""
        scale = float(np.sqrt(height_mm / self.height_mm))
        return self.radius_mm * scale, self.sigma_mm * scale


@dataclass(frozen=True)
class EdgeSamples:
    """How loud the top's echo is where."""

    middles_mm: NDArray[np.float64]  # (n, 2), halfway between emitter and receiver, rig frame
    amplitudes: NDArray[np.float64]  # (n,), 1 over a wide plate at the same distance
    height_mm: float


def edge_samples(pings: Sequence[Ping], top_mm: float, calibration: ArrayCalibration) -> EdgeSamples:
    """Amplitude of the echo of a top at height `top_mm`, of every channel and upright ping."""
    pipeline = UltrasonicPipeline(calibration)
    emitter, receivers = np.array([calibration.emitter_mm]), np.array(calibration.receivers_mm)
    middles: list[NDArray[np.float64]] = []
    amplitudes: list[NDArray[np.float64]] = []
    heights: list[float] = []
    for ping in pings:
        pose = pipeline.rig_from_array(ping.robot_pose)
        if pose[2, 2] > -MAX_TILT:
            continue
        start, ends = apply(pose, emitter), apply(pose, receivers)
        speed = 1e3 * speed_of_sound_mps(calibration, ping.air_temperature_c)
        height = float(start[0, 2]) - top_mm
        paths = np.linalg.norm(ends - start * [1, 1, -1] - [0, 0, 2 * top_mm], axis=1)
        compressed = np.abs(pipeline.compress(waveforms_from_counts(ping.echoes), ping.sample_rate_hz))
        rate = ping.sample_rate_hz * UPSAMPLING
        at = (paths / speed + np.array(calibration.delays_s) - ping.start_s) * rate
        reach = int(NEAR_MM / speed * rate)
        around = np.rint(at).astype(np.intp)[:, None] + np.arange(-reach, reach + 1)
        loudest = np.take_along_axis(compressed, np.clip(around, 0, compressed.shape[1] - 1), axis=1).max(axis=1)
        middles.append(0.5 * (start + ends)[:, :2])
        amplitudes.append(loudest.astype(np.float64) * paths / (2 * calibration.reference_mm))
        heights.append(height)
    if not heights:
        raise CalibrationRejectedError("array calibration: no upright ping over the block: no footprint")
    return EdgeSamples(np.concatenate(middles), np.concatenate(amplitudes), float(np.mean(heights)))


@dataclass(frozen=True)
class Top:
    """A flat top on a grid."""

    x_mm: NDArray[np.float64]  # (columns,)
    y_mm: NDArray[np.float64]  # (rows,)
    areas_mm2: NDArray[np.float64]  # (rows, columns)


def top_of(centres_mm: NDArray[np.float64], areas_mm2: NDArray[np.float64]) -> Top:
    """Facets (m, 2) shared among the four nodes around each of a grid of `FACET_MM`: area and centre stay."""
    low = np.floor(centres_mm.min(axis=0) / FACET_MM)
    at = centres_mm / FACET_MM - low
    whole = at.astype(np.intp)
    part = at - whole
    columns, rows = (whole.max(axis=0) + 2).tolist()
    areas = np.zeros(rows * columns)
    for dx in (0, 1):
        for dy in (0, 1):
            share = np.abs(1 - dx - part[:, 0]) * np.abs(1 - dy - part[:, 1])
            node = (whole[:, 1] + dy) * columns + whole[:, 0] + dx
            areas += np.bincount(node, share * areas_mm2, rows * columns)
    x, y = ((low[k] + np.arange(n)) * FACET_MM for k, n in ((0, columns), (1, rows)))
    return Top(x, y, areas.reshape(rows, columns))


def edge_response(
    middles_mm: NDArray[np.float64],
    top: Top,
    radius_mm: float,
    shares: NDArray[np.float64],
    weights: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Amplitude of the echo of a flat top in units of an endless one's, (n,).

    Parameters
    ----------
    middles_mm : (n, 2) float64
        Halfway between emitter and receiver, over the top's plane.
    top : Top
        On a grid much finer than the radius.
    radius_mm : float
        Of the first Fresnel zone at the centre frequency.
    shares, weights : (k,) float64
        Frequencies over the centre one, and how much of the pulse lies at each; the weights' sum is 1.

    References
    ----------
    J. W. Goodman, Introduction to Fourier Optics, section 4.2 (Fresnel approximation).
    """
    require_shape("middles_mm", middles_mm, (None, 2))
    across, along = ((middles_mm[:, k, None] - at) ** 2 for k, at in ((0, top.x_mm), (1, top.y_mm)))
    out = np.zeros(len(middles_mm), dtype=np.complex128)
    for share, weight in zip(shares.tolist(), weights.tolist(), strict=True):
        inverse = share / radius_mm**2
        zones = np.exp(-1j * np.pi * inverse * along) @ top.areas_mm2
        out += weight * 1j * inverse * np.sum(zones * np.exp(-1j * np.pi * inverse * across), axis=1)
    return np.abs(out)


def fit_footprint(pings: Sequence[Ping], optical_points_mm: Points3, calibration: ArrayCalibration) -> Footprint:
    """Footprint from a raster over the block's edges.

    Parameters
    ----------
    pings : raster over the block
    optical_points_mm : (n, 3) float64
        What light sees of the block, rig frame.
    calibration : ArrayCalibration
        Complete.

    Raises
    ------
    CalibrationRejectedError
        If the raster crosses no edge.

    Notes
    -----
    Radius and overall level are fitted. The sigma comes from the scatter around the response, with the eight channels
    of a ping counted as two: their middles lie closer than the footprint is wide.
    """
    centres, areas = raised_facets(optical_points_mm, FACET_MM)
    top_mm = float(np.median(centres[centres[:, 2] > centres[:, 2].max() - SAME_TOP_MM, 2]))
    on_top = np.abs(centres[:, 2] - top_mm) < SAME_TOP_MM
    top = top_of(centres[on_top, :2], areas[on_top])
    seen = edge_samples(pings, top_mm, calibration)
    if len(seen.amplitudes) < MIN_SAMPLES or np.ptp(seen.amplitudes) < MIN_CONTRAST:
        raise CalibrationRejectedError(
            f"array calibration: {len(seen.amplitudes)} echoes of the block's top do not cross an edge: no footprint; "
            "raster beyond the block"
        )
    frequency_hz, weights = UltrasonicPipeline(calibration).band_weights(pings[0].echoes.shape[1])
    centre_hz = float(frequency_hz @ weights)
    speed = 1e3 * calibration.speed_of_sound_mps
    expected = float(np.sqrt(0.5 * speed / centre_hz * seen.height_mm))

    def left(at: NDArray[np.float64]) -> NDArray[np.float64]:
        made = edge_response(seen.middles_mm, top, float(at[0]) * expected, frequency_hz / centre_hz, weights)
        return seen.amplitudes - float(at[1]) * made

    solved = least_squares(left, np.array([1.0, 1.0]), bounds=([0.3, 0.3], [3.0, 3.0]), loss="soft_l1", f_scale=0.1)
    slopes, over = np.asarray(solved.jac, dtype=np.float64), left(np.asarray(solved.x, dtype=np.float64))
    scatter = float(np.sqrt(np.mean(over**2)))
    together = len(calibration.receivers_mm) / 2
    sigma = scatter * float(np.sqrt(together * np.linalg.inv(slopes.T @ slopes)[0, 0]))
    radius = float(solved.x[0]) * expected
    return Footprint(radius, sigma * expected, seen.height_mm, centre_hz, expected, scatter, len(over))
