"""Least-squares solution of two cameras from views of a board, with the same bits each time."""

from __future__ import annotations

from collections.abc import Generator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages import geometry
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, Points3
from echolume_processing.optical.board import CalibrationBoard, Points2
from echolume_processing.optical.camera import Camera

Values = NDArray[np.float64]

K3_SIGMAS = 3.0
"""k3 is held at 0 unless it stands out from its own sigma: otherwise it only bends the image beyond the boards."""
CRITERIA = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 100, 1e-7)
POSE_ROUNDS = 20
ADVICE = "tilt the board by 15 degrees or more, each time to another side"


@dataclass(frozen=True)
class BoardView:
    """Corners of one board pose in both images.

    Attributes
    ----------
    name : str
        For the report.
    left_px, right_px : (n, 2) float64
    which : (n,) int64, optional
        Which of the board's corners these are; all of them by default.
    """

    name: str
    left_px: Points2
    right_px: Points2
    which: NDArray[np.int64] | None = None

    def shape_mm(self, board: CalibrationBoard) -> Points3:
        """The corners (n, 3) in the board frame."""
        return board.corners_mm if self.which is None else board.corners_mm[self.which]


@dataclass(frozen=True)
class PairSolution:
    """Two cameras in the frame of the left one, the boards' poses in it, and what is left over."""

    left: Camera
    right: Camera
    rms_px: tuple[float, float, float]
    """Of the left camera alone, of the right one alone, of both with one relative pose."""
    left_from_board: NDArray[np.float64]
    view_rms_px: NDArray[np.float64]
    third_radial: bool
    """Whether k3 was free."""


@contextmanager
def solving() -> Generator[None]:
    """One thread, and a reason where OpenCV gives up.

    OpenCV's threads add up in any order, so the last bits of a solution would differ from run to run.
    """
    before = cv2.getNumThreads()
    cv2.setNumThreads(1)
    try:
        yield
    except (cv2.error, np.linalg.LinAlgError) as error:
        raise CalibrationRejectedError(
            f"calibrate cameras: rejected: the views do not determine the cameras ({error}): {ADVICE}"
        ) from error
    finally:
        cv2.setNumThreads(before)


def solve(views: Sequence[BoardView], board: CalibrationBoard, size_px: tuple[int, int]) -> PairSolution:
    """Each camera alone first, then both together from there.

    Parameters
    ----------
    views : sequence of BoardView
    board : CalibrationBoard
    size_px : (int, int)
        Columns and rows of the images.
    """
    with solving():
        shape, left, right = _arrays(views, board)
        free = [cv2.calibrateCameraExtended(shape, px, size_px, np.eye(3), np.zeros(5)) for px in (left, right)]
        third = max(abs(_vector(f[2])[4]) / _vector(f[5])[8] for f in free) > K3_SIGMAS  # |k3| over its sigma
        if third:
            alone = [(float(f[0]), f[1], f[2]) for f in free]
        else:
            fixed = cv2.CALIB_FIX_K3
            again = [
                cv2.calibrateCamera(shape, px, size_px, np.eye(3), np.zeros(5), flags=fixed) for px in (left, right)
            ]
            alone = [(float(f[0]), f[1], f[2]) for f in again]
        start = (*alone[0][1:], *alone[1][1:])
        return _together(shape, left, right, start, size_px, third, (alone[0][0], alone[1][0]))


def solve_from(
    start: PairSolution, views: Sequence[BoardView], board: CalibrationBoard, size_px: tuple[int, int]
) -> PairSolution:
    """The solution for other views of the same cameras, quicker than `solve` as it begins near the answer."""
    with solving():
        cameras = start.left.matrix, start.left.distortion, start.right.matrix, start.right.distortion
        nan = float("nan")
        return _together(*_arrays(views, board), cameras, size_px, start.third_radial, (nan, nan))


def _arrays(
    views: Sequence[BoardView], board: CalibrationBoard
) -> tuple[list[NDArray[np.float32]], list[NDArray[np.float32]], list[NDArray[np.float32]]]:
    shape = [v.shape_mm(board).astype(np.float32) for v in views]
    return shape, [v.left_px.astype(np.float32) for v in views], [v.right_px.astype(np.float32) for v in views]


