"""Calibration of cameras and laser from the archive of a calibration scan (passes ``board-NN`` and ``laser-NN``)."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np

from echolume_messages import topics
from echolume_messages.bus.message import Message
from echolume_messages.calibration import CameraCalibration, LaserCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.types import Frame
from echolume_processing.optical import rig_frame
from echolume_processing.optical.align import plane_alignment
from echolume_processing.optical.board import Pattern
from echolume_processing.optical.calibrate import CameraPair, calibrate_cameras
from echolume_processing.optical.calibration_shots import BOARD, LASER, CalibrationShots, LitShot
from echolume_processing.optical.laser import LaserFit, StripeOnBoard, fit_laser, stripe_on_board

RIG_BOARD = Pattern(9, 6, 20.0)
"""The board that belongs to the rig."""


class OpticsReport(msgspec.Struct, kw_only=True):
    """Figures of a calibration of cameras and laser."""

    views: list[str]
    rejected: dict[str, str]
    left_rms_px: float
    right_rms_px: float
    stereo_rms_px: float
    baseline_mm: float
    square_mean_mm: float
    square_sd_mm: float
    left_out_px: float
    """Views left out in turn: RMS reprojection error; nan with fewer than five."""
    left_out_mm: float
    camera_sigmas: dict[str, float]
    """Standard deviations of the cameras' parameters, by name with unit."""
    plane_rms_mm: float
    plane_leave_one_out_mm: float
    plane_field_sigma_mm: float
    plane_shared_mm: float
    """Standard deviation of the error that the points of one stripe share."""
    parallel_deg: float
    """Angle of the laser plane to YZ."""
    parallel_mm: float
    """By how much x varies over the field because of it."""
    stripes: int
    stripe_points: int
    turned: bool
    """The guide runs against the board's x: the rig frame was turned by half a turn."""


class OpticsCalibration(NamedTuple):
    """Calibrated cameras and laser, in the rig frame."""

    left: CameraCalibration
    right: CameraCalibration
    stereo_rms_px: float
    laser: LaserCalibration
    report: OpticsReport


def calibrate_optics(records: Iterable[Message] | Path, board: Pattern = RIG_BOARD) -> OpticsCalibration:
    """Calibrate cameras and laser from the records of a calibration scan.

    Parameters
    ----------
    records : iterable of Message, or Path
        Camera frames of the scan, or its archive. Passes ``board-00``, ``board-01``, ... show the board at one pose
        each, ``board-00`` flat in the jig; passes ``laser-00``, ... hold stripes on the board of the same number.
    board : Pattern
        The board used.

    Returns
    -------
    OpticsCalibration
        Left, right, stereo RMS, laser, report.

    Raises
    ------
    CalibrationRejectedError
        If views or stripes are missing or do not determine the calibration; the reason is in the message.
    """
    shots = CalibrationShots()
    for message in _frames(records) if isinstance(records, Path) else records:
        shots.take(message)
    return calibrate_shots(shots, board)


def calibrate_shots(shots: CalibrationShots, board: Pattern = RIG_BOARD) -> OpticsCalibration:
    """Calibrate cameras and laser from what has been gathered so far; see `calibrate_optics`."""
    boards, stripes = shots.by_pose()
    names = sorted(boards)
    if not names or not stripes:
        raise CalibrationRejectedError(
            f"calibrate: found {len(names)} passes `{BOARD}NN` and {len(stripes)} passes `{LASER}NN` with camera "
            "pairs: is this the archive of a calibration scan?"
        )
    images = [[_mean([pair[side] for pair in boards[name]]) for name in names] for side in (0, 1)]
    pair = calibrate_cameras(images[0], images[1], (board.columns, board.rows), board.square_mm, names)
    if f"{BOARD}00" not in [v.name for v in pair.views]:
        raise CalibrationRejectedError(
            f"calibrate: pose `{BOARD}00` defines the rig frame and cannot be left out: "
            f"{pair.rejected.get(f'{BOARD}00', 'the pass is missing')}"
        )
    return _in_rig_frame(pair, stripes, board)


def _in_rig_frame(pair: CameraPair, stripes: dict[str, list[LitShot]], board: Pattern) -> OpticsCalibration:
    poses = dict(zip((v.name.removeprefix(BOARD) for v in pair.views), pair.left_from_board, strict=True))
    rig_from_left = rig_frame.rig_from_jig(board) @ np.linalg.inv(poses["00"])
    cameras = rig_frame.moved(pair.left, rig_from_left), rig_frame.moved(pair.right, rig_from_left)
    on_boards = [
        StripeOnBoard(
            number,
            x_mm,
            np.concatenate(
                [stripe_on_board(c, s, rig_from_left @ pose, board) for c, s in zip(cameras, found, strict=True)]
            ),
        )
        for number, pose in poses.items()
        for x_mm, *found in stripes.get(number, [])
    ]
    fit = fit_laser(on_boards)
    turned = fit.calibration.guide_direction[0] < 0
    if turned:
        cameras = rig_frame.turned(cameras[0]), rig_frame.turned(cameras[1])
        half = rig_frame.HALF_TURN[:3, :3]
        fit = fit_laser([StripeOnBoard(s.board, s.x_mm, s.points_mm @ half) for s in on_boards])
    left = rig_frame.as_calibration(cameras[0], pair.image_size_px, pair.left_rms_px)
    right = rig_frame.as_calibration(cameras[1], pair.image_size_px, pair.right_rms_px)
    return OpticsCalibration(left, right, pair.stereo_rms_px, fit.calibration, _report(pair, fit, turned))


def _report(pair: CameraPair, fit: LaserFit, turned: bool) -> OpticsReport:
    parallel = plane_alignment(np.array(fit.calibration.normal))
    return OpticsReport(
        views=[v.name for v in pair.views],
        rejected=pair.rejected,
        left_rms_px=pair.left_rms_px,
        right_rms_px=pair.right_rms_px,
        stereo_rms_px=pair.stereo_rms_px,
        baseline_mm=pair.baseline_mm,
        square_mean_mm=pair.square_mm[0],
        square_sd_mm=pair.square_mm[1],
        left_out_px=pair.left_out.rms_px,
        left_out_mm=pair.left_out.rms_mm,
        camera_sigmas=pair.covariance.sigmas,
        plane_rms_mm=fit.calibration.rms_mm,
        plane_leave_one_out_mm=fit.leave_one_out_mm,
        plane_field_sigma_mm=fit.field_sigma_mm,
        plane_shared_mm=fit.shared_mm,
        parallel_deg=parallel.angle_deg,
        parallel_mm=parallel.over_field_mm,
        stripes=fit.stripes,
        stripe_points=fit.points,
        turned=turned,
    )


def _frames(path: Path) -> Iterable[Message]:
    from echolume_messages import archive  # only reading from a file needs mcap

    return archive.read(path, {topics.CAMERA_LEFT.name, topics.CAMERA_RIGHT.name})


def _mean(frames: list[Frame]) -> Frame:
    total = np.sum(np.stack(frames), axis=0, dtype=np.uint32)
    return np.asarray((total + len(frames) // 2) // len(frames), dtype=np.uint8)
