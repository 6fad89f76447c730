"""Progress of long work on stderr: one line that is rewritten on a terminal, a line now and then elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TextIO


class Progress:
    """Says what is going on and how far it is."""

    def __init__(self, stream: TextIO | None = None, every_s: float = 5.0) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._every_s = every_s
        self._live = self._stream.isatty()
        self._start_s = time.monotonic()
        self._last_s = 0.0
        self._open = False

    @property
    def elapsed_s(self) -> float:
        """Seconds since the start."""
        return time.monotonic() - self._start_s

    def say(self, text: str) -> None:
        """A step of the work, on a line of its own."""
        self._end_line()
        self._stream.write(f"[{self.elapsed_s:5.1f} s] {text}\n")
        self._stream.flush()
        self._last_s = time.monotonic()

    def count(self, what: str, done: int, total: int) -> None:
        """How much of the present step is done; a `total` of 0 is unknown."""
        now_s = time.monotonic()
        if now_s - self._last_s < (0.1 if self._live else self._every_s):
            return
        self._last_s = now_s
        text = f"[{self.elapsed_s:5.1f} s]   {what}: {done}{f'/{total}' if total else ''}"
        self._stream.write(f"\r{text:<78}" if self._live else f"{text}\n")
        self._open = self._live
        self._stream.flush()

    def _end_line(self) -> None:
        if self._open:
            self._stream.write("\n")
            self._open = False
