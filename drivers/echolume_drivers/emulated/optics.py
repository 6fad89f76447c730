"""The emulated optics as they truly are: two cameras with distortion, a laser plane on its guide, the laser's head."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Literal, TypeAlias

import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.flaws import DARK_LAB, LAB_LENS, Flaws, Lens, hot_pixels
from echolume_messages.geometry import (
    Matrix,
    Points3,
    apply,
    invert,
    require_shape,
    rotation_from_vector,
    transform,
)

Side: TypeAlias = Literal["left", "right"]
Pixels2: TypeAlias = NDArray[np.float64]
"""Image points, shape (n, 2): column u and row v, pixel centres at whole numbers."""

FOCAL_PX = 2420.0
"""All of -100..100 mm stays in view of both cameras up to 40 mm above the bench, and the board at 60 mm."""


@dataclass(frozen=True)
class CameraTruth:
    """A pinhole camera with five distortion coefficients (k1, k2, p1, p2, k3)."""

    width_px: int
    height_px: int
    matrix: Matrix
    distortion: NDArray[np.float64]
    camera_from_rig: Matrix
    lens: Lens = LAB_LENS
    hot: NDArray[np.float64] = field(default_factory=lambda: np.zeros((0, 3)))
    """Hot pixels: row, column, dark signal in DN per second."""

    @cached_property
    def centre_mm(self) -> NDArray[np.float64]:
        """Where the camera stands, in the rig frame, shape (3,)."""
        return invert(self.camera_from_rig)[:3, 3]

    @cached_property
    def packed(self) -> NDArray[np.float64]:
        """All parameters in one row for the kernels: fx, fy, cx, cy, k1, k2, p1, p2, k3, [R | t] row by row, focus."""
        m = self.matrix
        inner = np.array([m[0, 0], m[1, 1], m[0, 2], m[1, 2]])
        return np.concatenate([inner, self.distortion, self.camera_from_rig[:3].ravel(), self.lens.focus_row(m[0, 0])])

    @property
    def grain_px(self) -> float:
        """Width of a speckle grain on the sensor."""
        return self.lens.grain_px(float(self.matrix[0, 0]))

    @cached_property
    def rays(self) -> NDArray[np.float64]:
        """Undistorted normalised image coordinates (x/z, y/z) of every pixel centre, shape (rows, columns, 2)."""
        v, u = np.mgrid[0 : self.height_px, 0 : self.width_px].astype(np.float64)
        return self.normalised(np.stack([u.ravel(), v.ravel()], axis=1)).reshape(self.height_px, self.width_px, 2)

    def project(self, points_mm: Points3) -> Pixels2:
        """Image points (n, 2) in px of points (n, 3) in mm, rig frame."""
        local = apply(self.camera_from_rig, points_mm)
        distorted = distort(local[:, :2] / local[:, 2:], self.distortion)
        focal = np.array([self.matrix[0, 0], self.matrix[1, 1]])
        return distorted * focal + self.matrix[:2, 2]

    def normalised(self, pixels: Pixels2) -> NDArray[np.float64]:
        """Undistorted (x/z, y/z), shape (n, 2), of image points (n, 2) in px; exact to 1e-10."""
        require_shape("pixels", pixels, (None, 2))
        goal = (pixels - self.matrix[:2, 2]) / np.array([self.matrix[0, 0], self.matrix[1, 1]])
        found = goal.copy()
        for _ in range(8):
            found += goal - distort(found, self.distortion)
        return found


@dataclass(frozen=True)
class OpticalTruth:
    """Both cameras and the laser plane: normal . X = offset_mm + s (normal . guide_direction), s the guide's x."""

    left: CameraTruth
    right: CameraTruth
    laser_normal: NDArray[np.float64]
    laser_offset_mm: float
    guide_direction: NDArray[np.float64]
    head_at_zero_mm: NDArray[np.float64]
    """The point that the light fan comes from when the guide stands at 0; it lies in the plane."""
    stripe_sigma_px: float
    """Half width of the line in the plane of focus."""
    flaws: Flaws = DARK_LAB

    def camera(self, side: Side) -> CameraTruth:
        """The left or the right camera."""
        return self.left if side == "left" else self.right

    def plane_offset_mm(self, x_mm: float) -> float:
        """Offset of the laser plane when the guide stands at `x_mm`."""
        return float(self.laser_offset_mm + x_mm * (self.laser_normal @ self.guide_direction))

    def head_mm(self, x_mm: float) -> NDArray[np.float64]:
        """Where the light comes from when the guide stands at `x_mm`, shape (3,)."""
        return self.head_at_zero_mm + x_mm * self.guide_direction


