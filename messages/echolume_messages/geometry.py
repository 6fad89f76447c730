"""Rigid transforms as 4x4 float64 matrices, named ``target_from_source``; millimetres and radians."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Matrix: TypeAlias = NDArray[np.float64]
Points3: TypeAlias = NDArray[np.float64]


def require_shape(name: str, array: NDArray[np.generic], shape: tuple[int | None, ...]) -> None:
    """Raise ``ValueError`` unless `array` has `shape` (None stands for any length)."""
    if array.ndim != len(shape) or any(
        want is not None and got != want for got, want in zip(array.shape, shape, strict=True)
    ):
        expected = tuple("n" if s is None else s for s in shape)
        raise ValueError(f"{name}: expected shape {expected}, got {array.shape}")


def rotation_from_euler(rx_rad: float, ry_rad: float, rz_rad: float) -> Matrix:
    """Rotation matrix Rz @ Ry @ Rx of the robot's three wrist angles, shape (3, 3)."""
    cx, sx = np.cos(rx_rad), np.sin(rx_rad)
    cy, sy = np.cos(ry_rad), np.sin(ry_rad)
    cz, sz = np.cos(rz_rad), np.sin(rz_rad)
    rx = np.array([[1, 0, 0], [0, cx, -sx], [0, sx, cx]], dtype=np.float64)
    ry = np.array([[cy, 0, sy], [0, 1, 0], [-sy, 0, cy]], dtype=np.float64)
    rz = np.array([[cz, -sz, 0], [sz, cz, 0], [0, 0, 1]], dtype=np.float64)
    return rz @ ry @ rx


def rotation_from_vector(vector_rad: NDArray[np.float64]) -> Matrix:
    """Rodrigues' formula: rotation matrix of a rotation vector (3,), shape (3, 3)."""
    require_shape("vector_rad", vector_rad, (3,))
    angle_rad = float(np.linalg.norm(vector_rad))
    x, y, z = vector_rad
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]], dtype=np.float64)
    if angle_rad < 1e-8:
        return np.eye(3) + skew + 0.5 * skew @ skew
    return np.eye(3) + np.sin(angle_rad) / angle_rad * skew + (1 - np.cos(angle_rad)) / angle_rad**2 * skew @ skew


def transform(rotation: Matrix, translation_mm: NDArray[np.float64]) -> Matrix:
    """4x4 ``target_from_source`` of a rotation (3, 3) and a translation (3,)."""
    require_shape("rotation", rotation, (3, 3))
    require_shape("translation_mm", translation_mm, (3,))
    out = np.eye(4)
    out[:3, :3] = rotation
    out[:3, 3] = translation_mm
    return out


def robot_from_flange(pose: NDArray[np.float64]) -> Matrix:
    """4x4 transform of the six axes (x, y, z in mm; rx, ry, rz in rad) of the gantry robot."""
    require_shape("pose", pose, (6,))
    return transform(rotation_from_euler(*(float(a) for a in pose[3:])), pose[:3])


def invert(target_from_source: Matrix) -> Matrix:
    """``source_from_target`` of a rigid 4x4 transform."""
    require_shape("target_from_source", target_from_source, (4, 4))
    rotation = target_from_source[:3, :3].T
    return transform(rotation, -rotation @ target_from_source[:3, 3])


def apply(target_from_source: Matrix, points: Points3) -> Points3:
    """Move points (n, 3) from the source to the target frame."""
    require_shape("target_from_source", target_from_source, (4, 4))
    require_shape("points", points, (None, 3))
    return points @ target_from_source[:3, :3].T + target_from_source[:3, 3]


def rotation_angle_rad(rotation: Matrix) -> float:
    """Angle of a rotation matrix (3, 3), exact near zero too."""
    require_shape("rotation", rotation, (3, 3))
    sine = 0.5 * np.linalg.norm(
        [rotation[2, 1] - rotation[1, 2], rotation[0, 2] - rotation[2, 0], rotation[1, 0] - rotation[0, 1]]
    )
    return float(np.arctan2(sine, 0.5 * (np.trace(rotation) - 1)))
