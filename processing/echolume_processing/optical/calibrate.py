"""Calibration of the two cameras from views of a chessboard: intrinsics, distortion, and their relative pose."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages import geometry
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix
from echolume_messages.types import Frame
from echolume_processing.optical import triangulate
from echolume_processing.optical.board import Pattern, Points2, find_corners
from echolume_processing.optical.camera import Camera

MIN_VIEWS = 4
OUTLIER_RATIO = 3.0
OUTLIER_FLOOR_PX = 0.5
"""A view is left out if its residual is above this and above OUTLIER_RATIO times the median view's."""
K3_SIGMAS = 3.0
"""k3 is held at 0 unless it stands out from its own sigma: otherwise it only bends the image beyond the boards."""


@dataclass(frozen=True)
class BoardView:
    """Corners (n, 2) of one board pose in both images, and the view's name."""

    name: str
    left_px: Points2
    right_px: Points2


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

    @property
    def baseline_mm(self) -> float:
        """Distance of the optical centres."""
        return float(np.linalg.norm(self.right.centre_mm - self.left.centre_mm))


@dataclass(frozen=True)
class _Solution:
    left: Camera
    right: Camera
    rms_px: tuple[float, float, float]
    left_from_board: NDArray[np.float64]
    view_rms_px: NDArray[np.float64]


def find_views(
    left_images: Sequence[Frame], right_images: Sequence[Frame], names: Sequence[str], pattern: Pattern
) -> tuple[list[BoardView], dict[str, str]]:
    """Detect the board in pairs of images; the reasons by name where that fails."""
    views: list[BoardView] = []
    rejected: dict[str, str] = {}
    for name, left, right in zip(names, left_images, right_images, strict=True):
        corners = find_corners(left, pattern), find_corners(right, pattern)
        missing = " and ".join(side for side, c in zip(("left", "right"), corners, strict=True) if c is None)
        if corners[0] is None or corners[1] is None:
            rejected[name] = f"no {pattern.columns}x{pattern.rows} corners in the {missing} image"
        else:
            views.append(BoardView(name, corners[0], corners[1]))
    return views, rejected


def calibrate_cameras(
    left_images: Sequence[Frame],
    right_images: Sequence[Frame],
    pattern: tuple[int, int] = (9, 6),
    square_mm: float = 20.0,
    names: Sequence[str] | None = None,
) -> CameraPair:
    """Calibrate both cameras from pairs of board images.

    Parameters
    ----------
    left_images, right_images : sequences of (rows, columns) uint8
        Taken at the same time, one pair a board pose.
    pattern : (int, int)
        Inner corners along the board's x and y.
    square_mm : float
        Size of a square.
    names : sequence of str, optional
        Names of the pairs for the report; numbers by default.

    Returns
    -------
    CameraPair

    Raises
    ------
    CalibrationRejectedError
        If fewer than four views remain; the reason of each view left out is in the message.

    Notes
    -----
    Each camera is calibrated alone first (five distortion coefficients, k3 only if the views determine it), then
    both together from there. Views whose
    residual stands out are left out, named, and the rest is calibrated again.

    References
    ----------
    Z. Zhang, "A flexible new technique for camera calibration", doi:10.1109/34.888718; the paper's 2.1.
    """
    names = names if names is not None else [str(i) for i in range(len(left_images))]
    board = Pattern(*pattern, square_mm)
    sizes = {image.shape for image in (*left_images, *right_images)}
    if len(sizes) > 1:
        raise CalibrationRejectedError(f"calibrate cameras: images of different sizes: {sorted(sizes)}")
    views, rejected = find_views(left_images, right_images, names, board)
    size_px = (left_images[0].shape[1], left_images[0].shape[0]) if views else (0, 0)
    return calibrate_views(views, board, size_px, rejected)


def calibrate_views(
    views: Sequence[BoardView], board: Pattern, image_size_px: tuple[int, int], rejected: dict[str, str] | None = None
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
        found = _solve(used, board, image_size_px)
        worst = found.view_rms_px.max(axis=1)  # (views,)
        limit_px = max(OUTLIER_FLOOR_PX, OUTLIER_RATIO * float(np.median(worst)))
        k = int(np.argmax(worst))
        if worst[k] <= limit_px:
            break
        rejected[used[k].name] = f"residual {worst[k]:.2f} px, the other views have {np.median(worst):.2f} px"
        del used[k]
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
    )


@contextmanager
def _one_thread() -> Generator[None]:
    """OpenCV's threads add up in any order, so the last bits of a solution would differ from run to run."""
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    finally:
        cv2.setNumThreads(before)


