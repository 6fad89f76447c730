"""How far long work of a command is, on stderr: a line that is rewritten on a terminal, now and then one elsewhere."""

from __future__ import annotations

import sys
import time
from typing import TextIO


class ProgressLine:
    """Shows counts; called with what is being done, how much of it is done, and how much there is (0: unknown)."""

    def __init__(self, stream: TextIO | None = None, every_s: float = 5.0) -> None:
        self._stream = sys.stderr if stream is None else stream
        self._live = self._stream.isatty()
        self._every_s = 0.1 if self._live else every_s
        self._shown_s = -every_s
        self._open = False

    def __call__(self, what: str, done: int, total: int) -> None:
        """Show a count, unless the last one is too fresh."""
        now_s = time.monotonic()
        if now_s - self._shown_s < self._every_s:
            return
        self._shown_s = now_s
        text = f"{what}: {done}{f'/{total}' if total else ''}"
        self._stream.write(f"\r{text:<78}" if self._live else f"{text}\n")
        self._stream.flush()
        self._open = self._live

    def close(self) -> None:
        """Clear the line, so that what follows starts on a fresh one."""
        if self._open:
            self._stream.write(f"\r{'':<78}\r")
            self._stream.flush()
            self._open = False
