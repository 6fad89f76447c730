"""What only a reviewer needs of a scan: when and where each trigger was, a few raw frames, and what was reported."""

from __future__ import annotations

from dataclasses import dataclass, field
from math import ceil

import cv2
import msgspec
import numpy as np

from echolume_messages import topics
from echolume_messages.bus import Message
from echolume_messages.calibration import Calibration
from echolume_messages.header import Header
from echolume_messages.plan import Plan, expand
from echolume_messages.types import Frame

JPEG_QUALITY = 75
MOST_PICTURES = 500
"""Pictures of each camera that a scan keeps; a longer plan keeps fewer of its triggers."""
MOST_LINES = 2000
"""Lines of the log that a scan keeps; a rig writes one where its state changes."""
REPORTS = (topics.RUN_STATE, topics.LEDGER)
SIDES = {topics.CAMERA_LEFT.name: "left", topics.CAMERA_RIGHT.name: "right"}


@dataclass(frozen=True)
class Moment:
    """When a trigger was, and where the guide stood."""

    attempt: int
    t_ns: int
    guide_x_mm: float | None


@dataclass(frozen=True)
class Picture:
    """A raw frame as JPEG."""

    attempt: int
    t_ns: int
    jpeg: bytes


@dataclass(frozen=True)
class Line:
    """A line of the log."""

    t_ns: int
    level: str
    text: str


class PassLedger(msgspec.Struct):
    """What the ledger says of a pass."""

    kind: str = ""
    planned: int = 0
    fired: int = 0
    matched: int = 0
    missing: int = 0


class Ledger(msgspec.Struct):
    """``conductor/ledger``; further fields are for others."""

    final: bool = False
    outcome: str = ""
    passes: dict[str, PassLedger] = msgspec.field(default_factory=dict[str, PassLedger])
    archive: str = ""


class RunState(msgspec.Struct):
    """``conductor/state`` without its counts, which change all the time."""

    state: str = ""
    pass_name: str = msgspec.field(name="pass", default="")
    prompt: str = ""
    error: str = ""


@dataclass
class Review:
    """Gathered beside the evidence, in any order and of bounded size; of a trigger's attempts the latest counts."""

    calibration: Calibration
    picture_every: int
    """Frames of triggers that this does not divide are let go."""
    utc_offset_ns: int | None = None
    """Added to a capture's monotonic time; one value a scan, so the wall clock's own steps leave no trace."""
    moments: dict[int, Moment] = field(default_factory=dict[int, Moment])
    pictures: dict[tuple[str, int], Picture] = field(default_factory=dict[tuple[str, int], Picture])
    """By side and trigger."""
    lines: list[Line] = field(default_factory=list[Line])
    ledger: Ledger | None = None
    _state: RunState = field(default_factory=RunState)

    @classmethod
    def of(cls, plan: Plan, calibration: Calibration) -> Review:
        """A review without anything in it yet."""
        optical = sum(step.guide_x_mm is not None for step in expand(plan))
        every = topics.CAMERA_LEFT.live_decimation
        return cls(calibration, every * max(1, ceil(optical / every / MOST_PICTURES)))

    def add_moment(self, header: Header) -> None:
        """When and where a trigger was, from the header of its left frame, its points, or its echoes."""
        found = self.moments.get(header.trigger)
        if found is None or header.attempt >= found.attempt:
            self.moments[header.trigger] = Moment(header.attempt, header.t_ns, header.source.x_mm)

    def add_frame(self, message: Message) -> bool:
        """Keep a frame if it is its trigger's turn and it is of the calibrated size; whether it was kept."""
        header, side = message.header, SIDES[message.topic.name]
        camera = self.calibration.left if side == "left" else self.calibration.right
        wanted = header.trigger >= 0 and header.trigger % self.picture_every == 0
        if not wanted or message.payload.shape != (camera.height_px, camera.width_px):
            return False
        found = self.pictures.get((side, header.trigger))
        if found is not None and header.attempt < found.attempt:
            return False
        pixels = jpeg(np.asarray(message.payload, dtype=np.uint8))
        self.pictures[side, header.trigger] = Picture(header.attempt, header.t_ns, pixels)
        return True

    def add_report(self, message: Message) -> None:
        """Run state or ledger, a line in the log where something changes."""
        try:
            if message.topic == topics.LEDGER:
                self._add_ledger(message.header.t_ns, msgspec.json.decode(message.payload.tobytes(), type=Ledger))
            else:
                self._add_state(message.header.t_ns, msgspec.json.decode(message.payload.tobytes(), type=RunState))
        except msgspec.DecodeError as error:
            self._say(message.header.t_ns, "WARN", f"{message.topic.name} seq {message.header.seq}: {error}")

    def _add_ledger(self, t_ns: int, ledger: Ledger) -> None:
        self.ledger = ledger
        counts = ", ".join(f"{name} {p.matched} of {p.planned}" for name, p in ledger.passes.items())
        complete = ledger.outcome == "complete" or not ledger.final
        outcome = ledger.outcome if ledger.final else "so far"
        self._say(t_ns, "INFO" if complete else "ERROR", f"ledger, {outcome}: matched {counts or 'nothing'}")

    def _add_state(self, t_ns: int, state: RunState) -> None:
        if state == self._state or (self.ledger is not None and self.ledger.final):
            return
        self._state = state
        parts = (state.state, state.pass_name and f"pass {state.pass_name}", state.prompt, state.error)
        self._say(t_ns, "ERROR" if state.error else "INFO", "; ".join(part for part in parts if part))

    def _say(self, t_ns: int, level: str, text: str) -> None:
        if len(self.lines) < MOST_LINES:
            self.lines.append(Line(t_ns, level, text))


def jpeg(frame: Frame) -> bytes:
    """A frame (rows, columns) uint8 as JPEG."""
    done, data = cv2.imencode(".jpg", frame, [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])
    if not done:
        raise ValueError(f"frame of shape {frame.shape}: cannot be written as JPEG")
    return data.tobytes()
