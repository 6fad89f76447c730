"""One camera pair to points: stripe, active triangulation, correspondence, stereo triangulation, gates, sigmas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration, CameraCalibration, LaserCalibration
from echolume_messages.types import OPTICAL_POINT, Frame, OpticalSource, Structured
from echolume_processing.optical import correspond, select, stripe, triangulate
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.correspond import Side
from echolume_processing.optical.stripe import Stripe

STEP_PX = 0.05
"""Step of the numerical derivatives of z."""


@dataclass(frozen=True)
class OpticalSettings:
    """Gates and error terms of the optical chain.

    Attributes
    ----------
    z_mm, y_mm : (float, float)
        Where a point may lie; beyond it is a reflection or clutter.
    plane_sigma_mm : float
        How well the laser plane's position is known at each stripe (calibration and guide).
    run_rows : int
        A candidate without the other camera's support needs this many neighbouring rows that agree.
    """

    z_mm: tuple[float, float] = (-8.0, 80.0)
    y_mm: tuple[float, float] = (-130.0, 130.0)
    plane_sigma_mm: float = 0.02
    run_rows: int = 6


@dataclass(frozen=True)
class _View:
    camera: Camera
    projection: NDArray[np.float64]
    centre_mm: NDArray[np.float64]
    f_to_other: NDArray[np.float64]


class OpticalPipeline:
    """Turns camera pairs into the paper's three point sets: ST, AT-left and AT-right.

    Parameters
    ----------
    calibration : Calibration
        Of the rig that took the frames; only its optical parts are used.
    settings : OpticalSettings
        Gates and error terms.
    """

    def __init__(self, calibration: Calibration, settings: OpticalSettings | None = None) -> None:
        self._setup(calibration.left, calibration.right, calibration.laser, settings)

    @classmethod
    def of(
        cls,
        left: CameraCalibration,
        right: CameraCalibration,
        laser: LaserCalibration,
        settings: OpticalSettings | None = None,
    ) -> OpticalPipeline:
        """A pipeline of the optical parts alone, before the array is calibrated."""
        made = cls.__new__(cls)
        made._setup(left, right, laser, settings)
        return made

    def _setup(
        self,
        left: CameraCalibration,
        right: CameraCalibration,
        laser: LaserCalibration,
        settings: OpticalSettings | None,
    ) -> None:
        self._settings = settings or OpticalSettings()
        cameras = Camera.of(left), Camera.of(right)
        m = cameras[0].projection, cameras[1].projection
        self._left = _View(cameras[0], m[0], cameras[0].centre_mm, triangulate.fundamental(m[0], m[1]))
        self._right = _View(cameras[1], m[1], cameras[1].centre_mm, triangulate.fundamental(m[1], m[0]))
        self._normal = np.asarray(laser.normal, dtype=np.float64)
        self._offset_mm = laser.offset_mm
        self._per_guide_mm = float(self._normal @ np.asarray(laser.guide_direction, dtype=np.float64))
        self._sizes = (left.height_px, left.width_px), (right.height_px, right.width_px)

    @staticmethod
    def warm_up_kernels(left_shape: tuple[int, int] = (64, 96), right_shape: tuple[int, int] = (64, 96)) -> None:
        """Compile or load the kernels on made-up cameras, so that the first stripe is not late."""
        sizes = left_shape, right_shape
        cameras = [
            CameraCalibration(
                width_px=size[1],
                height_px=size[0],
                camera_matrix=[[1000.0, 0.0, size[1] / 2], [0.0, 1000.0, size[0] / 2], [0.0, 0.0, 1.0]],
                distortion=[0.0] * 5,
                camera_from_rig=[
                    [0.8, 0.0, -0.6 * side, 0.0],
                    [0.0, -1.0, 0.0, 0.0],
                    [-0.6 * side, 0.0, -0.8, 500.0],
                    [0.0, 0.0, 0.0, 1.0],
                ],
                rms_px=0.0,
            )
            for size, side in zip(sizes, (-1.0, 1.0), strict=True)
        ]
        laser = LaserCalibration(normal=(1, 0, 0), offset_mm=0.0, guide_direction=(1, 0, 0), rms_mm=0.0)
        frames = [np.full(size, 20, dtype=np.uint8) for size in sizes]
        for frame in frames:
            frame[:, frame.shape[1] // 2 - 2 : frame.shape[1] // 2 + 2] = 180
        OpticalPipeline.of(cameras[0], cameras[1], laser).process(frames[0], frames[1], 0.0)

    def process(self, left: Frame, right: Frame, x_mm: float) -> Structured:
        """Points of one stripe.

        Parameters
        ----------
        left, right : (rows, columns) uint8
            The frames of one trigger, not undistorted.
        x_mm : float
            The guide's position at the exposure.

        Returns
        -------
        (n,) OPTICAL_POINT
            Stereo points first, then active left, then active right; each in order of the image rows.

        Raises
        ------
        ValueError
            If a frame is not of the calibrated camera's size.

        Notes
        -----
        A pair of candidates whose active points predict each other is believed. Without such support a candidate
        is kept only if neither camera sees a believed stripe on the same row, and its neighbours agree.

        References
        ----------
        Llata et al., 2.2, eq. 1-4.
        """
        for name, frame, size in (("left", left, self._sizes[0]), ("right", right, self._sizes[1])):
            if frame.shape != size:
                raise ValueError(f"{name} frame: expected shape {size} of the calibration, got {frame.shape}")
        distance_mm = self._offset_mm + x_mm * self._per_guide_mm
        stripes = stripe.extract(left), stripe.extract(right)
        views = self._left, self._right
        sides = tuple(self._active(view, s, distance_mm) for view, s in zip(views, stripes, strict=True))
        rows_in_other = tuple(
            _rows(views[1 - i].camera, sides[i].active_mm, self._sizes[1 - i][0]) for i in (0, 1)
        )  # each (rows, k)
        matches = tuple(
            correspond.walk(sides[i], sides[1 - i], views[1 - i].projection, rows_in_other[i], views[i].f_to_other)
            for i in (0, 1)
        )
        kept = select.choose(
            (sides[0].active_mm[..., 2], sides[1].active_mm[..., 2]),
            (stripes[0].amplitude_dn, stripes[1].amplitude_dn),
            (stripes[0].width_px, stripes[1].width_px),
            (matches[0][0], matches[1][0]),
            rows_in_other,
            self._settings.run_rows,
        )
        sigmas = tuple(_column_sigma(s, chosen) for s, chosen in zip(stripes, kept, strict=True))
        parts = [self._stereo(stripes, sides, matches[0], kept[0], sigmas)]
        for i, source in enumerate((OpticalSource.ACTIVE_LEFT, OpticalSource.ACTIVE_RIGHT)):
            parts.append(self._active_set(views[i], stripes[i], sides[i], kept[i], sigmas[i], distance_mm, source))
        return np.concatenate(parts)

    def _active(self, view: _View, found: Stripe, distance_mm: float) -> Side:
        rows, k = found.column_px.shape
        image = np.stack([found.column_px, np.broadcast_to(np.arange(rows)[:, None], (rows, k))], axis=-1)
        points_px = view.camera.undistort(image.reshape(-1, 2))  # (rows * k, 2)
        points = triangulate.active_plane(view.centre_mm, view.camera.rays(points_px), self._normal, distance_mm)
        gate = self._settings
        inside = (points[:, 2] > gate.z_mm[0]) & (points[:, 2] < gate.z_mm[1])
        inside &= (points[:, 1] > gate.y_mm[0]) & (points[:, 1] < gate.y_mm[1])
        points[~inside] = np.nan
        return Side(points_px.reshape(rows, k, 2), points.reshape(rows, k, 3))

    def _stereo(
        self,
        stripes: tuple[Stripe, Stripe],
        sides: tuple[Side, ...],
        match: tuple[NDArray[np.int64], NDArray[np.float64]],
        kept: NDArray[np.bool_],
        sigmas: tuple[NDArray[np.float64], ...],
    ) -> Structured:
        partner, match_px = match
        row, k = np.nonzero(kept & (partner >= 0))
        left_px, right_px = sides[0].points_px[row, k], match_px[row, k]  # (n, 2)
        other = np.unravel_index(partner[row, k], stripes[1].column_px.shape)
        m = self._left.projection, self._right.projection
        points = triangulate.stereo(*m, left_px, right_px)
        step = np.array([STEP_PX, 0.0])
        by_left = (triangulate.stereo(*m, left_px + step, right_px)[:, 2] - points[:, 2]) / STEP_PX
        by_right = (triangulate.stereo(*m, left_px, right_px + step)[:, 2] - points[:, 2]) / STEP_PX
        sigma_mm = np.hypot(by_left * sigmas[0][row, k], by_right * sigmas[1][other])
        saturated = stripes[0].saturated[row, k] | stripes[1].saturated[other]
        good = self._inside(points)
        return _pack(points, sigma_mm, saturated, row, OpticalSource.STEREO)[good]

    def _inside(self, points: NDArray[np.float64]) -> NDArray[np.bool_]:
        low, high = self._settings.z_mm
        return (points[:, 2] > low) & (points[:, 2] < high)

    def _active_set(
        self,
        view: _View,
        found: Stripe,
        side: Side,
        kept: NDArray[np.bool_],
        sigma_px: NDArray[np.float64],
        distance_mm: float,
        source: OpticalSource,
    ) -> Structured:
        row, k = np.nonzero(kept)
        points = side.active_mm[row, k]
        moved = side.points_px[row, k] + np.array([STEP_PX, 0.0])
        aside = triangulate.active_plane(view.centre_mm, view.camera.rays(moved), self._normal, distance_mm)
        by_column = (aside[:, 2] - points[:, 2]) / STEP_PX
        rays = points - view.centre_mm
        by_plane = rays[:, 2] / (rays @ self._normal)
        sigma_mm = np.hypot(by_column * sigma_px[row, k], by_plane * self._settings.plane_sigma_mm)
        return _pack(points, sigma_mm, found.saturated[row, k], row, source)


def _rows(camera: Camera, points: NDArray[np.float64], height_px: int) -> NDArray[np.float64]:
    """Image row (rows, k) at which a camera sees points (rows, k, 3); nan outside its image."""
    v = camera.project(points.reshape(-1, 3))[:, 1].reshape(points.shape[:2])
    return np.where((v >= 0) & (v <= height_px - 1), v, np.nan)


def _column_sigma(found: Stripe, kept: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Sigma of each column in pixels, (rows, k): the noise bound, and the speckle that the stripe itself shows."""
    bound = found.sigma_px
    column = np.where(kept, found.column_px, np.nan)[:, 0]
    bend = column[2:] - 2 * column[1:-1] + column[:-2]
    bend = bend[np.isfinite(bend)]
    if len(bend) < 30:
        return bound
    seen = 1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6.0)
    extra = max(seen**2 - float(np.nanmedian(np.where(kept, bound, np.nan) ** 2)), 0.0)
    return np.sqrt(bound**2 + extra)


def _pack(
    points: NDArray[np.float64],
    sigma_mm: NDArray[np.float64],
    saturated: NDArray[np.bool_],
    row: NDArray[np.int64],
    source: OpticalSource,
) -> Structured:
    out = np.zeros(len(points), dtype=OPTICAL_POINT)
    out["x_mm"], out["y_mm"], out["z_mm"] = points.T
    out["sigma_z_mm"] = sigma_mm
    out["source"] = source
    out["flags"] = saturated
    out["row"] = row
    return out
