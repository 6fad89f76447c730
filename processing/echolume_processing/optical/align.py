"""How far the laser plane is from parallel to YZ: the number to watch while the head is turned in its mount."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view
from numpy.typing import NDArray

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Points3, require_shape
from echolume_processing.optical import triangulate
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.plane_fit import grouped_covariance, robust_fit
from echolume_processing.optical.stripe import Stripe

Values = NDArray[np.float64]

FIELD_Y_MM = 200.0
FIELD_Z_MM = 40.0
MAX_SIGMA_PX = 0.5
MAX_STEP_PX = 4.0
"""Neighbouring rows of one stripe differ by less."""
MIN_POINTS = 50
MIN_LENGTH_MM = 20.0
NEIGHBOURS = 9
ALONE_MM = 2.0
"""A point this far from the median of its neighbours along the line is another light."""
MIN_HEIGHT_MM = 3.0
"""The tilt about y is known only if heights vary by this (RMS, apart from a slope along y)."""


@dataclass(frozen=True)
class Alignment:
    """How a plane lies against YZ.

    Attributes
    ----------
    about_z_deg : float
        Turn about z: positive if x falls as y grows.
    about_y_deg : float or None
        Turn about y: positive if x grows with z; None if the heights do not tell.
    about_z_sigma_deg, about_y_sigma_deg : float
        Standard deviations; nan for a plane given.
    points : int
        How many were used; 0 for a plane given.
    """

    about_z_deg: float
    about_y_deg: float | None
    about_z_sigma_deg: float = float("nan")
    about_y_sigma_deg: float = float("nan")
    points: int = 0

    @property
    def angle_deg(self) -> float:
        """Angle to YZ, as far as it is known."""
        slopes = np.tan(np.radians([self.about_z_deg, self.about_y_deg or 0.0]))
        return float(np.degrees(np.arctan(np.hypot(*slopes))))

    @property
    def over_field_mm(self) -> float:
        """By how much x varies over the plane within the field, as far as it is known."""
        along_y, along_z = np.abs(np.tan(np.radians([self.about_z_deg, self.about_y_deg or 0.0])))
        return float(FIELD_Y_MM * along_y + FIELD_Z_MM * along_z)

    @property
    def text(self) -> str:
        """One line for the operator."""
        line = f"{self.angle_deg:6.3f} deg, {self.over_field_mm:6.3f} mm over the field"
        line += f"   (about z {self.about_z_deg:+.3f} +- {self.about_z_sigma_deg:.3f} deg"
        if self.about_y_deg is None:
            return line + ", about y unknown: put a block under a part of the line)"
        return line + f", about y {self.about_y_deg:+.3f} +- {self.about_y_sigma_deg:.3f} deg)"


def plane_alignment(normal: Values) -> Alignment:
    """How a plane of known normal (3,) lies against YZ."""
    require_shape("normal", normal, (3,))
    slopes = -normal[1:] / normal[0]  # dx/dy, dx/dz
    return Alignment(_degrees(-slopes[0]), _degrees(slopes[1]))


def stripe_alignment(points_mm: Points3) -> Alignment:
    """How the plane of one stripe lies against YZ.

    Parameters
    ----------
    points_mm : (n, 3) float64
        Points of one stripe in their order along it, rig frame; they need not lie on one surface.

    Returns
    -------
    Alignment

    Raises
    ------
    CalibrationRejectedError
        If the stripe is too short to tell.

    Notes
    -----
    Robust least squares of x over y and, where the heights vary enough apart from a slope along y, z. On a flat bench
    the stripe is a line and tells only the turn about z.
    """
    require_shape("points_mm", points_mm, (None, 3))
    points = _in_company(points_mm[np.isfinite(points_mm).all(axis=1)])
    spread_mm = float(points[:, 1].std()) if len(points) else 0.0
    if len(points) < MIN_POINTS or spread_mm < MIN_LENGTH_MM:
        raise CalibrationRejectedError(
            f"align: {len(points)} points over {4 * spread_mm:.0f} mm of the line, needs {MIN_POINTS} over "
            f"{4 * MIN_LENGTH_MM:.0f} mm: let the whole line be seen by both cameras"
        )
    line = np.column_stack([np.ones(len(points)), points[:, 1]])
    rise = points[:, 2] - line @ np.linalg.lstsq(line, points[:, 2], rcond=None)[0]
    known = float(np.sqrt(np.mean(rise**2))) >= MIN_HEIGHT_MM
    design = np.column_stack([line, points[:, 2]]) if known else line
    fit = robust_fit(design, points[:, 0])
    # Errors change slowly along the line: a piece of it counts as one measurement, not each of its points.
    pieces = [slice(k, k + 25) for k in range(0, len(points), 25)]
    sigma = np.sqrt(np.diag(grouped_covariance(fit, design, points[:, 0], pieces, 0.0)[0]))
    return Alignment(
        _degrees(-fit.beta[1]),
        _degrees(fit.beta[2]) if known else None,
        _degrees(sigma[1]),
        _degrees(sigma[2]) if known else float("nan"),
        int(fit.weights.sum()),
    )


def _in_company(points: Points3) -> Points3:
    """Points whose height or x their neighbours share: a few false ones far off the line would turn the plane."""
    if len(points) < NEIGHBOURS:
        return points
    near = np.ones(len(points), dtype=np.bool_)
    for axis in (0, 2):
        middle = np.median(sliding_window_view(np.pad(points[:, axis], NEIGHBOURS // 2, "edge"), NEIGHBOURS), axis=1)
        near &= np.abs(points[:, axis] - middle) < ALONE_MM
    return points[near]


def stripe_points(cameras: tuple[Camera, Camera], left: Stripe, right: Stripe) -> Points3:
    """Stereo points (n, 3) of one stripe without any knowledge of the laser plane.

    Parameters
    ----------
    cameras : (Camera, Camera)
        Left and right, in the rig frame.
    left, right : Stripe
        The strongest candidate of each row is taken.

    Returns
    -------
    (n, 3) float64
        Of the rows of the left image whose epipolar line meets the right camera's stripe exactly once.
    """
    here, there = (_undistorted(camera, found) for camera, found in zip(cameras, (left, right), strict=True))
    projections = cameras[0].projection, cameras[1].projection
    if len(here) < 2 or len(there) < 2:
        return np.empty((0, 3))
    lines = np.column_stack([here, np.ones(len(here))]) @ triangulate.fundamental(*projections).T  # (n, 3)
    side = lines @ np.column_stack([there, np.ones(len(there))]).T  # (n, m)
    joined = np.abs(np.diff(there, axis=0)).max(axis=1) < MAX_STEP_PX
    crosses = (side[:, :-1] > 0) != (side[:, 1:] > 0)
    crosses &= joined
    once = np.nonzero(crosses.sum(axis=1) == 1)[0]
    at = crosses[once].argmax(axis=1)
    before, after = side[once, at], side[once, at + 1]
    part = (before / (before - after))[:, None]
    match = there[at] + part * (there[at + 1] - there[at])
    return triangulate.stereo(*projections, here[once], match)


def _undistorted(camera: Camera, found: Stripe) -> NDArray[np.float64]:
    with np.errstate(invalid="ignore"):
        rows = np.nonzero(found.sigma_px[:, 0] < MAX_SIGMA_PX)[0]
    return camera.undistort(np.column_stack([found.column_px[rows, 0], rows.astype(np.float64)]))


def _degrees(slope: float) -> float:
    return float(np.degrees(np.arctan(slope)))
