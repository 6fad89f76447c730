"""One camera pair to points: stripe, active triangulation, correspondence, stereo triangulation, gates, sigmas."""

from __future__ import annotations

from dataclasses import dataclass

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration, CameraCalibration, LaserCalibration
from echolume_messages.types import OPTICAL_POINT, Frame, Structured
from echolume_processing.optical import agreement, chain, covariance, stripe
from echolume_processing.optical.agreement import Agreement
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.candidates import contiguous, view_of
from echolume_processing.optical.chain import Terms
from echolume_processing.optical.correspond import TOLERANCE_PX
from echolume_processing.optical.select import Verdict

Values = NDArray[np.float64]

ALARM_SIGMAS = 2.0
FIELD_MM = 100.0
"""The guide's positions reach about this far from the middle."""


@dataclass(frozen=True)
class OpticalSettings:
    """Gates and error terms of the optical chain.

    Attributes
    ----------
    z_mm, y_mm : (float, float)
        Where a point may lie; beyond it is a reflection or clutter.
    plane_sigma_mm : float
        How well the laser plane's position is known where its calibration does not say so.
    guide_sigma_mm : float
        How well the guide's position is known where it does not say so.
    camera_sigma : float
        Error of the camera model over the RMS of its calibration: the root of parameters over observations.
    least_camera_px : float
        No camera model is better than this.
    run_rows : int
        A candidate without the other camera's support needs this many neighbouring rows that agree.
    """

    z_mm: tuple[float, float] = (-8.0, 80.0)
    y_mm: tuple[float, float] = (-130.0, 130.0)
    plane_sigma_mm: float = 0.02
    guide_sigma_mm: float = 0.01
    camera_sigma: float = 0.25
    least_camera_px: float = 0.005
    run_rows: int = 12


@dataclass(frozen=True)
class StripePoints:
    """All that one camera pair yields.

    Attributes
    ----------
    points : (n,) OPTICAL_POINT
        Stereo points, then active left, then active right; each in order of the image rows.
    covariance : (6, n) float64
        Of each point: xx, xy, xz, yy, yz, zz in mm^2; `matrices` gives them as (n, 3, 3).
    joint_mm, joint_covariance : (3, m), (6, m) float64
        Stereo points with the laser plane as one more measurement, in the order of the stereo points.
    verdicts : two of (9,) int64
        How many candidates of the left and of the right camera met each `Verdict`.
    agreement : Agreement
        Of both cameras' heights.
    """

    points: Structured
    covariance: Values
    joint_mm: Values
    joint_covariance: Values
    verdicts: tuple[NDArray[np.int64], NDArray[np.int64]]
    agreement: Agreement

    @property
    def matrices(self) -> NDArray[np.float64]:
        """Covariance of each point, (n, 3, 3) in mm^2."""
        return covariance.full(self.covariance)

    @property
    def counts(self) -> dict[str, int]:
        """Points by label (both, left only, right only) and rejected candidates by reason."""
        left, right = self.verdicts
        labels = {"both": int(left[Verdict.BOTH]), "left": int(left[Verdict.ALONE]), "right": int(right[Verdict.ALONE])}
        reasons = {v.name.lower(): int(left[v] + right[v]) for v in Verdict if v >= Verdict.OUTSIDE}
        return {**labels, **reasons}


def plane_covariance(laser: LaserCalibration, otherwise_mm: float) -> Values:
    """Covariance (4, 4) of the laser plane's position over (1, s, y, z), in mm^2; see `LaserCalibration`."""
    if isinstance(laser.plane_covariance, msgspec.UnsetType):
        return np.diag([otherwise_mm**2, 0.0, 0.0, 0.0])
    return np.array(laser.plane_covariance, dtype=np.float64)


def plane_variance(plane: Values, x_mm: float) -> Values:
    """What multiplies 1, y, z, y^2, y z, z^2 in the variance of the plane's position at a guide position, (6,)."""
    at = np.array([[1.0, x_mm, 0.0, 0.0], [0.0, 0.0, 1.0, 0.0], [0.0, 0.0, 0.0, 1.0]])
    c = at @ plane @ at.T
    return np.array([c[0, 0], 2 * c[0, 1], 2 * c[0, 2], c[1, 1], 2 * c[1, 2], c[2, 2]])


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
        self._views = view_of(cameras[0], cameras[1]), view_of(cameras[1], cameras[0])
        used = self._settings
        self._normal = np.asarray(laser.normal, dtype=np.float64)
        left_px, right_px = (max(used.camera_sigma * c.rms_px, used.least_camera_px) for c in (left, right))
        self._terms = Terms(
            np.array([*used.z_mm, *used.y_mm]), self._normal, left_px, right_px, TOLERANCE_PX, used.run_rows
        )
        self._plane_covariance = plane_covariance(laser, used.plane_sigma_mm)
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

    @property
    def plane_limit_mm(self) -> float:
        """A larger error of the laser plane is not explained by its stated sigma.

        The cameras' errors look like the plane's, so that the limit does not fall below that of `plane_sigma_mm`.
        """
        used = self._settings
        stated = [plane_variance(self._plane_covariance, x_mm)[0] for x_mm in (-FIELD_MM, 0.0, FIELD_MM)]
        return ALARM_SIGMAS * max(used.plane_sigma_mm, float(np.sqrt(max(stated) + used.guide_sigma_mm**2)))

    def process(self, left: Frame, right: Frame, x_mm: float, guide_sigma_mm: float | None = None) -> Structured:
        """Points of one stripe.

        Parameters
        ----------
        left, right : (rows, columns) uint8
            The frames of one trigger, not undistorted.
        x_mm : float
            The guide's position at the exposure.
        guide_sigma_mm : float, optional
            Its standard deviation, as the guide states it.

        Returns
        -------
        (n,) OPTICAL_POINT
            Stereo points first, then active left, then active right; each in order of the image rows.

        Raises
        ------
        ValueError
            If a frame is not of the calibrated camera's size.

        References
        ----------
        Llata et al., 2.2, eq. 1-4.
        """
        return self.measure(left, right, x_mm, guide_sigma_mm).points

    def measure(self, left: Frame, right: Frame, x_mm: float, guide_sigma_mm: float | None = None) -> StripePoints:
        """Points of one stripe with their covariances, and what became of all candidates; see `process`.

        Notes
        -----
        A pair of candidates whose active points predict each other is believed. Without such support a candidate
        is kept only if neither camera sees a believed stripe on the same row, and its neighbours agree.
        """
        for name, frame, size in (("left", left, self._sizes[0]), ("right", right, self._sizes[1])):
            if frame.shape != size:
                raise ValueError(f"{name} frame: expected shape {size} of the calibration, got {frame.shape}")
        stripes = contiguous(stripe.extract(left)), contiguous(stripe.extract(right))
        out = np.empty(2 * len(left) + len(right), dtype=OPTICAL_POINT)
        sigma_mm = self._settings.guide_sigma_mm if guide_sigma_mm is None else guide_sigma_mm
        plane_mm2 = plane_variance(self._plane_covariance, x_mm)
        plane_mm2[0] += (sigma_mm * self._per_guide_mm) ** 2
        distance_mm = self._offset_mm + x_mm * self._per_guide_mm
        found = chain.run(*stripes, *self._views, self._terms, distance_mm, plane_mm2, out)
        return StripePoints(
            out[: found.covariance.shape[1]],
            found.covariance,
            found.joint_mm,
            found.joint_covariance,
            (found.left_verdicts, found.right_verdicts),
            agreement.of_stripe(found.joint_mm.shape[1], found.agreement),
        )
