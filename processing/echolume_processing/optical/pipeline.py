"""One camera pair to points: stripe, active triangulation, correspondence, stereo triangulation, gates, sigmas."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration, CameraCalibration, LaserCalibration
from echolume_messages.types import OPTICAL_POINT, Frame, OpticalSource, Structured
from echolume_processing.optical import agreement, correspond, covariance, select, stripe, triangulate
from echolume_processing.optical.agreement import Agreement
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.candidates import Candidates, View, candidates_of
from echolume_processing.optical.correspond import Match
from echolume_processing.optical.select import Verdict

Values = NDArray[np.float64]

FEW_BENDS = 30
SATURATED, BOTH = 1, 2
"""Bits of a point's flags."""


@dataclass(frozen=True)
class OpticalSettings:
    """Gates and error terms of the optical chain.

    Attributes
    ----------
    z_mm, y_mm : (float, float)
        Where a point may lie; beyond it is a reflection or clutter.
    plane_sigma_mm : float
        How well the laser plane's position is known at each stripe (calibration and guide).
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
    camera_sigma: float = 0.25
    least_camera_px: float = 0.005
    run_rows: int = 6


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
    verdicts : two of (8,) int64
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
        self._views = View.of(cameras[0], cameras[1]), View.of(cameras[1], cameras[0])
        used = self._settings
        self._camera_px = tuple(max(used.camera_sigma * c.rms_px, used.least_camera_px) for c in (left, right))
        self._gates_mm = np.array([*used.z_mm, *used.y_mm])
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

        References
        ----------
        Llata et al., 2.2, eq. 1-4.
        """
        return self.measure(left, right, x_mm).points

    def measure(self, left: Frame, right: Frame, x_mm: float) -> StripePoints:
        """Points of one stripe with their covariances, and what became of all candidates; see `process`.

        Notes
        -----
        A pair of candidates whose active points predict each other is believed. Without such support a candidate
        is kept only if neither camera sees a believed stripe on the same row, and its neighbours agree.
        """
        for name, frame, size in (("left", left, self._sizes[0]), ("right", right, self._sizes[1])):
            if frame.shape != size:
                raise ValueError(f"{name} frame: expected shape {size} of the calibration, got {frame.shape}")
        distance_mm = self._offset_mm + x_mm * self._per_guide_mm
        views = self._views
        sides = tuple(
            candidates_of(
                stripe.extract(frame), views[i], views[1 - i], self._normal, distance_mm, self._gates_mm
            )
            for i, frame in enumerate((left, right))
        )  # fmt: skip
        matches = tuple(correspond.walk(sides[i], sides[1 - i], views[i].f_to_other) for i in (0, 1))
        verdicts = select.choose(sides, matches, self._settings.run_rows)
        sigmas = tuple(_with_speckle(side, verdict) for side, verdict in zip(sides, verdicts, strict=True))
        pair = self._pair(sides, matches[0], verdicts, sigmas, distance_mm)
        alone = [self._active(i, sides[i], verdicts[i], sigmas[i]) for i in (0, 1)]
        return StripePoints(
            _pack([pair.set, *alone]),
            np.concatenate([pair.set.covariance, *(s.covariance for s in alone)], axis=1),
            pair.joint_mm,
            pair.joint_covariance,
            tuple(np.bincount(v, minlength=len(Verdict)) for v in verdicts),
            pair.agreement,
        )

    def _pair(
        self,
        sides: tuple[Candidates, ...],
        match: Match,
        verdicts: tuple[select.Verdicts, ...],
        sigmas: tuple[Values, ...],
        distance_mm: float,
    ) -> _Pair:
        """Everything that rests on both cameras."""
        left, right = self._views
        both = np.flatnonzero(verdicts[0] == Verdict.BOTH)
        both = both[verdicts[1][match.partner[both]] == Verdict.BOTH]
        other = match.partner[both]
        seen = np.concatenate([sides[0].points_px[:, both], match.points_px[:, both]])  # (4, n)
        points = triangulate.stereo_columns(left.projection, right.projection, seen)
        sigma_left = np.hypot(sigmas[0][both], self._camera_px[0])
        sigma_right = np.sqrt(match.gain[both] * sigmas[1][other] ** 2 + self._camera_px[1] ** 2)
        found = covariance.stereo_covariance(
            left.projection, right.projection, points, sigma_left, sigma_right, self._camera_px[0]
        )
        drawn = covariance.joint(points, found, self._normal, distance_mm, self._settings.plane_sigma_mm)
        clipped = sides[0].saturated[both] | sides[1].saturated[other]
        flags = clipped * np.uint8(SATURATED) | np.uint8(BOTH)
        plane = triangulate.plane_from_pixel(right.centre_mm, right.ray_matrix, self._normal, distance_mm)
        active_mm = sides[0].active_mm[:, both]
        difference_mm = active_mm[2] - triangulate.active(plane, np.ascontiguousarray(seen[2:].T))[:, 2]
        by_mm = agreement.plane_amplification(active_mm.T, left.centre_mm, right.centre_mm, self._normal)
        chosen = _Set(points, found, flags, sides[0].row[both], OpticalSource.STEREO)
        return _Pair(chosen, *drawn, agreement.of_stripe(difference_mm, by_mm))

    def _active(self, i: int, side: Candidates, verdict: select.Verdicts, sigma_px: Values) -> _Set:
        """The active points of one camera."""
        kept = np.flatnonzero(verdict <= Verdict.ALONE)
        points = side.active_mm[:, kept]
        column_px = np.hypot(sigma_px[kept], self._camera_px[i])
        found = covariance.active_covariance(
            self._views[i].projection, self._normal, points, column_px, self._camera_px[i],
            self._settings.plane_sigma_mm,
        )  # fmt: skip
        flags = side.saturated[kept] * np.uint8(SATURATED) | (verdict[kept] == Verdict.BOTH) * np.uint8(BOTH)
        source = OpticalSource.ACTIVE_RIGHT if i else OpticalSource.ACTIVE_LEFT
        return _Set(points, found, flags, side.row[kept], source)


