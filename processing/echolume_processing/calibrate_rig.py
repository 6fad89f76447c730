"""Calibrate a whole rig from the archive of one calibration scan: cameras, laser, array."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from echolume_messages import archive, topics
from echolume_messages.bus.message import Message
from echolume_messages.calibration import Calibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Points3
from echolume_messages.rig import ArraySettings
from echolume_messages.types import OpticalSource
from echolume_processing.optical.calibrate_rig import OpticsCalibration, calibrate_optics
from echolume_processing.optical.pipeline import OpticalPipeline
from echolume_processing.ping import Ping, ping_from_record
from echolume_processing.ultrasonic.calibrate import calibrate_array

PLATE, BLOCK_LIGHT, BLOCK_SOUND = "plate", "block-light", "block-sound"
"""Names of the passes of the array's calibration."""


def calibrate_rig(path: Path, rig: str, array: ArraySettings) -> tuple[Calibration, dict[str, Any]]:
    """Calibrate cameras, laser and array.

    Parameters
    ----------
    path
        Archive of a scan with the passes ``board-NN``, ``laser-NN``, ``plate``, ``block-light``, ``block-sound``.
    rig
        Name of the rig, which the calibration will belong to.
    array
        The array's nominal build.

    Returns
    -------
    Calibration
    dict
        Figures: RMS of cameras, laser and array, views kept and left out with their reasons.

    Raises
    ------
    CalibrationRejectedError
        The archive does not determine the calibration; the message names what is missing.
    """
    optics = calibrate_optics(path)
    result = calibrate_array(pings(path, PLATE), pings(path, BLOCK_SOUND), block_points(path, optics), array)
    calibration = Calibration(
        rig=rig,
        left=optics.left,
        right=optics.right,
        stereo_rms_px=optics.stereo_rms_px,
        laser=optics.laser,
        array=result.calibration,
    )
    figures = {
        "left_rms_px": optics.left.rms_px,
        "right_rms_px": optics.right.rms_px,
        "stereo_rms_px": optics.stereo_rms_px,
        "plane_rms_mm": optics.laser.rms_mm,
        "path_rms_mm": result.calibration.path_rms_mm,
        "views": len(optics.report.views),
        "views_left_out": optics.report.rejected,
        "pings_left_out": result.pings_rejected,
    }
    return calibration, figures


def pings(path: Path, pass_name: str) -> list[Ping]:
    """The pings of one pass, the last attempt of each trigger, by trigger."""
    latest: dict[int, Message] = {}
    for message in archive.read(path, {topics.ECHOES.name}):
        header = message.header
        if header.pass_name != pass_name:
            continue
        if header.trigger not in latest or latest[header.trigger].header.attempt <= header.attempt:
            latest[header.trigger] = message
    if not latest:
        raise CalibrationRejectedError(
            f"calibrate: {path} has no pings of a pass {pass_name!r}; run the whole calibration plan"
        )
    return [
        ping_from_record(latest[trigger].header, latest[trigger].payload.astype(np.int16, copy=False))
        for trigger in sorted(latest)
    ]


def block_points(path: Path, optics: OpticsCalibration) -> Points3:
    """What light sees of the block, from stripes of the pass ``block-light``, (n, 3) mm in the rig frame."""
    pipeline = OpticalPipeline.of(optics.left, optics.right, optics.laser)
    waiting: dict[tuple[int, int], dict[str, Message]] = {}
    stripes: dict[int, Points3] = {}
    for message in archive.read(path, {topics.CAMERA_LEFT.name, topics.CAMERA_RIGHT.name}):
        header = message.header
        x_mm = header.source.x_mm
        if header.pass_name != BLOCK_LIGHT or x_mm is None:
            continue
        pair = waiting.setdefault((header.trigger, header.attempt), {})
        pair[message.topic.name] = message
        if len(pair) == 2:
            left, right = (pair[t.name].payload.astype(np.uint8, copy=False) for t in topics.PASS_STREAMS["optical"])
            found = pipeline.process(left, right, x_mm)
            found = found[found["source"] == OpticalSource.STEREO]
            stripes[header.trigger] = np.column_stack([found[n] for n in ("x_mm", "y_mm", "z_mm")]).astype(np.float64)
            del waiting[header.trigger, header.attempt]
    if not stripes:
        raise CalibrationRejectedError(
            f"calibrate: {path} has no stripes of a pass {BLOCK_LIGHT!r}; run the whole calibration plan"
        )
    return np.concatenate([stripes[trigger] for trigger in sorted(stripes)])
