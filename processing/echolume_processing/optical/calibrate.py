"""Calibration of the two cameras from views of a board: intrinsics, distortion, and their relative pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.types import Frame
from echolume_processing.optical.acceptance import (
    LeftOut,
    leave_one_out,
    measure_board,
    require_accepted,
    require_determined,
)
from echolume_processing.optical.board import CalibrationBoard, Corners, Pattern
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.pair_covariance import PairCovariance, pair_covariance
from echolume_processing.optical.pair_solver import BoardView, PairSolution, fit_pose, solve, solve_from

MIN_VIEWS = 4
MIN_COMMON = 8
"""Corners that both cameras must see of one board."""
OUTLIER_RATIO = 3.0
OUTLIER_FLOOR_PX = 0.5
"""A view is left out if cameras calibrated without it miss it by more than this and OUTLIER_RATIO times the median."""
SUSPECT_RATIO = 1.5
SUSPECTS = 3
"""So many views of a residual above SUSPECT_RATIO times the median are looked at; a bad view bends the fit its way."""
BLUR_RATIO = 2.5
BLUR_FLOOR_PX = 2.0
MIN_FITTED = 0.8
"""Share of a view's corners that must look like corners of the print."""


@dataclass(frozen=True)
class CameraPair:
    """What the views of the board tell of the two cameras.

    Attributes
    ----------
    left, right : Camera
        Calibrated cameras, in the frame of the left one.
    left_rms_px, right_rms_px : float
        Reprojection error of each camera calibrated on its own.
    stereo_rms_px : float
        Reprojection error of both with one relative pose.
    views : list of BoardView
        The views used, with `left_from_board` (n, 4, 4) and `view_rms_px` (n, 2) in the same order.
    rejected : dict
        Reason by name of each view left out.
    square_mm : (float, float)
        Mean and standard deviation of the triangulated squares.
    covariance : PairCovariance
        Of the cameras' parameters.
    left_out : LeftOut
        Each view as seen by cameras calibrated without it; empty with fewer than five views.
    """

    left: Camera
    right: Camera
    image_size_px: tuple[int, int]
    left_rms_px: float
    right_rms_px: float
    stereo_rms_px: float
    views: list[BoardView]
    left_from_board: NDArray[np.float64]
    view_rms_px: NDArray[np.float64]
    rejected: dict[str, str]
    square_mm: tuple[float, float]
    covariance: PairCovariance
    left_out: LeftOut

    @property
    def baseline_mm(self) -> float:
        """Distance of the optical centres."""
        return float(np.linalg.norm(self.right.centre_mm - self.left.centre_mm))


def find_views(
    left_images: Sequence[Frame], right_images: Sequence[Frame], names: Sequence[str], board: CalibrationBoard
) -> tuple[list[BoardView], dict[str, str]]:
    """Detect the board in pairs of images; the reasons by name where that fails or the view is blurred."""
    rejected: dict[str, str] = {}
    seen: dict[str, tuple[Corners, Corners]] = {}
    for name, left, right in zip(names, left_images, right_images, strict=True):
        corners = board.find(left), board.find(right)
        missing = " and ".join(side for side, c in zip(("left", "right"), corners, strict=True) if c is None)
        if corners[0] is None or corners[1] is None:
            rejected[name] = f"no {board.name} in the {missing} image"
        else:
            seen[name] = corners[0], corners[1]
    sharp_px = [_typical([pair[side].blur_px for pair in seen.values()]) for side in (0, 1)]
    views: list[BoardView] = []
    for name, pair in seen.items():
        reason = _flaw(pair, sharp_px)
        view = _common(name, pair)
        if reason is None and view.left_px.shape[0] < MIN_COMMON:
            reason = f"the cameras see only {len(view.left_px)} of the same corners, needs {MIN_COMMON}"
        if reason is None:
            views.append(view)
        else:
            rejected[name] = reason
    return views, rejected


def _typical(blurs_px: Sequence[float]) -> float:
    finite = [blur for blur in blurs_px if np.isfinite(blur)]
    return float(np.median(finite)) if finite else 0.0


def _flaw(pair: tuple[Corners, Corners], sharp_px: Sequence[float]) -> str | None:
    for side, corners, typical_px in zip(("left", "right"), pair, sharp_px, strict=True):
        if corners.fitted < MIN_FITTED:
            return (
                f"only {corners.fitted:.0%} of the corners in the {side} image look like corners of the print: "
                "moved, covered or badly lit?"
            )
        if corners.blur_px > max(BLUR_FLOOR_PX, BLUR_RATIO * typical_px):
            return f"the {side} image is blurred by {corners.blur_px:.1f} px, the others by {typical_px:.1f} px"
    return None


def _common(name: str, pair: tuple[Corners, Corners]) -> BoardView:
    which, in_left, in_right = np.intersect1d(pair[0].which, pair[1].which, return_indices=True)
    return BoardView(name, pair[0].points_px[in_left], pair[1].points_px[in_right], which)


