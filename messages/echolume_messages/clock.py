"""Time is injected: the system's clocks, and one for tests that jumps instead of waiting."""

from __future__ import annotations

import threading
import time
from typing import Protocol


class Clock(Protocol):
    """What a loop needs to know about time."""

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        ...

    def wall_ns(self) -> int:
        """Nanoseconds since 1970 (UTC); may jump."""
        ...

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Wait until `event` is set or `timeout_s` has passed; True if it is set."""
        ...


class SystemClock:
    """The machine's clocks."""

    def monotonic_ns(self) -> int:
        """CLOCK_MONOTONIC."""
        return time.monotonic_ns()

    def wall_ns(self) -> int:
        """Nanoseconds since 1970 (UTC)."""
        return time.time_ns()

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Wait until `event` is set or `timeout_s` has passed."""
        return event.wait(timeout_s)


class VirtualClock:
    """A clock whose `wait` returns at once, having moved the time on by what it would have waited."""

    def __init__(self, monotonic_ns: int = 0, wall_ns: int = 1_700_000_000_000_000_000) -> None:
        self._lock = threading.Lock()
        self._monotonic_ns = monotonic_ns
        self._wall_ns = wall_ns

    def monotonic_ns(self) -> int:
        """Virtual CLOCK_MONOTONIC."""
        with self._lock:
            return self._monotonic_ns

    def wall_ns(self) -> int:
        """Virtual wall clock."""
        with self._lock:
            return self._wall_ns

    def advance(self, seconds_s: float) -> None:
        """Move both clocks on."""
        step_ns = round(seconds_s * 1e9)
        with self._lock:
            self._monotonic_ns += step_ns
            self._wall_ns += step_ns

    def jump_wall(self, seconds_s: float) -> None:
        """Move the wall clock alone, as an administrator or NTP does."""
        with self._lock:
            self._wall_ns += round(seconds_s * 1e9)

    def wait(self, event: threading.Event, timeout_s: float) -> bool:
        """Move the time on by `timeout_s` unless `event` is set."""
        if not event.is_set():
            self.advance(timeout_s)
        return event.is_set()
