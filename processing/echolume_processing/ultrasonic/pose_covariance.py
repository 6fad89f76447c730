"""How well the array's pose is known: one covariance of both mountings, and what it means at a pose of the robot.

The twelve errors are e_A = (x, y, z, rx, ry, yaw) of ``flange_from_array`` in the array frame and e_R, the same of
``rig_from_robot`` in the rig frame, in mm and rad: true rig_from_array = T(e_R) rig_from_robot robot flange T(e_A).
"""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.geometry import apply, require_shape, robot_from_flange, rotation_from_vector, transform

POSE_NAMES = tuple(
    f"{mounting} {axis}"
    for mounting in ("flange_from_array", "rig_from_robot")
    for axis in ("x", "y", "z", "rx", "ry", "yaw")
)
PLATE = [POSE_NAMES.index(f"flange_from_array {a}") for a in ("x", "y", "z", "rx", "ry", "yaw")] + [8, 9, 10]
"""Places of what the plate tells, in the order of `plate_problem.NAMES`."""
BLOCK = [6, 7, 11]
"""Places of what the block tells: the robot's x, y and yaw."""
STEP = 1e-4


def joint_covariance(
    calibration: ArrayCalibration,
    plate: NDArray[np.float64],
    block: NDArray[np.float64],
    robot_poses: NDArray[np.float64],
) -> NDArray[np.float64]:
    """Covariance (12, 12) of both mountings, from what plate and block each tell.

    Parameters
    ----------
    calibration : ArrayCalibration
        Complete.
    plate : (9, 9) float64
        Of `plate_problem.NAMES`, less the speed of sound.
    block : (3, 3) float64
        Of the robot's x, y and yaw, were the plate's results right.
    robot_poses : (pings, 6) float64
        Of the raster over the block.

    Notes
    -----
    The block tells where the middles between emitter and receivers are in the plane of the bench, whatever the plate
    said. An error of the plate's results that moves them there is made good by x, y and yaw: so these errors go along.
    """
    require_shape("plate", plate, (9, 9))
    require_shape("block", block, (3, 3))
    at = np.zeros(12)
    columns: list[NDArray[np.float64]] = []
    for k in range(12):
        at[k] = STEP
        ahead = _middles(calibration, robot_poses, at)
        at[k] = -STEP
        columns.append((ahead - _middles(calibration, robot_poses, at)).ravel() / (2 * STEP))
        at[k] = 0.0
    slopes = np.column_stack(columns)
    follow = -np.linalg.pinv(slopes[:, BLOCK]) @ slopes[:, PLATE]
    carry = np.zeros((12, 9))
    carry[PLATE] = np.eye(9)
    carry[BLOCK] = follow
    out = carry @ plate @ carry.T
    out[np.ix_(BLOCK, BLOCK)] += block
    return out


def array_pose_covariance(calibration: ArrayCalibration, robot_pose: NDArray[np.float64]) -> NDArray[np.float64] | None:
    """Covariance (6, 6) of the array's place and attitude in the rig frame at a robot pose; None where it is not known.

    Parameters
    ----------
    calibration : ArrayCalibration
    robot_pose : (6,) float64
        mm and rad.

    Returns
    -------
    (6, 6) float64
        x, y, z of the array frame's origin in mm, and the rotation vector in rad, all along the rig's axes.
    """
    if isinstance(calibration.pose_covariance, msgspec.UnsetType):
        return None
    pose = calibration.robot_pose @ robot_from_flange(robot_pose) @ calibration.array_pose
    rotation, (x, y, z) = pose[:3, :3], pose[:3, 3].tolist()
    slopes = np.zeros((6, 12))
    slopes[:3, :3] = slopes[3:, 3:6] = rotation
    slopes[:3, 6:9] = slopes[3:, 9:] = np.eye(3)
    slopes[:3, 9:] = [[0.0, z, -y], [-z, 0.0, x], [y, -x, 0.0]]
    return slopes @ np.array(calibration.pose_covariance, dtype=np.float64) @ slopes.T


def _middles(
    calibration: ArrayCalibration, robot_poses: NDArray[np.float64], errors: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Halfway between emitter and each receiver, in the plane of the bench."""
    first = transform(rotation_from_vector(errors[9:]), errors[6:9]) @ calibration.robot_pose
    last = calibration.array_pose @ transform(rotation_from_vector(errors[3:6]), errors[:3])
    points = 0.5 * (np.array(calibration.receivers_mm) + np.array(calibration.emitter_mm))
    return np.concatenate([apply(first @ robot_from_flange(p) @ last, points)[:, :2] for p in robot_poses])
