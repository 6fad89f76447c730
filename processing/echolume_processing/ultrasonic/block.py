"""x, y and yaw of the robot on the rig, from a block that light and sound both see."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, Points3, require_shape, rotation_from_vector, transform
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import (
    UPSAMPLING,
    UltrasonicPipeline,
    speed_of_sound_mps,
    waveforms_from_counts,
)
from echolume_processing.ultrasonic.predictor import BlockPredictor

FACET_MM = 2.0
RAISED_MM = 3.0
"""Optical points lower than this are the plate."""
PRIOR_MM = 3.0
PRIOR_RAD = float(np.radians(3.0))
STEP = 0.03
"""Of the prior sigma, for differences."""
CLOSE = 2e-3
MAX_ITERATIONS = 8
LIMIT_MM = 0.5
LIMIT_RAD = float(np.radians(0.5))
NAMES = ("rig_from_robot x", "rig_from_robot y", "rig_from_robot yaw")


@dataclass(frozen=True)
class BlockFit:
    """Where the robot stands in the plane of the bench."""

    rig_from_robot: Matrix
    sigmas: dict[str, float]
    explained: float
    """Share of the block's echo energy that the fitted block explains."""


def raised_facets(points_mm: Points3, facet_mm: float = FACET_MM) -> tuple[Points3, NDArray[np.float64]]:
    """Horizontal facets wherever the nearest optical points are raised above the plate.

    Parameters
    ----------
    points_mm : (n, 3) float64
        Optical points of the block and some plate around it, rig frame.

    Returns
    -------
    centres_mm : (facets, 3) float64
    area_mm2 : (facets,) float64
        Facets at the block's edges are smaller than those inside.
    """
    require_shape("points_mm", points_mm, (None, 3))
    raised = points_mm[points_mm[:, 2] > RAISED_MM]
    if len(raised) < 50:
        raise CalibrationRejectedError(
            f"array calibration: light sees no block on the plate ({len(raised)} points above {RAISED_MM} mm); put the "
            "block on the bench for the passes 'block-light' and 'block-sound'"
        )
    fine_mm = facet_mm / 8
    low, high = raised[:, :2].min(axis=0) - 2 * facet_mm, raised[:, :2].max(axis=0) + 2 * facet_mm
    x, y = (np.arange(low[k] + 0.5 * fine_mm, high[k], fine_mm) for k in (0, 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = np.all((points_mm[:, :2] > low - 2) & (points_mm[:, :2] < high + 2), axis=1)
    near = points_mm[inside]
    query = KDTree(near[:, :2]).query(grid)
    apart, nearest = np.asarray(query[0], dtype=np.float64), np.asarray(query[1], dtype=np.int64)
    # Light leaves holes at the foot of a wall only: what lies further from a point than is usual on the block itself
    # (half the pitch of the stripes) belongs to the plate.
    inner = np.all((grid > low + 4 * facet_mm) & (grid < high - 4 * facet_mm), axis=1)
    reach_mm = 1.2 * float(np.percentile(apart[inner], 99)) if inner.any() else facet_mm
    on_top = (near[nearest, 2] > RAISED_MM) & (apart <= reach_mm)
    cell = np.floor((grid[on_top] - low) / facet_mm).astype(np.int64)
    _, group, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()
    columns = [grid[on_top, 0], grid[on_top, 1], near[nearest[on_top], 2]]
    centres = np.column_stack([np.bincount(group, c) / count for c in columns])
    return centres, (count * fine_mm**2).astype(np.float64)


def _moved(rig_from_robot: Matrix, offsets: NDArray[np.float64]) -> Matrix:
    shift = transform(rotation_from_vector(np.array([0.0, 0.0, float(offsets[2])])), np.array([*offsets[:2], 0.0]))
    return shift @ rig_from_robot


def fit_block(
    pings: Sequence[Ping], optical_points_mm: Points3, calibration: ArrayCalibration, *, gate_mm: float = 40.0
) -> BlockFit:
    """Shift and turn the robot on the bench until the echoes predicted from the optical block match the measured ones.

    Parameters
    ----------
    pings : raster over the block
    optical_points_mm : (n, 3) float64
        Points of the block and the plate around it, rig frame.
    calibration : ArrayCalibration
        With everything that the plate told; x, y and yaw of ``rig_from_robot`` still nominal.
    gate_mm : float
        Path compared before the highest top's echo and after the plate's.

    Raises
    ------
    CalibrationRejectedError
        If no ping sees the block, or the raster leaves x, y or yaw undetermined; the message names it.
    """
    if not pings:
        raise CalibrationRejectedError(f"array calibration: no pings over a block: undetermined: {', '.join(NAMES)}")
    facets, areas = raised_facets(optical_points_mm)
    pipeline = UltrasonicPipeline(calibration)
    samples = pings[0].echoes.shape[1]
    predictor = BlockPredictor(calibration, facets, areas, samples)
    bare = BlockPredictor(calibration, facets[:0], areas[:0], samples)
    base = calibration.robot_pose
    speeds = [speed_of_sound_mps(calibration, p.air_temperature_c) for p in pings]
    top_mm = float(facets[:, 2].max())

    def echoes(model: BlockPredictor, k: int, offsets: NDArray[np.float64]) -> NDArray[np.complex64]:
        pose = _moved(base, offsets) @ np.linalg.inv(base) @ pipeline.rig_from_array(pings[k].robot_pose)
        return pipeline.compress(model.predict(pose, pings[k].start_s, speeds[k]), pings[k].sample_rate_hz)

    zero = np.zeros(3)
    windows: list[slice] = []
    measured: list[NDArray[np.complex64]] = []
    for k, ping in enumerate(pings):
        height = float(pipeline.rig_from_array(ping.robot_pose)[2, 3])
        rate = ping.sample_rate_hz * UPSAMPLING / (1e3 * speeds[k])
        late = float(np.mean(calibration.delays_s)) * 1e3 * speeds[k]
        first = int(max(0.0, (2 * (height - top_mm) - gate_mm + late) * rate))
        windows.append(slice(first, int((2 * height + gate_mm + late) * rate), UPSAMPLING))
        whole = pipeline.compress(waveforms_from_counts(ping.echoes), ping.sample_rate_hz)
        measured.append(whole[:, windows[k]] * np.float32(height / calibration.reference_mm))
    power = float(
        sum(
            np.sum(np.abs(m - _scaled(echoes(bare, k, zero), windows[k], pings[k], pipeline)) ** 2)
            for k, m in enumerate(measured)
        )
    )
    size = sum(m.size for m in measured)
    noise = np.sqrt(0.05 * power / size) + 1e-6
    scales = np.array([PRIOR_MM, PRIOR_MM, PRIOR_RAD])

    def residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        rows: list[NDArray[np.float32]] = []
        for k, m in enumerate(measured):
            difference = (m - _scaled(echoes(predictor, k, p), windows[k], pings[k], pipeline)).ravel()
            rows.append(difference.view(np.float32))
        return np.concatenate(rows).astype(np.float64) / noise

    at, left, jacobian = _gauss_newton(residuals, scales)
    explained = 1.0 - float(np.sum(left**2)) * noise**2 / max(power, 1e-12)
    # Neighbouring samples share their errors: count one independent value per compressed pulse of about 8 samples.
    information = jacobian.T @ jacobian / (8 * max(1.0, float(np.mean(left**2)))) + np.diag(scales**-2)
    sigmas = np.sqrt(np.diag(np.linalg.inv(information)))
    limits = (LIMIT_MM, LIMIT_MM, LIMIT_RAD)
    loose = [n for n, s, limit in zip(NAMES, sigmas, limits, strict=True) if s > limit]
    if loose or explained < 0.3:
        reason = (
            f"leave undetermined: {', '.join(loose)}" if loose else f"explain {explained:.0%} of the block's echoes"
        )
        raise CalibrationRejectedError(
            f"array calibration: {len(pings)} pings over the block {reason}; raster across all four edges of the block "
            "that the pass 'block-light' saw, at 10 mm pitch"
        )
    found = _moved(base, at)
    return BlockFit(found, dict(zip(NAMES, sigmas.tolist(), strict=True)), explained)


def _gauss_newton(
    residuals: Callable[[NDArray[np.float64]], NDArray[np.float64]], scales: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Least squares from zero with steps fit for single-precision waveforms: solution, residuals, Jacobian."""
    at = np.zeros(len(scales))
    now = residuals(at)
    jacobian = np.zeros((len(now), len(scales)))
    for _ in range(MAX_ITERATIONS):
        for k, scale in enumerate(scales):
            ahead = at.copy()
            ahead[k] += STEP * scale
            jacobian[:, k] = (residuals(ahead) - now) / (STEP * scale)
        normal = jacobian.T @ jacobian + np.diag(scales**-2)
        change = np.linalg.solve(normal, -(jacobian.T @ now) - at / scales**2)
        at = at + np.clip(change, -scales, scales)
        now = residuals(at)
        if np.all(np.abs(change) < CLOSE * scales):
            break
    return at, now, jacobian


def _scaled(
    compressed: NDArray[np.complex64], window: slice, ping: Ping, pipeline: UltrasonicPipeline
) -> NDArray[np.complex64]:
    height = float(pipeline.rig_from_array(ping.robot_pose)[2, 3])
    return compressed[:, window] * np.float32(height / pipeline.calibration.reference_mm)