def calibrate_cameras(
    left_images: Sequence[Frame],
    right_images: Sequence[Frame],
    pattern: tuple[int, int] | CalibrationBoard = (9, 6),
    square_mm: float = 20.0,
    names: Sequence[str] | None = None,
) -> CameraPair:
    """Calibrate both cameras from pairs of board images.

    Parameters
    ----------
    left_images, right_images : sequences of (rows, columns) uint8
        Taken at the same time, one pair a board pose.
    pattern : (int, int) or CalibrationBoard
        Inner corners of a chessboard along its x and y; or a board of another kind, which knows its own size.
    square_mm : float
        Size of a chessboard's square.
    names : sequence of str, optional
        Names of the pairs for the report; numbers by default.

    Returns
    -------
    CameraPair

    Raises
    ------
    CalibrationRejectedError
        If fewer than four views remain, the reason of each view left out in the message; or if the calibration does
        not hold for views left out in turn.

    Notes
    -----
    Each camera is calibrated alone first (five distortion coefficients, k3 only if the views determine it), then
    both together from there. Blurred views, and views that cameras calibrated without them miss by far, are left
    out, named, and the rest is calibrated again.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", doi:10.1109/34.888718; the paper's 2.1.
    """
    names = names if names is not None else [str(i) for i in range(len(left_images))]
    board = Pattern(*pattern, square_mm) if isinstance(pattern, tuple) else pattern
    sizes = {image.shape for image in (*left_images, *right_images)}
    if len(sizes) > 1:
        raise CalibrationRejectedError(f"calibrate cameras: images of different sizes: {sorted(sizes)}")
    views, rejected = find_views(left_images, right_images, names, board)
    size_px = (left_images[0].shape[1], left_images[0].shape[0]) if views else (0, 0)
    return calibrate_views(views, board, size_px, rejected)


def calibrate_views(
    views: Sequence[BoardView],
    board: CalibrationBoard,
    image_size_px: tuple[int, int],
    rejected: dict[str, str] | None = None,
) -> CameraPair:
    """Calibrate both cameras from detected corners; see `calibrate_cameras`."""
    rejected = dict(rejected or {})
    used = list(views)
    while True:
        if len(used) < MIN_VIEWS:
            reasons = "; ".join(f"{name}: {why}" for name, why in rejected.items())
            raise CalibrationRejectedError(
                f"calibrate cameras: {len(used)} usable views of the board, needs {MIN_VIEWS}: "
                f"take more, tilted and over the whole field ({reasons or 'none was given'})"
            )
        found = solve(used, board, image_size_px)
        bad = _worst(found, used, board, image_size_px)
        if bad is None:
            break
        k, reason = bad
        rejected[used[k].name] = reason
        del used[k]
    covariance = pair_covariance(found, used, board)
    require_determined(found, covariance)
    left_out = leave_one_out(found, used, board, image_size_px)
    require_accepted(left_out, board.square_mm)
    return CameraPair(
        found.left,
        found.right,
        image_size_px,
        *found.rms_px,
        used,
        found.left_from_board,
        found.view_rms_px,
        rejected,
        _squares(found, used, board),
        covariance,
        left_out,
    )


def _worst(
    found: PairSolution, views: Sequence[BoardView], board: CalibrationBoard, size_px: tuple[int, int]
) -> tuple[int, str] | None:
    """Number of the view to leave out, and why; None if all are fit for use."""
    residual_px = found.view_rms_px.max(axis=1)  # (views,)
    typical_px = float(np.median(residual_px))
    limit_px = max(OUTLIER_FLOOR_PX, OUTLIER_RATIO * typical_px)
    suspects = [int(k) for k in np.argsort(-residual_px)[:SUSPECTS] if residual_px[k] > SUSPECT_RATIO * typical_px]
    missed_px: dict[int, float] = {}
    for k in suspects:
        missed_px[k] = float(residual_px[k])
        if len(views) > MIN_VIEWS:
            without = solve_from(found, [v for i, v in enumerate(views) if i != k], board, size_px)
            cameras = without.left, without.right
            missed_px[k] = float(fit_pose(cameras, views[k], board, found.left_from_board[k])[1].max())
    worst = max(missed_px, key=missed_px.__getitem__, default=None)
    if worst is None or missed_px[worst] <= limit_px:
        return None
    return worst, (
        f"residual {missed_px[worst]:.2f} px in cameras calibrated without it, the other views have {typical_px:.2f} px"
    )


def _squares(found: PairSolution, views: Sequence[BoardView], board: CalibrationBoard) -> tuple[float, float]:
    """Mean and standard deviation of the distances of neighbouring corners, triangulated."""
    sides: list[NDArray[np.float64]] = []
    for view in views:
        points = np.full((len(board.corners_mm), 3), np.nan)
        points[slice(None) if view.which is None else view.which] = measure_board(found.left, found.right, view)
        side = np.linalg.norm(points[board.neighbours[:, 0]] - points[board.neighbours[:, 1]], axis=1)
        sides.append(side[np.isfinite(side)])
    measured = np.concatenate(sides)
    return float(measured.mean()), float(measured.std())
