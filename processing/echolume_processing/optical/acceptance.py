"""Whether a calibration of cameras holds for views that it has not seen, and the reason if it does not."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Points3
from echolume_processing.optical import triangulate
from echolume_processing.optical.board import CalibrationBoard
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.pair_covariance import PairCovariance
from echolume_processing.optical.pair_solver import ADVICE, BoardView, PairSolution, fit_pose, solve_from

MIN_VIEWS = 5
"""With fewer, four would not be left to calibrate from."""
MAX_LEFT_OUT_PX = 1.0
MAX_LEFT_OUT_SQUARES = 0.05
"""Triangulated corners of a view left out may be off by this share of a square, RMS over the view."""
MAX_FOCAL_SIGMA = 0.005
"""Relative standard deviation of a focal length; distances are uncertain by as much."""


@dataclass(frozen=True)
class LeftOut:
    """What each view looks like to cameras calibrated without it.

    Attributes
    ----------
    names : list of str
    px : (views, 2) float64
        RMS reprojection error in each camera, only the board's pose being fitted.
    mm : (views,) float64
        RMS distance of the triangulated corners from the board's shape.
    """

    names: list[str]
    px: NDArray[np.float64]
    mm: NDArray[np.float64]

    @property
    def rms_px(self) -> float:
        """Over all views and both cameras; nan without views."""
        return float(np.sqrt(np.mean(self.px**2))) if self.names else float("nan")

    @property
    def rms_mm(self) -> float:
        """Over all views; nan without views."""
        return float(np.sqrt(np.mean(self.mm**2))) if self.names else float("nan")


def leave_one_out(
    found: PairSolution, views: Sequence[BoardView], board: CalibrationBoard, image_size_px: tuple[int, int]
) -> LeftOut:
    """Calibrate without each view in turn, and see how well that fits the view.

    Parameters
    ----------
    found : PairSolution
        The solution from all views.
    views : sequence of BoardView
        At least five; with fewer there is no result.
    """
    if len(views) < MIN_VIEWS:
        return LeftOut([], np.empty((0, 2)), np.empty(0))
    px, mm = np.empty((len(views), 2)), np.empty(len(views))
    for k, view in enumerate(views):
        without = solve_from(found, [v for i, v in enumerate(views) if i != k], board, image_size_px)
        px[k] = fit_pose((without.left, without.right), view, board, found.left_from_board[k])[1]
        points = measure_board(without.left, without.right, view)
        shape = view.shape_mm(board)
        mm[k] = np.sqrt(np.mean(np.sum((points - rigid_fit(shape, points)) ** 2, axis=1)))
    return LeftOut([v.name for v in views], px, mm)


def require_determined(found: PairSolution, covariance: PairCovariance) -> None:
    """Raise the reason if the views leave a focal length open.

    Raises
    ------
    CalibrationRejectedError
        Names the camera.

    Notes
    -----
    Views that are all alike fit each other well, left out or not; only the covariance tells.
    """
    for side, camera in (("left", found.left), ("right", found.right)):
        for axis, name in ((0, "fx"), (1, "fy")):
            sigma_px, focal_px = covariance.sigmas[f"{side} {name}_px"], float(camera.matrix[axis, axis])
            if sigma_px > MAX_FOCAL_SIGMA * focal_px:
                raise CalibrationRejectedError(
                    f"calibrate cameras: rejected: the views determine the {side} camera's {name} to {focal_px:.0f} +- "
                    f"{sigma_px:.0f} px only, {MAX_FOCAL_SIGMA:.1%} is needed: {ADVICE}"
                )


def require_accepted(left_out: LeftOut, square_mm: float) -> None:
    """Raise the reason if a calibration does not hold for the views left out.

    Raises
    ------
    CalibrationRejectedError
        Names the worst view.
    """
    if not left_out.names:
        return
    per_view = left_out.px.max(axis=1)
    worst_px, worst_mm = int(np.argmax(per_view)), int(np.argmax(left_out.mm))
    limit_mm = MAX_LEFT_OUT_SQUARES * square_mm
    if per_view[worst_px] > MAX_LEFT_OUT_PX:
        raise CalibrationRejectedError(
            f"calibrate cameras: rejected: cameras calibrated without view {left_out.names[worst_px]} miss its corners "
            f"by {per_view[worst_px]:.2f} px, at most {MAX_LEFT_OUT_PX} px is accepted: the views do not determine the "
            "cameras; add views that fill the corners of both images and tilt the board in all directions"
        )
    if left_out.mm[worst_mm] > limit_mm:
        raise CalibrationRejectedError(
            f"calibrate cameras: rejected: cameras calibrated without view {left_out.names[worst_mm]} measure its "
            f"corners {left_out.mm[worst_mm]:.3f} mm off the board's shape, at most {limit_mm:.3f} mm is accepted: "
            "is the board flat and its square size right? Else add views tilted in all directions"
        )


def verdict(left_out: LeftOut) -> str:
    """The acceptance in one line."""
    if not left_out.names:
        return f"not judged: leaving views out in turn takes {MIN_VIEWS} of them"
    return f"accepted: views left out in turn fit to {left_out.rms_px:.4f} px, {left_out.rms_mm:.4f} mm RMS"


def measure_board(left: Camera, right: Camera, view: BoardView) -> Points3:
    """Corners (n, 3) in mm, triangulated by eq. 1-2 in the frame of the cameras' poses."""
    left_px, right_px = left.undistort(view.left_px), right.undistort(view.right_px)
    return triangulate.stereo(left.projection, right.projection, left_px, right_px)


def rigid_fit(shape: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """`shape` (n, 3) moved rigidly onto `points` (n, 3) by least squares (Kabsch)."""
    centre, target = shape.mean(axis=0), points.mean(axis=0)
    u, _, vt = np.linalg.svd((points - target).T @ (shape - centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return (shape - centre) @ rotation.T + target
