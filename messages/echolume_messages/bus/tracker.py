"""Which records of a stream have come, which are missing: the bookkeeping of a refilling subscription."""

from __future__ import annotations

from dataclasses import dataclass, field

from echolume_messages.bus.message import Message

GRACE_NS = 20_000_000
"""A gap is asked for after this long: what arrives out of order by a hair is no gap."""
ATTEMPTS_SILENT = 3
ATTEMPTS_PROMISED = 8
"""How often a gap is asked for when nobody answers, and when a journal says that it has it."""


@dataclass
class Track:
    """One stream of one publisher session (`boot`); not thread-safe, its owner holds the lock.

    Records leave in order of `seq`. `following` is the next one due; `high` the highest known to exist.
    """

    stream: str
    boot: str
    following: int = 0
    high: int = -1
    fresh: bool = True
    """Nothing delivered yet: what no journal holds came before our time and is not lost."""
    held: dict[int, Message] = field(default_factory=dict[int, Message])
    attempts: int = 0
    due_ns: int = 0
    """When the gap may be asked for."""

    def notice(self, seq: int, now_ns: int) -> None:
        """Learn that `seq` exists."""
        if seq > self.high:
            if self.gap() is None:
                self.due_ns = now_ns + GRACE_NS
            self.high = seq

    def wants(self, seq: int) -> bool:
        """Whether this record has not come before."""
        return seq >= self.following and seq not in self.held

    def ready(self) -> bool:
        """Whether the next record in order is here."""
        return self.following in self.held

    def pop(self) -> Message:
        """The next record in order."""
        message = self.held.pop(self.following)
        self.following += 1
        self.fresh = False
        self.attempts = 0
        return message

    def gap(self) -> tuple[int, int] | None:
        """(first, last) missing before the next record that is here, or None."""
        if self.following > self.high or self.ready():
            return None
        above = min(self.held, default=self.high + 1)
        return self.following, above - 1

    def later(self, now_ns: int, allowed: int) -> bool:
        """Put the next question off; False once it has been asked `allowed` times."""
        self.attempts += 1
        self.due_ns = now_ns + min(50_000_000 << self.attempts, 1_000_000_000)
        return self.attempts < allowed

    def step_over(self, to_seq: int) -> int:
        """Give up what comes before `to_seq`; how many records are lost by that."""
        lost = 0 if self.fresh else to_seq - self.following
        self.following = to_seq
        self.fresh = False
        self.attempts = 0
        self.due_ns = 0
        return lost
