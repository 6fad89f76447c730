"""Everything that a scan's map is made of, gathered record by record in any order."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume_messages.bus import Message
from echolume_messages.calibration import Calibration
from echolume_messages.errors import CalibrationMissingError
from echolume_messages.plan import Plan
from echolume_messages.types import OPTICAL_POINT, ULTRASONIC_POINT, OpticalSource, Structured
from echolume_processing.ping import Ping
from echolume_processing.review import Review


class ScanStart(msgspec.Struct):
    """What ``conductor/start`` says; further fields are for others."""

    scan: str
    plan: Plan
    calibration: Calibration | None = None
    rig: str = ""
    utc_offset_ns: int = 0
    """Of the record itself: wall clock minus monotonic clock."""


def read_start(message: Message) -> ScanStart:
    """Scan, plan and calibration from a ``conductor/start`` record.

    Raises
    ------
    CalibrationMissingError
        If it holds a calibration that cannot be read, or a plan that is none.
    """
    try:
        start = msgspec.json.decode(message.payload.tobytes(), type=ScanStart)
    except msgspec.DecodeError as error:
        raise CalibrationMissingError(
            f"conductor/start of scan {message.header.scan!r}: {error}; it was made by another version"
        ) from error
    start.utc_offset_ns = message.header.t_wall_ns - message.header.t_ns
    return start


@dataclass
class Evidence:
    """Points and pings by trigger; of a trigger acquired twice the later attempt counts.

    The map rests on these alone; `review` is for whoever looks at the recording.
    """

    scan: str
    plan: Plan
    calibration: Calibration
    optical: dict[int, tuple[int, Structured]] = field(default_factory=dict[int, tuple[int, Structured]])
    pings: dict[int, tuple[int, Ping]] = field(default_factory=dict[int, tuple[int, Ping]])
    ultrasonic: dict[int, tuple[int, Structured]] = field(default_factory=dict[int, tuple[int, Structured]])
    review: Review = field(init=False)

    def __post_init__(self) -> None:
        self.review = Review.of(self.plan, self.calibration)

    @classmethod
    def of(cls, start: ScanStart, calibration: Calibration) -> Evidence:
        """Evidence of a scan that has begun, without any yet."""
        found = cls(start.scan, start.plan, calibration)
        found.review.utc_offset_ns = start.utc_offset_ns
        return found

    def add_optical(self, trigger: int, attempt: int, points: Structured) -> bool:
        """Points of one stripe; whether they count, no later attempt having come."""
        counts = attempt >= self.optical.get(trigger, (-1, points))[0]
        if counts:
            self.optical[trigger] = (attempt, points)
        return counts

    def add_ping(self, trigger: int, attempt: int, ping: Ping) -> bool:
        """Raw echoes of one ping; whether they count, no later attempt having come."""
        counts = attempt >= self.pings.get(trigger, (-1, ping))[0]
        if counts:
            self.pings[trigger] = (attempt, ping)
        return counts

    def add_ultrasonic(self, trigger: int, attempt: int, points: Structured) -> None:
        """Contact points of one ping."""
        if attempt >= self.ultrasonic.get(trigger, (-1, points))[0]:
            self.ultrasonic[trigger] = (attempt, points)

    def all_optical(self) -> Structured:
        """Optical points (n,) sorted by trigger."""
        return _joined((self.optical[k][1] for k in sorted(self.optical)), OPTICAL_POINT)

    def optical_triggers(self) -> NDArray[np.uint32]:
        """Trigger of the stripe that each of `all_optical` is of (n,)."""
        return _triggers(self.optical)

    def all_ultrasonic(self) -> Structured:
        """Contact points (n,) sorted by trigger."""
        return _joined((self.ultrasonic[k][1] for k in sorted(self.ultrasonic)), ULTRASONIC_POINT)

    def ultrasonic_triggers(self) -> NDArray[np.uint32]:
        """Trigger of the ping that each of `all_ultrasonic` is of (n,)."""
        return _triggers(self.ultrasonic)

    def all_pings(self) -> list[Ping]:
        """Pings sorted by trigger."""
        return [self.pings[k][1] for k in sorted(self.pings)]

    def counts(self) -> dict[str, int]:
        """Points of each set."""
        source = self.all_optical()["source"]
        return {
            "stereo": int((source == OpticalSource.STEREO).sum()),
            "active_left": int((source == OpticalSource.ACTIVE_LEFT).sum()),
            "active_right": int((source == OpticalSource.ACTIVE_RIGHT).sum()),
            "ultrasonic": int(self.all_ultrasonic().size),
        }


def _triggers(parts: Mapping[int, tuple[int, Structured]]) -> NDArray[np.uint32]:
    """Triggers of parts, each as often as it has points."""
    keys = np.array(sorted(parts), dtype=np.uint32)
    return np.repeat(keys, [parts[int(k)][1].size for k in keys])


def _joined(parts: Iterable[Structured], dtype: np.dtype[np.void]) -> Structured:
    found = list(parts)
    return np.concatenate(found) if found else np.zeros(0, dtype=dtype)
