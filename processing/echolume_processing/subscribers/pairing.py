"""Joins the frames of both cameras by trigger, and lets neither camera run away from the other."""

from __future__ import annotations

import time
from collections.abc import Callable
from typing import Protocol

from echolume_messages.bus import Message

MAX_WAITING = 16
"""Frames of one camera that may wait for the other's; then only the other one is read."""
PATIENCE_S = 10.0
"""So long may the other camera's stream bring nothing before what waits for it is given up."""
Key = tuple[str, int, int]


class Frames(Protocol):
    """A subscription to one camera."""

    def get(self, timeout_s: float) -> Message | None:
        """The next frame."""
        ...

    @property
    def stats(self) -> dict[str, int]:
        """Counts, `lost` among them."""
        ...


class Pairs:
    """Left and right frames of the same scan, trigger and attempt.

    Each stream comes in its own order, but a refilled gap can hold one back while the other goes on. Reading always
    from the stream that is behind leaves the rest in the bounded queue of its subscription, which asks for it again.
    """

    def __init__(self, left: Frames, right: Frames, now_s: Callable[[], float] = time.monotonic) -> None:
        self._streams = (left, right)
        self._waiting: tuple[dict[Key, Message], dict[Key, Message]] = ({}, {})
        self._now_s = now_s
        self._moved_s = now_s()
        self.unpaired = 0

    @property
    def lost(self) -> int:
        """Frames of both cameras that did not come and could not be had again."""
        return sum(stream.stats["lost"] for stream in self._streams)

    def get(self, timeout_s: float) -> tuple[Message, Message] | None:
        """The next (left, right) pair, or None if one more frame did not complete any."""
        counts = [len(waiting) for waiting in self._waiting]
        side = 0 if counts[0] <= counts[1] else 1
        message = self._streams[side].get(timeout_s)
        if message is None and counts[1 - side] < MAX_WAITING:
            side = 1 - side
            message = self._streams[side].get(0.0)
        if message is None:
            if self._now_s() - self._moved_s > PATIENCE_S:
                self._forget(max(counts))
            return None
        self._moved_s = self._now_s()
        header = message.header
        key = header.scan, header.trigger, header.attempt
        if key not in self._waiting[1 - side]:
            self._waiting[side][key] = message
            return None
        other = self._take(1 - side, key)
        self.unpaired += len(self._waiting[side])
        self._waiting[side].clear()
        return (message, other) if side == 0 else (other, message)

    def _take(self, side: int, key: Key) -> Message:
        """Take a frame out of those that wait; the older ones will find no partner any more."""
        waiting = self._waiting[side]
        while (oldest := next(iter(waiting))) != key:
            del waiting[oldest]
            self.unpaired += 1
        return waiting.pop(key)

    def _forget(self, count: int) -> None:
        """Give up what waits in vain."""
        if count:
            self.unpaired += sum(len(waiting) for waiting in self._waiting)
            for waiting in self._waiting:
                waiting.clear()
        self._moved_s = self._now_s()