def distort(normalised: NDArray[np.float64], coefficients: NDArray[np.float64]) -> NDArray[np.float64]:
    """Brown-Conrady distortion of normalised image coordinates (n, 2) by (k1, k2, p1, p2, k3)."""
    k1, k2, p1, p2, k3 = coefficients
    x, y = normalised[:, 0], normalised[:, 1]
    r2 = x * x + y * y
    radial = 1 + r2 * (k1 + r2 * (k2 + r2 * k3))
    return np.stack(
        [
            x * radial + 2 * p1 * x * y + p2 * (r2 + 2 * x * x),
            y * radial + p1 * (r2 + 2 * y * y) + 2 * p2 * x * y,
        ],
        axis=1,
    )


def optical_truth(seed: int, flaws: Flaws = DARK_LAB, lens: Lens = LAB_LENS) -> OpticalTruth:
    """Draw the optics of an emulated rig: the nominal build plus the small errors that a calibration has to find.

    `flaws` and `lens` say what its pictures suffer from; they change nothing of the build.
    """
    rng = np.random.default_rng([seed, 0x0B71C5])
    left = _camera(rng, -260.0)
    right = _camera(rng, 260.0)
    normal = _unit(np.array([1.0, *rng.uniform(-4e-3, 4e-3, 2)]))
    guide = _unit(np.array([1.0, *rng.uniform(-4e-3, 4e-3, 2)]))
    head = np.array([0.0, 0.0, 500.0]) + rng.uniform(-2, 2, 3)
    offset_mm = float(rng.uniform(-0.8, 0.8))
    head[0] = (offset_mm - normal[1] * head[1] - normal[2] * head[2]) / normal[0]
    stripe_sigma_px = float(rng.uniform(1.6, 1.9))
    sensors = np.random.default_rng([seed, 0x507])
    left, right = (
        replace(c, lens=lens, hot=hot_pixels(sensors, c.width_px, c.height_px, flaws)) for c in (left, right)
    )
    return OpticalTruth(left, right, normal, offset_mm, guide, head, stripe_sigma_px, flaws)


def _camera(rng: np.random.Generator, x_mm: float, width_px: int = 1280, height_px: int = 1024) -> CameraTruth:
    """A camera above (x, 0) that looks at the middle of the bench, image u along +x and v along -y."""
    focal = FOCAL_PX * (1 + rng.uniform(-0.01, 0.01))
    matrix = np.array(
        [
            [focal, 0.0, (width_px - 1) / 2 + rng.uniform(-8, 8)],
            [0.0, focal * (1 + rng.uniform(-1e-3, 1e-3)), (height_px - 1) / 2 + rng.uniform(-8, 8)],
            [0.0, 0.0, 1.0],
        ]
    )
    distortion = np.array([-0.10, 0.08, 0.0, 0.0, 0.02]) + rng.uniform(-1, 1, 5) * [0.02, 0.02, 3e-4, 3e-4, 0.02]
    centre_mm = np.array([x_mm, 0.0, 520.0]) + rng.uniform(-2, 2, 3)
    target_mm = np.array([0.0, 0.0, 15.0]) + rng.uniform(-2, 2, 3)
    forward = _unit(target_mm - centre_mm)
    right = _unit(np.cross(forward, [0.0, 1.0, 0.0]))
    rotation = np.stack([right, np.cross(forward, right), forward])
    rotation = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-5e-3, 5e-3)])) @ rotation
    return CameraTruth(width_px, height_px, matrix, distortion, transform(rotation, -rotation @ centre_mm))


def _unit(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    return vector / np.linalg.norm(vector)
