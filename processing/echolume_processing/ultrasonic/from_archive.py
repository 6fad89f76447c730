"""The array's calibration from the archive of a calibration scan."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from echolume_messages import archive, topics
from echolume_messages.bus.message import Message
from echolume_messages.calibration import CameraCalibration, LaserCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Points3
from echolume_messages.rig import ArraySettings
from echolume_messages.types import OpticalSource
from echolume_processing.optical.pipeline import OpticalPipeline
from echolume_processing.ping import Ping, ping_from_record
from echolume_processing.ultrasonic.calibrate import ArrayResult, calibrate_array

PLATE, BLOCK_LIGHT, BLOCK_SOUND = "plate", "block-light", "block-sound"
"""Names of the passes of the array's calibration."""


def read_pings(path: Path, pass_name: str) -> list[Ping]:
    """The pings of one pass by trigger, of each the last attempt.

    Raises
    ------
    CalibrationRejectedError
        If the archive has none.
    """
    latest: dict[int, Message] = {}
    for message in archive.read(path, {topics.ECHOES.name}):
        header = message.header
        before = latest.get(header.trigger)
        if header.pass_name == pass_name and (before is None or before.header.attempt <= header.attempt):
            latest[header.trigger] = message
    if not latest:
        raise CalibrationRejectedError(
            f"{path}: no pings of a pass {pass_name!r}; run the whole calibration plan (`calibrate-array.toml` has it)"
        )
    return [ping_from_record(latest[t].header, latest[t].payload.astype(np.int16, copy=False)) for t in sorted(latest)]


def read_block_points(
    path: Path, left: CameraCalibration, right: CameraCalibration, laser: LaserCalibration
) -> Points3:
    """What both cameras see of the block in the pass ``block-light``, (n, 3) mm in the rig frame."""
    pipeline = OpticalPipeline.of(left, right, laser)
    halves: dict[tuple[int, int], Message] = {}
    stripes: dict[int, Points3] = {}
    for message in archive.read(path, {topics.CAMERA_LEFT.name, topics.CAMERA_RIGHT.name}):
        header = message.header
        if header.pass_name != BLOCK_LIGHT or header.source.x_mm is None:
            continue
        other = halves.pop((header.trigger, header.attempt), None)
        if other is None:
            halves[header.trigger, header.attempt] = message
            continue
        pair = (message, other) if message.topic == topics.CAMERA_LEFT else (other, message)
        frames = [np.asarray(half.payload, dtype=np.uint8) for half in pair]
        found = pipeline.process(frames[0], frames[1], header.source.x_mm)
        found = found[found["source"] == OpticalSource.STEREO]
        stripes[header.trigger] = np.column_stack([found[n] for n in ("x_mm", "y_mm", "z_mm")]).astype(np.float64)
    if not stripes:
        raise CalibrationRejectedError(
            f"{path}: no stripes of a pass {BLOCK_LIGHT!r}; run the whole calibration plan (`calibrate-array.toml` "
            "has it)"
        )
    return np.concatenate([stripes[trigger] for trigger in sorted(stripes)])


def calibrate_array_from_archive(
    path: Path,
    left: CameraCalibration,
    right: CameraCalibration,
    laser: LaserCalibration,
    settings: ArraySettings,
) -> ArrayResult:
    """Calibrate the array from the passes ``plate``, ``block-light`` and ``block-sound`` of an archive.

    Raises
    ------
    CalibrationRejectedError
        If a pass is missing, or the data leave something undetermined (named).
    """
    plate, block = read_pings(path, PLATE), read_pings(path, BLOCK_SOUND)
    return calibrate_array(plate, block, read_block_points(path, left, right, laser), settings)
