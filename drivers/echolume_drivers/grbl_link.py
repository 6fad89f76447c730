"""The wire to a Grbl 1.1 board: lines counted against its receive buffer, answers, status reports and alarms.

A reader thread takes everything the board says; whoever waits is woken. Nothing here knows about guides or lasers.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, cast

import serial

from echolume_drivers.grbl_codes import alarm_words, error_words
from echolume_messages.errors import (
    DeviceAbsentError,
    DeviceError,
    DeviceFaultError,
    DeviceSilentError,
    ProtocolError,
)

RX_BYTES: Final = 127
"""What the board's receive buffer holds: a program must fit as a whole."""
KEEP_ALIVE_S: Final = 0.2
SILENCE_S: Final = 1.0


class CancelledError(DeviceFaultError):
    """The program was taken off the board by somebody else's reset."""


@dataclass(frozen=True)
class Report:
    """One status report ``<...>``."""

    state: str
    machine_mm: float
    number: int


class GrblLink:
    """Opens the port exclusively and speaks Grbl on it."""

    def __init__(self, name: str, port: str, baud: int) -> None:
        self.where = f"{name} ({port})"
        self._port, self._baud = port, baud
        self._serial: serial.Serial | None = None
        self._reader: threading.Thread | None = None
        self._news = threading.Condition()
        self._out = threading.Lock()
        self._turn = threading.RLock()
        self._forget()
        self._banners = 0
        self._report: Report | None = None
        self._work_mm = 0.0
        self._generation = 0
        self._expecting_banner = True
        self.alarm: int | None = None
        self.restarted = False
        """The board has restarted by itself: its position is lost."""

    def _forget(self) -> None:
        self._waiting: deque[str] = deque()
        self._answers: list[str] = []
        self._trouble: DeviceError | None = None

    # --- opening ---------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Open the port; nobody else can, until it is closed."""
        try:
            opened = serial.serial_for_url(
                self._port, baudrate=self._baud, timeout=0.2, write_timeout=1.0, exclusive=True
            )
            self._serial = cast(serial.Serial, opened)
        except (serial.SerialException, OSError, ValueError) as error:
            raise DeviceAbsentError(
                f"{self.where}: cannot open the port: {error}. Is it plugged in, and does no other program hold it?"
            ) from error
        self._reader = threading.Thread(target=self._read, args=(self._serial,), name="grbl-reader", daemon=True)
        self._reader.start()

    def close(self) -> None:
        """Give the port back."""
        port, self._serial = self._serial, None
        if port is None:
            return
        if hasattr(port, "cancel_read"):  # sockets have none; their reads end by time
            with contextlib.suppress(OSError, serial.SerialException):
                port.cancel_read()
        if self._reader is not None:
            self._reader.join(2.0)
        port.close()

    @property
    def is_open(self) -> bool:
        """Whether the port is open."""
        return self._serial is not None

    @property
    def is_troubled(self) -> bool:
        """Whether something went wrong since the last reset."""
        return self._trouble is not None

    # --- reading ---------------------------------------------------------------------------------------------

    def _read(self, port: serial.Serial) -> None:
        rest = b""
        while self._serial is port:
            try:
                data = port.read(1)
                data += port.read(port.in_waiting) if data else b""
                if not data:
                    continue
            except (serial.SerialException, OSError, TypeError) as error:
                if self._serial is port:
                    self._fail(DeviceAbsentError(f"{self.where}: the port died: {error}. Check the cable and power."))
                return
            *lines, rest = (rest + data).split(b"\n")
            with self._news:
                for line in lines:
                    self._take(line.strip().decode("latin-1"))
                self._news.notify_all()

    def _fail(self, error: DeviceError) -> None:
        with self._news:
            self._trouble = self._trouble or error
            self._news.notify_all()

    def _take(self, line: str) -> None:
        if line == "ok":
            if self._waiting:
                self._waiting.popleft()
            else:
                self._fail(ProtocolError(f"{self.where}: an `ok` that answers nothing; the line count is lost"))
        elif line.startswith("error:"):
            sent = self._waiting.popleft() if self._waiting else "nothing sent"
            self._fail(DeviceFaultError(f"{self.where}: {error_words(_number(line))} for {sent!r}"))
        elif line.startswith("ALARM:"):
            self.alarm = _number(line)
            self._fail(DeviceFaultError(f"{self.where}: {alarm_words(self.alarm)}"))
        elif line.startswith("<") and line.endswith(">"):
            self._take_report(line[1:-1])
        elif line.startswith("Grbl "):
            self._banners += 1
            if not self._expecting_banner:
                self.restarted = True
                self._fail(DeviceFaultError(f"{self.where}: the controller restarted by itself; home again"))
        elif line.startswith(("[", "$")):
            self._answers.append(line)
        elif line:
            self._fail(ProtocolError(f"{self.where}: unexpected {line[:40]!r}; expected ok, error, ALARM or a report"))

    def _take_report(self, text: str) -> None:
        state, *pairs = text.split("|")
        fields = {name: value for name, _, value in (pair.partition(":") for pair in pairs)}
        try:
            if "WCO" in fields:
                self._work_mm = float(fields["WCO"].split(",")[0])
            if "MPos" in fields:
                machine_mm = float(fields["MPos"].split(",")[0])
            else:
                machine_mm = float(fields["WPos"].split(",")[0]) + self._work_mm
        except (KeyError, ValueError):
            self._fail(ProtocolError(f"{self.where}: unreadable status report <{text[:60]}>"))
            return
        self._report = Report(state, machine_mm, 1 if self._report is None else self._report.number + 1)

    # --- writing ---------------------------------------------------------------------------------------------

    def send(self, data: bytes) -> None:
        """Put bytes on the wire at once (real-time commands)."""
        port = self._serial
        if port is None:
            raise DeviceAbsentError(f"{self.where}: the port is not open")
        with self._out:
            try:
                port.write(data)
            except (serial.SerialException, OSError) as error:
                raise DeviceAbsentError(f"{self.where}: cannot write: {error}. Check the cable and power.") from error

    def run(self, lines: Sequence[str], timeout_s: float, listening: bool = True) -> list[str]:
        """Send lines in one write and wait until each is acknowledged; returns what was answered besides.

        Parameters
        ----------
        lines
            Without their ends; together they must fit the receive buffer, so that the board either has the whole
            program or has not begun it.
        timeout_s
            For all of them. A status query each 0.2 s keeps the dead-man relay closed while the board answers it.
        listening
            False while homing: the board answers no status query then.

        Raises
        ------
        DeviceError
            The first thing that went wrong.
        """
        data = "".join(line + "\n" for line in lines).encode("ascii")
        if len(data) > RX_BYTES:
            raise ValueError(f"{self.where}: a program of {len(data)} bytes does not fit {RX_BYTES}")
        with self._turn:
            with self._news:
                self._raise_trouble()
                generation = self._generation
                self._waiting.extend(lines)
                self._answers = []
            self.send(data)
            self._wait_acknowledged(timeout_s, listening, generation)
            with self._news:
                return self._answers

    def _wait_acknowledged(self, timeout_s: float, listening: bool, generation: int) -> None:
        begin_s = heard_s = asked_s = time.monotonic()
        seen = self._report
        while (pending := self._unacknowledged(generation)) is not None:
            if self._report is not seen:
                seen, heard_s = self._report, time.monotonic()
            now_s = time.monotonic()
            if now_s - begin_s > timeout_s:
                raise DeviceSilentError(f"{self.where}: no ok for {pending!r} within {timeout_s:.1f} s")
            if listening and asked_s > heard_s and now_s - heard_s > SILENCE_S:
                raise DeviceSilentError(f"{self.where}: no status report for {SILENCE_S:.1f} s; the controller hangs")
            if listening and heard_s >= asked_s and now_s - asked_s >= KEEP_ALIVE_S:
                asked_s = now_s  # only a board that answered is kept alive: else the relay must open
                self.send(b"?")

    def _unacknowledged(self, generation: int) -> str | None:
        """Wait a moment for news; the line that waits for its ok, or None when all have theirs."""
        with self._news:
            self._news.wait_for(
                lambda: self._trouble is not None or not self._waiting or self._generation != generation,
                KEEP_ALIVE_S / 4,
            )
            if self._generation != generation:
                raise CancelledError(f"{self.where}: stopped on request")
            self._raise_trouble()
            return self._waiting[0] if self._waiting else None

    def _raise_trouble(self) -> None:
        if self._trouble is not None:
            raise self._trouble

    def report(self, timeout_s: float = SILENCE_S) -> Report:
        """Ask for a status report and wait for it."""
        before = self._report
        self.send(b"?")
        if not self._wait(lambda: self._report is not before, timeout_s):
            raise DeviceSilentError(f"{self.where}: no status report within {timeout_s:.1f} s")
        report = self._report
        assert report is not None
        return report

    def _wait(self, done: Callable[[], bool], timeout_s: float) -> bool:
        with self._news:
            return self._news.wait_for(done, timeout_s)

    def reset(self, timeout_s: float = 2.0) -> bool:
        """Send 0x18 and forget what was under way; whether the banner came."""
        with self._news:
            banners = self._banners
            self._generation += 1
            self._expecting_banner = True
            self._waiting.clear()
            self._news.notify_all()
        self.send(b"\x18")
        return self.await_banner(banners, timeout_s)

    def await_banner(self, since: int, timeout_s: float) -> bool:
        """Wait for a banner after `since` of them; then the link starts anew."""
        came = self._wait(lambda: self._banners > since, timeout_s)
        if came:
            with self._news:
                self._expecting_banner = False
                if not isinstance(self._trouble, DeviceAbsentError):
                    self._forget()
        return came


def _number(line: str) -> int:
    text = line.partition(":")[2]
    return int(text) if text.isdigit() else -1
