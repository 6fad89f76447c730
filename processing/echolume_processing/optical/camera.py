"""The camera model: distortion of points, projection matrices M = K [R | t], rays."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages import geometry
from echolume_messages.calibration import CameraCalibration
from echolume_messages.geometry import Matrix, Points3, require_shape
from echolume_processing.optical import lens

Points2 = NDArray[np.float64]


@dataclass(frozen=True)
class Camera:
    """A calibrated camera: intrinsic matrix (3, 3), distortion (k1, k2, p1, p2, k3), ``camera_from_rig`` (4, 4)."""

    matrix: Matrix
    distortion: NDArray[np.float64]
    camera_from_rig: Matrix

    def __post_init__(self) -> None:
        require_shape("matrix", self.matrix, (3, 3))
        require_shape("distortion", self.distortion, (5,))
        require_shape("camera_from_rig", self.camera_from_rig, (4, 4))

    @classmethod
    def of(cls, calibration: CameraCalibration) -> Camera:
        """The camera that a calibration file describes."""
        return cls(calibration.matrix, np.asarray(calibration.distortion, dtype=np.float64), calibration.pose)

    @property
    def projection(self) -> Matrix:
        """M = K [R | t], shape (3, 4), from rig coordinates in mm to undistorted pixels (paper eq. 1)."""
        return self.matrix @ self.camera_from_rig[:3]

    @property
    def centre_mm(self) -> NDArray[np.float64]:
        """Optical centre in the rig frame, (3,)."""
        return geometry.invert(self.camera_from_rig)[:3, 3]

    @property
    def lens(self) -> NDArray[np.float64]:
        """What the kernels need of the lens, (10,): fx, skew, cx, fy, cy, then k1, k2, p1, p2, k3."""
        m = self.matrix
        return np.array([m[0, 0], m[0, 1], m[0, 2], m[1, 1], m[1, 2], *self.distortion], dtype=np.float64)

    @property
    def ray_matrix(self) -> Matrix:
        """Ray direction in the rig frame, depth 1, of a homogeneous undistorted point, shape (3, 3)."""
        return self.camera_from_rig[:3, :3].T @ np.linalg.inv(self.matrix)

    def undistort(self, points_px: Points2) -> Points2:
        """Undistorted pixel coordinates (n, 2) of image points (n, 2); nan stays nan."""
        require_shape("points_px", points_px, (None, 2))
        u, v = (np.ascontiguousarray(points_px[:, axis], dtype=np.float64) for axis in (0, 1))
        out = np.empty((2, len(u)))
        lens.undistort(u, v, self.lens, out[0], out[1])
        return np.ascontiguousarray(out.T)

    def rays(self, points_px: Points2) -> Points3:
        """Directions (n, 3) in the rig frame, depth 1, of undistorted points (n, 2)."""
        require_shape("points_px", points_px, (None, 2))
        homogeneous = np.column_stack([points_px, np.ones(len(points_px))])
        return homogeneous @ self.ray_matrix.T

    def project(self, points_mm: Points3) -> Points2:
        """Distorted image points (n, 2) of rig points (n, 3) in mm."""
        seen = geometry.apply(self.camera_from_rig, points_mm)
        x, y = seen[:, 0] / seen[:, 2], seen[:, 1] / seen[:, 2]
        k1, k2, p1, p2, k3 = self.distortion
        r2 = x * x + y * y
        radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
        xd = x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x)
        yd = y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y
        ones = np.ones_like(xd)
        return np.column_stack([xd, yd, ones]) @ self.matrix[:2].T