@dataclass(frozen=True)
class _Set:
    points_mm: Values
    covariance: Values
    flags: NDArray[np.uint8]
    row: NDArray[np.int64]
    source: OpticalSource


@dataclass(frozen=True)
class _Pair:
    set: _Set
    joint_mm: Values
    joint_covariance: Values
    agreement: Agreement


def _with_speckle(side: Candidates, verdict: select.Verdicts) -> Values:
    """Sigma of each column in pixels, (n,): as the extraction states it, and what the stripe itself shows on top."""
    agreed = verdict == Verdict.BOTH
    column = np.full(side.rows, np.nan)
    column[side.row[agreed]] = side.measured[0, agreed]
    lag = agreement.LAG_ROWS
    bend = column[2 * lag :] - 2 * column[lag:-lag] + column[: -2 * lag]
    bend = bend[np.isfinite(bend)]
    if len(bend) < FEW_BENDS:
        return side.sigma_px
    seen_px = 1.4826 * float(np.median(np.abs(bend))) / np.sqrt(6.0)
    extra = max(seen_px**2 - float(np.median(side.sigma_px[agreed])) ** 2, 0.0)
    return np.sqrt(side.sigma_px**2 + extra)


def _pack(sets: list[_Set]) -> Structured:
    points = np.concatenate([s.points_mm for s in sets], axis=1)
    out = np.empty(points.shape[1], dtype=OPTICAL_POINT)
    out["x_mm"], out["y_mm"], out["z_mm"] = points
    out["sigma_z_mm"] = np.sqrt(np.concatenate([s.covariance[5] for s in sets]))
    out["flags"] = np.concatenate([s.flags for s in sets])
    out["row"] = np.concatenate([s.row for s in sets])
    out["source"] = np.repeat([s.source for s in sets], [len(s.row) for s in sets])
    return out