def _together(
    shape: Sequence[NDArray[np.float32]],
    left: Sequence[NDArray[np.float32]],
    right: Sequence[NDArray[np.float32]],
    start: tuple[object, object, object, object],
    size_px: tuple[int, int],
    third: bool,
    alone_px: tuple[float, float],
) -> PairSolution:
    k_l, d_l, k_r, d_r = (np.array(value, dtype=np.float64) for value in start)
    flags = cv2.CALIB_USE_INTRINSIC_GUESS | (0 if third else cv2.CALIB_FIX_K3)
    rms, k_l, d_l, k_r, d_r, rotation, shift, _, _, turns, shifts, per_view = cv2.stereoCalibrateExtended(
        shape, left, right, k_l, d_l, k_r, d_r, size_px, np.eye(3), np.zeros((3, 1)), flags=flags, criteria=CRITERIA
    )  # fmt: skip
    poses = [
        geometry.transform(geometry.rotation_from_vector(_vector(turn)), _vector(move))
        for turn, move in zip(turns, shifts, strict=True)
    ]
    right_from_left = geometry.transform(np.asarray(rotation, dtype=np.float64), _vector(shift))
    return PairSolution(
        Camera(np.asarray(k_l, dtype=np.float64), _vector(d_l)[:5], np.eye(4)),
        Camera(np.asarray(k_r, dtype=np.float64), _vector(d_r)[:5], right_from_left),
        (*alone_px, float(rms)),
        np.stack(poses),
        np.reshape(np.asarray(per_view, dtype=np.float64), (-1, 2)),
        third,
    )


def _vector(value: object) -> Values:
    return np.reshape(np.asarray(value, dtype=np.float64), -1)


def jacobian(camera: Camera, seen_mm: Points3) -> tuple[Points2, Values]:
    """Image (n, 2) of points in the camera's own frame, and its derivatives (2 n, 15).

    Notes
    -----
    Columns: a small rotation and shift of the points in the camera's frame (6), focal lengths and centre (4),
    distortion (5).
    """
    zero = np.zeros(3)
    pixels, derivative = cv2.projectPoints(seen_mm, zero, zero, camera.matrix, camera.distortion)
    columns = np.asarray(derivative, dtype=np.float64)[:, :15]
    return np.reshape(np.asarray(pixels, dtype=np.float64), (-1, 2)), columns


def adjoint(target_from_source: Matrix) -> Values:
    """A small rotation and shift in the target frame (6,) from one in the source frame: matrix (6, 6)."""
    rotation, (x, y, z) = target_from_source[:3, :3], target_from_source[:3, 3]
    skew = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    out[3:, :3] = skew @ rotation
    return out


def fit_pose(
    cameras: tuple[Camera, Camera], view: BoardView, board: CalibrationBoard, start: Matrix
) -> tuple[Matrix, NDArray[np.float64]]:
    """Pose of a board in the left camera's frame from both images, the cameras held fixed.

    Returns
    -------
    left_from_board : (4, 4)
    rms_px : (2,)
        What is left over in each camera.
    """
    shape = view.shape_mm(board)
    pose = start
    rms = np.zeros(2)
    for _ in range(POSE_ROUNDS):
        normal, right = np.zeros((6, 6)), np.zeros(6)
        for side, (camera, seen_px) in enumerate(zip(cameras, (view.left_px, view.right_px), strict=True)):
            pixels, columns = jacobian(camera, geometry.apply(camera.camera_from_rig @ pose, shape))
            j = columns[:, :6] @ adjoint(camera.camera_from_rig)
            residual = (seen_px - pixels).ravel()
            rms[side] = np.sqrt(np.mean(residual**2) * 2)
            normal += j.T @ j
            right += j.T @ residual
        with solving():
            step = np.asarray(np.linalg.solve(normal, right), dtype=np.float64)
        pose = geometry.transform(geometry.rotation_from_vector(step[:3]), step[3:]) @ pose
        if float(np.abs(step).max()) < 1e-9:
            break
    return pose, rms
