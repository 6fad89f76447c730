"""How long the passes of a scan took."""

from __future__ import annotations

import time
from dataclasses import dataclass, field


@dataclass
class Passes:
    """Seconds spent in the passes of each kind."""

    seconds: dict[str, float] = field(default_factory=lambda: {"optical": 0.0, "ultrasonic": 0.0, "snap": 0.0})
    _kind: str = ""
    _since_s: float = 0.0

    def follow(self, kind: str) -> None:
        """Charge the time since the last call to the kind of pass that ran then."""
        now_s = time.monotonic()
        if self._kind in self.seconds:
            self.seconds[self._kind] += now_s - self._since_s
        self._kind, self._since_s = kind, now_s
