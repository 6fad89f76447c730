"""Where the cameras stand: board pose 0, flat in its jig, defines the rig frame."""

from __future__ import annotations

import numpy as np

from echolume_messages import geometry
from echolume_messages.calibration import CameraCalibration
from echolume_messages.geometry import Matrix
from echolume_processing.optical.board import Pattern
from echolume_processing.optical.camera import Camera

HALF_TURN = np.diag([-1.0, -1.0, 1.0, 1.0])


def rig_from_jig(board: Pattern) -> Matrix:
    """``rig_from_board`` of pose 0: x and y along the rig's, the corner grid centred on the origin, z = 0."""
    out = np.eye(4)
    out[0, 3] = -(board.columns - 1) * board.square_mm / 2
    out[1, 3] = -(board.rows - 1) * board.square_mm / 2
    return out


def turned(camera: Camera) -> Camera:
    """The camera in a rig frame turned by half a turn about z."""
    return Camera(camera.matrix, camera.distortion, camera.camera_from_rig @ HALF_TURN)


def moved(camera: Camera, rig_from_old: Matrix) -> Camera:
    """The camera with its pose given in the rig frame instead of the old one."""
    return Camera(camera.matrix, camera.distortion, camera.camera_from_rig @ geometry.invert(rig_from_old))


def as_calibration(camera: Camera, size_px: tuple[int, int], rms_px: float) -> CameraCalibration:
    """The camera as the calibration file holds it."""
    return CameraCalibration(
        width_px=size_px[0],
        height_px=size_px[1],
        camera_matrix=camera.matrix.tolist(),
        distortion=camera.distortion.tolist(),
        camera_from_rig=camera.camera_from_rig.tolist(),
        rms_px=rms_px,
    )