def _solve(views: Sequence[BoardView], board: Pattern, size_px: tuple[int, int]) -> _Solution:
    with _one_thread():
        return _solve_in_order(views, board, size_px)


def _solve_in_order(views: Sequence[BoardView], board: Pattern, size_px: tuple[int, int]) -> _Solution:
    shape = [board.corners_mm.astype(np.float32)] * len(views)
    left = [v.left_px.astype(np.float32) for v in views]
    right = [v.right_px.astype(np.float32) for v in views]
    free = [cv2.calibrateCameraExtended(shape, px, size_px, np.eye(3), np.zeros(5)) for px in (left, right)]
    third = [abs(_vector(f[2])[4]) / _vector(f[5])[8] for f in free]  # |k3| over its sigma
    if max(third) > K3_SIGMAS:
        flags, alone = 0, [f[:3] for f in free]
    else:
        flags = cv2.CALIB_FIX_K3
        alone = [
            cv2.calibrateCamera(shape, px, size_px, np.eye(3), np.zeros(5), flags=flags)[:3] for px in (left, right)
        ]
    (rms_l, k_l, d_l), (rms_r, k_r, d_r) = alone
    rms, k_l, d_l, k_r, d_r, rotation, shift, _, _, turns, shifts, per_view = cv2.stereoCalibrateExtended(
        shape, left, right, k_l, d_l, k_r, d_r, size_px, np.eye(3), np.zeros((3, 1)),
        flags=flags | cv2.CALIB_USE_INTRINSIC_GUESS,
        criteria=(cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-7),
    )  # fmt: skip
    poses = [
        geometry.transform(geometry.rotation_from_vector(_vector(turn)), _vector(move))
        for turn, move in zip(turns, shifts, strict=True)
    ]
    return _Solution(
        Camera(np.asarray(k_l, dtype=np.float64), _vector(d_l)[:5], np.eye(4)),
        Camera(
            np.asarray(k_r, dtype=np.float64),
            _vector(d_r)[:5],
            geometry.transform(np.asarray(rotation, dtype=np.float64), _vector(shift)),
        ),
        (float(rms_l), float(rms_r), float(rms)),
        np.stack(poses),
        np.reshape(np.asarray(per_view, dtype=np.float64), (-1, 2)),
    )


def _vector(value: object) -> NDArray[np.float64]:
    return np.reshape(np.asarray(value, dtype=np.float64), -1)


def measure_boards(left: Camera, right: Camera, views: Sequence[BoardView]) -> NDArray[np.float64]:
    """Corners (views, corners, 3) in mm, triangulated by eq. 1-2 in the frame of the cameras' poses."""
    m: tuple[Matrix, Matrix] = left.projection, right.projection
    return np.stack([triangulate.stereo(*m, left.undistort(v.left_px), right.undistort(v.right_px)) for v in views])


def _squares(found: _Solution, views: Sequence[BoardView], board: Pattern) -> tuple[float, float]:
    points = measure_boards(found.left, found.right, views).reshape(len(views), board.rows, board.columns, 3)
    sides = [np.linalg.norm(np.diff(points, axis=axis), axis=-1).ravel() for axis in (1, 2)]
    measured = np.concatenate(sides)
    return float(measured.mean()), float(measured.std())


def leave_one_out_mm(views: Sequence[BoardView], board: Pattern, image_size_px: tuple[int, int]) -> float:
    """RMS distance of corners from the board's true shape, each view measured by cameras calibrated without it.

    Parameters
    ----------
    views : sequence of BoardView
        At least five views.

    Returns
    -------
    float
        In mm, over all corners of all views.
    """
    squares: list[float] = []
    for k, view in enumerate(views):
        found = _solve([v for i, v in enumerate(views) if i != k], board, image_size_px)
        points = measure_boards(found.left, found.right, [view])[0]
        squares.append(float(np.mean(np.sum((points - rigid_fit(board.corners_mm, points)) ** 2, axis=1))))
    return float(np.sqrt(np.mean(squares)))


def rigid_fit(shape: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """`shape` (n, 3) moved rigidly onto `points` (n, 3) by least squares (Kabsch)."""
    centre, target = shape.mean(axis=0), points.mean(axis=0)
    u, _, vt = np.linalg.svd((points - target).T @ (shape - centre))
    rotation = u @ np.diag([1.0, 1.0, np.sign(np.linalg.det(u @ vt))]) @ vt
    return (shape - centre) @ rotation.T + target
