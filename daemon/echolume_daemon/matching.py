"""Which trigger a camera frame belongs to: frame ids advance by one for each pulse of the trigger unit.

Nothing is ever shifted to make the numbers fit: a frame that does not come makes its trigger missing for this stream,
a frame too many is counted, and when the ids turn out to be out of step, every frame matched since they were last
known to be in step is revoked.
"""

from __future__ import annotations

from collections import OrderedDict
from dataclasses import dataclass, field
from enum import StrEnum

_REMEMBERED = 256
_OVERTAKEN_S = 0.5
"""A frame that was overtaken by a later one has this long to arrive after all."""


@dataclass(frozen=True)
class Armed:
    """A trigger whose frame is awaited."""

    scan: str
    pulse: int
    """Count of the trigger unit after this pulse."""
    trigger: int
    pass_name: str
    attempt: int
    exposure_s: float
    laser_on: bool
    x_mm: float | None = None
    sigma_mm: float | None = None


class Verdict(StrEnum):
    """What a frame turned out to be."""

    MATCHED = "matched"
    DUPLICATE = "duplicate"
    EXTRA = "extra"


@dataclass
class FrameMatcher:
    """Matches the frames of one camera to armed triggers. Not thread-safe: its owner holds the lock."""

    _base: int | None = None
    """Frame id minus pulse."""
    _proven: bool = False
    _deadlines: OrderedDict[int, tuple[Armed, float]] = field(default_factory=OrderedDict[int, tuple[Armed, float]])
    _expired: OrderedDict[int, Armed] = field(default_factory=OrderedDict[int, Armed])
    _done: OrderedDict[int, None] = field(default_factory=OrderedDict[int, None])
    _unproven: list[Armed] = field(default_factory=list[Armed])
    _late: int = 0
    _slips: int = 0
    revoked: list[Armed] = field(default_factory=list[Armed])
    """Published under a trigger to which they may not belong; the owner takes them from here."""

    @property
    def outstanding(self) -> int:
        """Triggers whose frame is awaited."""
        return len(self._deadlines)

    @property
    def proven(self) -> bool:
        """Whether ids are known to be in step with pulses; if not, one trigger at a time."""
        return self._proven

    def arm(self, item: Armed, deadline_s: float) -> None:
        """Await the frame of a trigger until `deadline_s`."""
        self._deadlines[item.pulse] = (item, deadline_s)

    def withdraw(self, above_pulse: int) -> list[Armed]:
        """Take back triggers that were armed and never fired: those above the trigger unit's count."""
        gone = [item for item, _ in self._deadlines.values() if item.pulse > above_pulse]
        for item in gone:
            del self._deadlines[item.pulse]
        return gone

    def frame(self, frame_id: int, now_s: float) -> tuple[Verdict, Armed | None]:
        """Judge a frame that has arrived."""
        if not self._proven and len(self._deadlines) == 1:
            self._learn(frame_id)
        if self._base is None:
            return Verdict.EXTRA, None
        pulse = frame_id - self._base
        if pulse in self._deadlines:
            return Verdict.MATCHED, self._take(pulse, now_s)
        if pulse in self._expired:
            item = self._expired.pop(pulse)
            self._late += 1
            self._finish(item)
            return Verdict.MATCHED, item
        if pulse in self._done:
            return Verdict.DUPLICATE, None
        self._proven = False
        return Verdict.EXTRA, None

    def expire(self, now_s: float) -> list[Armed]:
        """Triggers whose time is over: they are missing for this stream."""
        late = [item for item, deadline_s in self._deadlines.values() if deadline_s <= now_s]
        for item in late:
            del self._deadlines[item.pulse]
            self._expired[item.pulse] = item
            _bound(self._expired)
        if late:
            self._proven = False
            self._slips, self._late = self._slips + bool(self._late), 0
        if self._slips > 1:
            self._slipped()
        return late

    def abandon(self) -> list[Armed]:
        """Camera or trigger unit was opened anew: what was awaited will not come, and numbers start from anywhere."""
        gone = [item for item, _ in self._deadlines.values()]
        for store in (self._deadlines, self._expired, self._done):
            store.clear()
        self._unproven.clear()
        self._base, self._proven = None, False
        self._late = self._slips = 0
        return gone

    def _slipped(self) -> None:
        """Twice in a row a frame came "late" and the awaited one did not: the camera missed a pulse itself."""
        self.revoked.extend(self._unproven)
        self.abandon()

    def _learn(self, frame_id: int) -> None:
        """One trigger outstanding, one frame come: if it is none of the past, it is this one's."""
        ((item, _),) = self._deadlines.values()
        base = frame_id - item.pulse
        if self._base is not None and base != self._base:
            past = frame_id - self._base
            if past in self._done or past in self._expired:
                return
            self.revoked.extend(self._unproven)
            self._unproven.clear()
            self._expired.clear()
            self._done.clear()
        self._base, self._proven = base, True
        self._late = self._slips = 0

    def _take(self, pulse: int, now_s: float) -> Armed:
        item, _ = self._deadlines.pop(pulse)
        for other, (armed, deadline_s) in self._deadlines.items():
            if other < pulse:
                self._deadlines[other] = (armed, min(deadline_s, now_s + _OVERTAKEN_S))
        self._finish(item)
        if not self._deadlines:
            self._unproven.clear()
        return item

    def _finish(self, item: Armed) -> None:
        self._unproven.append(item)
        self._done[item.pulse] = None
        _bound(self._done)


def _bound(store: OrderedDict[int, Armed] | OrderedDict[int, None]) -> None:
    while len(store) > _REMEMBERED:
        store.popitem(last=False)
