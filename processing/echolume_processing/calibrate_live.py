"""Calibration at the rig: frames come over the bus while a scan runs, and the operator is told what is missing."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Protocol

import numpy as np

from echolume_messages import topics
from echolume_messages.bus import Bus, Message
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.types import Frame
from echolume_processing.optical import stripe
from echolume_processing.optical.align import Alignment, stripe_alignment, stripe_points
from echolume_processing.optical.board import CalibrationBoard, Pattern
from echolume_processing.optical.calibrate import find_views
from echolume_processing.optical.calibrate_rig import OpticsCalibration, calibrate_shots
from echolume_processing.optical.calibration_shots import BOARD, CalibrationShots
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.coverage import Coverage
from echolume_processing.subscribers.pairing import Pairs

Say = Callable[[str], object]

STEP_S = 0.2
DEPTH = 64
IDLE_TURNS = 10
"""Turns without a pair after which the operator is taken to be moving the board. Only then is a calibration tried: it
takes seconds, and frames would have to wait."""
MIN_BOARDS = 4
"""Boards before a first trial of the laser's calibration."""


class PairSource(Protocol):
    """Camera pairs as they come."""

    def get(self, timeout_s: float) -> tuple[Message, Message] | None:
        """The next (left, right) pair, or None if there was none in time."""
        ...


def camera_pairs(bus: Bus) -> Pairs:
    """Both cameras of a rig; the bus ends the subscriptions."""
    # Not the recorder's archive too: frames of an earlier scan may show cameras that stood otherwise.
    left, right = (
        bus.subscribe([topic], depth=DEPTH, archive=False) for topic in (topics.CAMERA_LEFT, topics.CAMERA_RIGHT)
    )
    return Pairs(left, right)


def gather_views(
    pairs: PairSource,
    board: CalibrationBoard,
    say: Say,
    stop: threading.Event,
    keep: Callable[[int, Frame, Frame], object] | None = None,
) -> Coverage | None:
    """Take views of the board until field and tilts are covered, or until stopped.

    Parameters
    ----------
    pairs : PairSource
        Frames taken with the laser on are passed over.
    board : CalibrationBoard
    say : callable
        Told in one line what each view brought and what is missing.
    stop : Event
        Ends the session with what it has.
    keep : callable, optional
        Handed number, left and right image of each view taken.

    Returns
    -------
    Coverage or None
        None if no pair with the board came.
    """
    coverage: Coverage | None = None
    while not stop.is_set():
        pair = pairs.get(STEP_S)
        if pair is None or pair[0].header.source.laser_on:
            continue
        frames = [np.asarray(message.payload, dtype=np.uint8) for message in pair]
        number = len(coverage.views) + 1 if coverage is not None else 1
        views, rejected = find_views([frames[0]], [frames[1]], [f"{number:02d}"], board)
        if not views:
            say(f"not taken: {'; '.join(rejected.values())}")
            continue
        if coverage is None:
            coverage = Coverage(board, (frames[0].shape[1], frames[0].shape[0]))
        if not coverage.add(views[0]):
            say("not taken: the board has not moved since a view that was taken before")
            continue
        if keep is not None:
            keep(number, frames[0], frames[1])
        missing = coverage.missing
        say(f"view {number} taken; " + (f"missing: {'; '.join(missing)}" if missing else "all is covered"))
        if not missing:
            break
    return coverage


class LedgerEnd:
    """Whether the scan whose frames are taken has ended."""

    def __init__(self, bus: Bus) -> None:
        self._ledgers = bus.subscribe([topics.LEDGER], depth=16, refill=False)
        self._ended: set[str] = set()

    def __call__(self, scan: str) -> bool:
        """Whether a final ledger of the scan has come."""
        while (message := self._ledgers.get(0.0)) is not None:
            content = message.json()
            if isinstance(content, dict) and content.get("final") is True:
                self._ended.add(message.header.scan or str(content.get("scan")))
        return scan in self._ended


def gather_optics(
    pairs: PairSource,
    board: Pattern,
    say: Say,
    stop: threading.Event,
    ended: Callable[[str], bool] = lambda _scan: False,
    keep: Callable[[Message, Message], object] | None = None,
) -> OpticsCalibration:
    """Calibrate cameras and laser from the passes of a running calibration scan.

    Parameters
    ----------
    pairs : PairSource
        Passes as `calibrate_optics` takes them. When another scan begins, what there was is forgotten.
    board : Pattern
    say : callable
        Told of each board, and in the pauses what a calibration from the boards so far lacks.
    stop : Event
        Ends the session with what it has.
    ended : callable, optional
        Whether the scan of that name has ended, after which nothing more will come.
    keep : callable, optional
        Handed the left and right frame of each pair that is used.

    Raises
    ------
    CalibrationRejectedError
        If what there is at the end does not make a calibration.
    """
    shots, scan, on_board, idle, fresh = CalibrationShots(), "", "", 0, False
    while not stop.is_set():
        pair = pairs.get(STEP_S)
        if pair is None:
            idle += 1
            if scan and ended(scan):
                break
            if fresh and idle >= IDLE_TURNS:
                say(f"{on_board}: {_lacks(shots, board)}")
                fresh = False
            continue
        idle = 0
        header = pair[0].header
        if header.scan != scan:
            shots, scan, on_board = CalibrationShots(), header.scan, ""
            say(f"scan {scan}")
        if header.pass_name.startswith(BOARD) and header.pass_name != on_board:
            on_board = header.pass_name
            say(f"{on_board}: taken")
        taken = [shots.take(message) for message in pair]
        if any(taken):
            fresh = True
            if keep is not None:
                keep(*pair)
    return calibrate_shots(shots, board)


def _lacks(shots: CalibrationShots, board: Pattern) -> str:
    boards = len(shots.by_pose()[0])
    if boards < MIN_BOARDS:
        return f"taken; {MIN_BOARDS - boards} more boards for a first trial"
    try:
        report = calibrate_shots(shots, board).report
    except CalibrationRejectedError as error:
        return str(error)
    left_out = "".join(f"; {name} left out: {why}" for name, why in report.rejected.items())
    return (
        f"would do: stereo {report.stereo_rms_px:.3f} px, plane {report.plane_rms_mm:.3f} mm, "
        f"known in the field to {report.plane_field_sigma_mm:.3f} mm{left_out}"
    )


def watch_alignment(
    pairs: PairSource,
    cameras: tuple[Camera, Camera],
    say: Say,
    stop: threading.Event,
    stripes: int | None = None,
) -> Alignment | None:
    """Say for each stripe how far the laser plane is from parallel to YZ.

    Parameters
    ----------
    pairs : PairSource
        Frames taken with the laser off are passed over.
    cameras : (Camera, Camera)
        Left and right, calibrated.
    say : callable
        Told one line a stripe.
    stop : Event
        Ends the watch.
    stripes : int, optional
        Ends the watch after so many stripes.

    Returns
    -------
    Alignment or None
        The last one; None if there was none.
    """
    last: Alignment | None = None
    seen = 0
    while not stop.is_set() and (stripes is None or seen < stripes):
        pair = pairs.get(STEP_S)
        if pair is None or pair[0].header.source.laser_on is False:
            continue
        seen += 1
        left, right = (stripe.extract(np.asarray(message.payload, dtype=np.uint8)) for message in pair)
        trigger = pair[0].header.trigger
        try:
            last = stripe_alignment(stripe_points(cameras, left, right))
        except CalibrationRejectedError as error:
            say(f"trigger {trigger}: {error}")
            continue
        say(f"trigger {trigger}: {last.text}")
    return last
