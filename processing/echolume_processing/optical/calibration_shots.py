"""Camera pairs of a calibration scan, sorted into boards and stripes as they come."""

from __future__ import annotations

from typing import NamedTuple, TypeAlias

import numpy as np

from echolume_messages import topics
from echolume_messages.bus.message import Message
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.types import Frame
from echolume_processing.optical import stripe
from echolume_processing.optical.stripe import Stripe

BOARD, LASER = "board-", "laser-"

FramePair: TypeAlias = tuple[Frame, Frame]


class LitShot(NamedTuple):
    """A stripe in both cameras, and where the guide was."""

    x_mm: float
    left: Stripe
    right: Stripe


class CalibrationShots:
    """Pairs frames by trigger and attempt; a later attempt at a trigger replaces an earlier one.

    Only the stripes of lit frames are kept, not the frames.
    """

    def __init__(self) -> None:
        self._waiting: dict[tuple[int, int], dict[str, Message]] = {}
        self._best: dict[tuple[str, int], tuple[int, FramePair | LitShot]] = {}

    def take(self, message: Message) -> bool:
        """Take one record; True if it completed a pair of a board or laser pass."""
        header = message.header
        if not header.pass_name.startswith((BOARD, LASER)) or message.topic.service != topics.CAMERA_LEFT.service:
            return False
        pair = self._waiting.setdefault((header.trigger, header.attempt), {})
        pair[message.topic.name] = message
        if len(pair) < 2:
            return False
        del self._waiting[header.trigger, header.attempt]
        key = header.pass_name, header.trigger
        if key in self._best and self._best[key][0] > header.attempt:
            return False
        left, right = pair[topics.CAMERA_LEFT.name], pair[topics.CAMERA_RIGHT.name]
        frames = left.payload.astype(np.uint8, copy=False), right.payload.astype(np.uint8, copy=False)
        x_mm = None if header.pass_name.startswith(BOARD) else _guide_mm(left)
        self.add(header.pass_name, header.trigger, x_mm, frames, header.attempt)
        return True

    def add(self, pass_name: str, trigger: int, x_mm: float | None, frames: FramePair, attempt: int = 0) -> None:
        """Take a pair of images: of a board, or where the guide's position is given of the stripe on it."""
        shot = frames if x_mm is None else LitShot(x_mm, stripe.extract(frames[0]), stripe.extract(frames[1]))
        self._best[pass_name, trigger] = attempt, shot

    def by_pose(self) -> tuple[dict[str, list[FramePair]], dict[str, list[LitShot]]]:
        """Frame pairs by the name of their board pass, and stripes by the number of their laser pass."""
        boards: dict[str, list[FramePair]] = {}
        stripes: dict[str, list[LitShot]] = {}
        for (name, _), (_, shot) in sorted(self._best.items(), key=lambda item: item[0]):
            if isinstance(shot, LitShot):
                stripes.setdefault(name.removeprefix(LASER), []).append(shot)
            else:
                boards.setdefault(name, []).append(shot)
        return boards, stripes


def _guide_mm(message: Message) -> float:
    x_mm = message.header.source.x_mm
    if x_mm is None:
        raise CalibrationRejectedError(
            f"calibrate: pass {message.header.pass_name!r}, trigger {message.header.trigger}: the frame carries no "
            "guide position"
        )
    return x_mm
