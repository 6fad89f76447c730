"""x, y and yaw of the robot on the rig, from a block that light and sound both see."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from echolume_messages.calibration import ArrayCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, Points3, require_shape, rotation_from_vector, transform
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.spatial import cKDTree

from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import (
    UPSAMPLING,
    UltrasonicPipeline,
    speed_of_sound_mps,
    waveforms_from_counts,
)
from echolume_processing.ultrasonic.predictor import BlockPredictor

FACET_MM = 1.0
RAISED_MM = 3.0
"""Optical points lower than this are the plate."""
PRIOR_MM = 3.0
PRIOR_RAD = float(np.radians(3.0))
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


def raised_facets(points_mm: Points3, facet_mm: float = FACET_MM) -> Points3:
    """Centres of horizontal facets wherever the nearest optical point is raised above the plate, (facets, 3).

    Parameters
    ----------
    points_mm : (n, 3) float64
        Optical points of the block and some plate around it, rig frame.
    """
    require_shape("points_mm", points_mm, (None, 3))
    raised = points_mm[points_mm[:, 2] > RAISED_MM]
    if len(raised) < 50:
        raise CalibrationRejectedError(
            f"array calibration: light sees no block on the plate ({len(raised)} points above {RAISED_MM} mm); put the "
            "block on the bench for the passes 'block-light' and 'block-sound'"
        )
    low, high = raised[:, :2].min(axis=0) - 3 * facet_mm, raised[:, :2].max(axis=0) + 3 * facet_mm
    x = np.arange(low[0], high[0], facet_mm)
    y = np.arange(low[1], high[1], facet_mm)
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    around, near = cKDTree(points_mm[:, :2]).query(grid, k=5)
    heights = points_mm[near, 2]
    middle = np.median(heights, axis=1)
    # Light leaves holes at the foot of a wall only: a cell far from any point belongs to the plate.
    on_top = (middle > RAISED_MM) & (around[:, 0] < 2 * facet_mm)
    return np.column_stack([grid[on_top], middle[on_top]])


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
    facets = raised_facets(optical_points_mm)
    pipeline = UltrasonicPipeline(calibration)
    samples = pings[0].echoes.shape[1]
    predictor = BlockPredictor(calibration, facets, FACET_MM**2, samples)
    bare = BlockPredictor(calibration, facets[:0], FACET_MM**2, samples)
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

    def cost(p: NDArray[np.float64]) -> NDArray[np.float64]:
        rows: list[NDArray[np.float32]] = []
        for k, m in enumerate(measured):
            difference = (m - _scaled(echoes(predictor, k, p * scales), windows[k], pings[k], pipeline)).ravel()
            rows.append(difference.view(np.float32))
        return np.concatenate([np.concatenate(rows).astype(np.float64) / noise, p])

    solved = least_squares(cost, zero, diff_step=0.02, x_scale=1.0, max_nfev=12, xtol=1e-4, ftol=1e-5)
    left = np.asarray(solved.fun)[:-3]
    explained = 1.0 - float(np.sum(left**2)) * noise**2 / max(power, 1e-12)
    jacobian = np.asarray(solved.jac)[:-3]
    # Neighbouring samples share their errors: count one independent value per compressed pulse of about 8 samples.
    information = jacobian.T @ jacobian / (8 * max(1.0, float(np.mean(left**2)))) + np.eye(3)
    sigmas = np.sqrt(np.diag(np.linalg.inv(information))) * scales
    limits = (LIMIT_MM, LIMIT_MM, LIMIT_RAD)
    loose = [n for n, s, limit in zip(NAMES, sigmas, limits, strict=True) if s > limit]
    if loose or explained < 0.3:
        reason = f"leave undetermined: {', '.join(loose)}" if loose else f"explain {explained:.0%} of the block's echoes"
        raise CalibrationRejectedError(
            f"array calibration: {len(pings)} pings over the block {reason}; raster across all four edges of the block "
            "that the pass 'block-light' saw, at 10 mm pitch"
        )
    found = _moved(base, np.asarray(solved.x) * scales)
    return BlockFit(found, dict(zip(NAMES, sigmas.tolist(), strict=True)), explained)


def _scaled(
    compressed: NDArray[np.complex64], window: slice, ping: Ping, pipeline: UltrasonicPipeline
) -> NDArray[np.complex64]:
    height = float(pipeline.rig_from_array(ping.robot_pose)[2, 3])
    return compressed[:, window] * np.float32(height / pipeline.calibration.reference_mm)
