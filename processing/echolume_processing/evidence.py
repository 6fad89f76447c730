"""Everything that a scan's map is made of, gathered record by record in any order."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, field

import msgspec
import numpy as np

from echolume_messages.bus import Message
from echolume_messages.calibration import Calibration
from echolume_messages.errors import CalibrationMissingError
from echolume_messages.plan import Plan
from echolume_messages.types import OPTICAL_POINT, ULTRASONIC_POINT, OpticalSource, Structured
from echolume_processing.ping import Ping


class ScanStart(msgspec.Struct):
    """What ``conductor/start`` says; further fields are for others."""

    scan: str
    plan: Plan
    calibration: Calibration | None = None
    rig: str = ""


def read_start(message: Message) -> ScanStart:
    """Scan, plan and calibration from a ``conductor/start`` record.

    Raises
    ------
    CalibrationMissingError
        If it holds a calibration that cannot be read, or a plan that is none.
    """
    try:
        return msgspec.json.decode(message.payload.tobytes(), type=ScanStart)
    except msgspec.DecodeError as error:
        raise CalibrationMissingError(
            f"conductor/start of scan {message.header.scan!r}: {error}; it was made by another version"
        ) from error


@dataclass
class Evidence:
    """Points and pings by trigger; of a trigger acquired twice the later attempt counts."""

    scan: str
    plan: Plan
    calibration: Calibration
    optical: dict[int, tuple[int, Structured]] = field(default_factory=dict[int, tuple[int, Structured]])
    pings: dict[int, tuple[int, Ping]] = field(default_factory=dict[int, tuple[int, Ping]])
    ultrasonic: dict[int, tuple[int, Structured]] = field(default_factory=dict[int, tuple[int, Structured]])

    def add_optical(self, trigger: int, attempt: int, points: Structured) -> None:
        """Points of one stripe."""
        if attempt >= self.optical.get(trigger, (-1, points))[0]:
            self.optical[trigger] = (attempt, points)

    def add_ping(self, trigger: int, attempt: int, ping: Ping) -> None:
        """Raw echoes of one ping."""
        if attempt >= self.pings.get(trigger, (-1, ping))[0]:
            self.pings[trigger] = (attempt, ping)

    def add_ultrasonic(self, trigger: int, attempt: int, points: Structured) -> None:
        """Contact points of one ping."""
        if attempt >= self.ultrasonic.get(trigger, (-1, points))[0]:
            self.ultrasonic[trigger] = (attempt, points)

    def all_optical(self) -> Structured:
        """Optical points (n,) sorted by trigger."""
        return _joined((self.optical[k][1] for k in sorted(self.optical)), OPTICAL_POINT)

    def all_ultrasonic(self) -> Structured:
        """Contact points (n,) sorted by trigger."""
        return _joined((self.ultrasonic[k][1] for k in sorted(self.ultrasonic)), ULTRASONIC_POINT)

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


def _joined(parts: Iterable[Structured], dtype: np.dtype[np.void]) -> Structured:
    found = list(parts)
    return np.concatenate(found) if found else np.zeros(0, dtype=dtype)
