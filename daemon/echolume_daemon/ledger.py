"""The ledger of a scan: every trigger ends as matched or missing, every record as matched, duplicate or extra."""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal, NamedTuple, TypeAlias

import msgspec

from echolume_daemon.body import Json
from echolume_messages import archive
from echolume_messages.errors import ArchiveError
from echolume_messages.plan import Plan, Step, expand
from echolume_messages.topics import PASS_STREAMS, SCAN_START

Outcome: TypeAlias = Literal["complete", "incomplete", "aborted", "failed"]

RAW_STREAMS = frozenset(t.name for topics in PASS_STREAMS.values() for t in topics)
"""Topics whose records belong to triggers."""


class Expected(NamedTuple):
    """One record that a fired trigger must produce exactly once."""

    topic: str
    trigger: int
    attempt: int


class ScanStart(msgspec.Struct):
    """What going on with a scan needs of its ``conductor/start``."""

    scan: str
    plan: Plan
    calibration: dict[str, object] | None = None


@dataclass
class Ledger:
    """What was planned, fired, and made durable. The order in which it is told does not matter.

    A trigger is matched once one attempt has all its streams durable: both frames of a pair are of one exposure.
    """

    steps: Sequence[Step]
    _steps: dict[int, Step] = field(default_factory=dict[int, Step], init=False)
    _fired: set[tuple[int, int]] = field(default_factory=set[tuple[int, int]], init=False)
    _seen: Counter[Expected] = field(default_factory=Counter[Expected], init=False)
    _lost: set[Expected] = field(default_factory=set[Expected], init=False)
    _revoked: set[Expected] = field(default_factory=set[Expected], init=False)
    _open: set[Expected] = field(default_factory=set[Expected], init=False)
    _matched: dict[int, int] = field(default_factory=dict[int, int], init=False)
    _reported: Counter[tuple[str, str]] = field(default_factory=Counter[tuple[str, str]], init=False)

    def __post_init__(self) -> None:
        self._steps = {step.trigger: step for step in self.steps}

    @classmethod
    def from_archive(cls, path: Path) -> tuple[Ledger, ScanStart]:
        """Rebuild the ledger from what an archive holds, e.g. after a crash.

        Returns
        -------
        tuple
            The ledger, in which every record found counts as fired and durable, and how the scan was started.

        Raises
        ------
        ArchiveError
            It is no archive, or the start of its scan is not in it.
        """
        start: ScanStart | None = None
        records: list[Expected] = []
        for message in archive.read(path, topics={SCAN_START.name, *RAW_STREAMS}):
            if message.topic.name == SCAN_START.name:
                start = msgspec.convert(message.json(), ScanStart)
            else:
                records.append(Expected(message.header.stream, message.header.trigger, message.header.attempt))
        if start is None:
            raise ArchiveError(f"{path}: holds no start of a scan, so its plan is unknown; start the scan anew")
        ledger = cls(expand(start.plan))
        for record in records:
            ledger.fired(record.trigger, record.attempt)
            ledger.durable(*record)
        for record in ledger.open:
            ledger.lost(*record)
        return ledger, start

    def fired(self, trigger: int, attempt: int) -> None:
        """A trigger is about to be fired: its records are expected from now on."""
        if trigger not in self._steps:
            return
        self._fired.add((trigger, attempt))
        gone = self._lost | self._revoked
        self._open |= {e for e in self._expected(trigger, attempt) if not self._seen[e] and e not in gone}
        self._match(trigger, attempt)

    def durable(self, topic: str, trigger: int, attempt: int) -> None:
        """A record is on the disk. Records of streams without triggers are none of the ledger's business."""
        if topic not in RAW_STREAMS:
            return
        key = Expected(topic, trigger, attempt)
        self._seen[key] += 1
        self._lost.discard(key)
        self._open.discard(key)
        self._match(trigger, attempt)

    def lost(self, topic: str, trigger: int, attempt: int) -> None:
        """A record will not come, says its device or a deadline. If it comes late after all, it counts."""
        key = Expected(topic, trigger, attempt)
        if not self._seen[key]:
            self._lost.add(key)
        self._open.discard(key)

    def revoked(self, topic: str, trigger: int, attempt: int) -> None:
        """A published record may belong to another trigger: it counts as extra, and its own is missing."""
        key = Expected(topic, trigger, attempt)
        if key in self._revoked:
            return
        self._revoked.add(key)
        self._open.discard(key)
        self._matched.pop(trigger, None)
        for other in sorted({a for t, a in self._fired if t == trigger}):
            self._match(trigger, other)

    def reported(self, pass_name: str, kind: Literal["duplicate", "extra"], count: int) -> None:
        """A device received `count` records in a pass that it did not publish (total so far)."""
        self._reported[pass_name, kind] = count

    @property
    def open(self) -> frozenset[Expected]:
        """Records that are fired, and neither durable nor lost."""
        return frozenset(self._open)

    @property
    def acknowledged(self) -> int:
        """Records of triggers that are on the disk."""
        return self._seen.total()

    def count(self) -> tuple[int, int, int]:
        """(planned, fired, matched) triggers of the whole scan."""
        return len(self._steps), len(self._fired), len(self._matched)

    def missing(self, pass_name: str) -> list[Step]:
        """Steps of a pass that are not matched, in the order of acquisition."""
        return [s for s in self.steps if s.pass_name == pass_name and s.trigger not in self._matched]

    def lost_streams(self, trigger: int, attempt: int) -> set[str]:
        """Streams of one firing that did not come."""
        return {e.topic for e in self._expected(trigger, attempt) if e in self._lost}

    def next_attempt(self, trigger: int) -> int:
        """Number of the next attempt at a trigger."""
        return max((a for t, a in self._fired if t == trigger), default=-1) + 1

    def report(self, scan: str, outcome: Outcome, *, final: bool) -> Json:
        """The ledger as published.

        For each pass, planned = matched + missing triggers; among its records, expected = matched + missing, and
        received = matched + duplicate + extra.
        """
        names = list(dict.fromkeys(step.pass_name for step in self.steps))
        stray = sum(n for key, n in self._seen.items() if key.trigger not in self._steps)
        return {
            "scan": scan,
            "final": final,
            "outcome": outcome,
            "passes": {name: self._pass(name) for name in names},
            "triggers": {
                name: [s.trigger for s in self.steps if s.pass_name == name and s.trigger in self._matched]
                for name in names
            },
            "attempts": {str(t): a for t, a in sorted(self._matched.items()) if a > 0},
            "stray": stray,
            "acknowledged": self.acknowledged,
        }

    def complete(self) -> bool:
        """Whether every planned trigger is matched."""
        return len(self._matched) == len(self._steps)

    def _expected(self, trigger: int, attempt: int) -> Iterable[Expected]:
        return (Expected(t.name, trigger, attempt) for t in PASS_STREAMS[self._steps[trigger].kind])

    def _match(self, trigger: int, attempt: int) -> None:
        if (trigger, attempt) not in self._fired or not all(
            self._seen[e] and e not in self._revoked for e in self._expected(trigger, attempt)
        ):
            return
        self._matched[trigger] = min(attempt, self._matched.get(trigger, attempt))

    def _pass(self, name: str) -> Json:
        steps = [s for s in self.steps if s.pass_name == name]
        triggers = {s.trigger for s in steps}
        fired = sorted(f for f in self._fired if f[0] in triggers)
        expected = {e for trigger, attempt in fired for e in self._expected(trigger, attempt)}
        seen = {key: n for key, n in self._seen.items() if key.trigger in triggers and n}
        valid = expected - self._revoked
        matched = sum(key in valid for key in seen)
        duplicate = sum(n - 1 for key, n in seen.items() if key in valid) + self._reported[name, "duplicate"]
        extra = sum(n for key, n in seen.items() if key not in valid) + self._reported[name, "extra"]
        missing = sorted(triggers - self._matched.keys())
        return {
            "kind": steps[0].kind,
            "planned": len(steps),
            "fired": len(fired),
            "matched": len(steps) - len(missing),
            "missing": len(missing),
            "duplicate": duplicate,
            "extra": extra,
            "missing_triggers": missing,
            "records": {
                "expected": len(expected),
                "matched": matched,
                "missing": len(expected) - matched,
                "duplicate": duplicate,
                "extra": extra,
                "received": sum(seen.values()) + self._reported[name, "duplicate"] + self._reported[name, "extra"],
            },
        }
