"""Who may command the rig: one holder at a time, and a dead client's hold runs out by itself."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

from echolume_messages.errors import LeaseHeldError

LEASE_S = 5.0


@dataclass
class Lease:
    """A hold that must be renewed."""

    duration_s: float = LEASE_S
    now_s: Callable[[], float] = time.monotonic
    _holder: str = ""
    _until_s: float = 0.0

    @property
    def holder(self) -> str:
        """Who holds it now; empty if nobody does."""
        return self._holder if self.now_s() < self._until_s else ""

    @property
    def left_s(self) -> float:
        """Seconds until the hold runs out."""
        return max(0.0, self._until_s - self.now_s())

    def take(self, holder: str) -> None:
        """Hold, or renew, the lease.

        Raises
        ------
        LeaseHeldError
            Somebody else's hold has not run out.
        """
        if not holder:
            raise LeaseHeldError("conductor: a command needs a holder's name; give `holder`")
        current = self.holder
        if current and current != holder:
            raise LeaseHeldError(
                f"conductor: {current} commands the rig; free at the latest {self.left_s:.1f} s after its last command"
            )
        self._holder = holder
        self._until_s = self.now_s() + self.duration_s

    def renew(self, holder: str) -> None:
        """Prolong the hold if `holder` has it; a stranger's question changes nothing."""
        if holder and holder == self.holder:
            self._until_s = self.now_s() + self.duration_s

    def release(self, holder: str) -> None:
        """Give the hold back."""
        if holder == self._holder:
            self._until_s = self.now_s()
