"""SCPI instruments on a serial port or socket: lines, answers, error queue, IEEE 488.2 blocks."""

from __future__ import annotations

import re
import socket
import time
from typing import Protocol, cast

import serial

from echolume_messages.errors import DeviceAbsentError, DeviceFaultError, DeviceSilentError, ProtocolError

POLL_S = 0.02
"""Longest single wait in a read; deadlines are checked between them."""
QUIET_S = 0.1
LONGEST_ANSWER = 4096
LARGEST_BLOCK = 64 << 20
ERRORS_READ = 64

_ERROR = re.compile(r'\s*([+-]?\d+)\s*,\s*"(.*)"\s*')


class _Line(Protocol):
    """The part of pyserial that is used here."""

    @property
    def in_waiting(self) -> int: ...
    def read(self, size: int = 1) -> bytes: ...
    def write(self, data: bytes) -> int | None: ...
    def close(self) -> None: ...


class ScpiPort:
    """One instrument on one wire, held exclusively.

    Parameters
    ----------
    url
        Whatever pyserial opens: ``/dev/echolume/trigger``, ``socket://host:port``, ``rfc2217://...``.
    baud
        Rate of a real serial line; sockets ignore it.
    name
        The device as errors name it.
    timeout_s
        Deadline of an answer.
    """

    def __init__(self, url: str, baud: int, name: str, timeout_s: float = 2.0) -> None:
        self._url = url
        self._baud = baud
        self._name = name
        self._timeout_s = timeout_s
        self._line: _Line | None = None
        self._buffer = bytearray()
        self._quiet_s = 0.0

    @property
    def label(self) -> str:
        """Device and port, as errors begin."""
        return f"{self._name} at {self._url}"

    @property
    def is_open(self) -> bool:
        """Whether the wire is up, as far as known."""
        return self._line is not None

    def open(self) -> None:
        """Take the port for this process alone.

        Raises
        ------
        DeviceAbsentError
            The port does not exist, nobody listens, or another process holds it.
        """
        if self._line is not None:
            return
        try:
            line = serial.serial_for_url(self._url, baudrate=self._baud, timeout=POLL_S, do_not_open=True)
            if "://" not in self._url:
                line.exclusive = True
            line.open()
        except (serial.SerialException, OSError, ValueError) as error:
            raise DeviceAbsentError(
                f"{self.label}: cannot open the port: {error}; "
                f"check power, cable and the port in the rig file, and that no other program holds it"
            ) from error
        self._line = cast(_Line, line)
        self._buffer.clear()
        self._quiet_s = 0.0

    def close(self) -> None:
        """Give the port back; closing twice is fine."""
        line, self._line = self._line, None
        if line is not None:
            sock = getattr(line, "_socket", None)
            line.close()
            if isinstance(sock, socket.socket):
                sock.close()  # pyserial leaves it open when the other end has gone

    def write(self, command: str) -> None:
        """Send one command line."""
        if self._quiet_s > 0:
            self._drain()
        line = self._connected()
        try:
            line.write(command.encode("ascii") + b"\n")
        except (serial.SerialException, OSError) as error:
            raise self._lost(f"sending {command!r}", error) from error

    def query(self, command: str, timeout_s: float | None = None) -> str:
        """Send a query and return its answer line.

        Raises
        ------
        DeviceSilentError
            No complete line within the deadline.
        ProtocolError
            The answer is not ASCII text, or never ends.
        DeviceAbsentError
            The connection broke.
        """
        self.write(command)
        return self.read_line(command, timeout_s)

    def read_line(self, asked: str, timeout_s: float | None = None) -> str:
        """The next answer line; `asked` is the command that it belongs to."""
        deadline_s = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        while b"\n" not in self._buffer:
            if len(self._buffer) > LONGEST_ANSWER:
                raise self._nonsense(asked, "a line of text", f"{len(self._buffer)} bytes without an end of line")
            self._more(asked, "a line of text", 1, deadline_s)
        raw, _, rest = bytes(self._buffer).partition(b"\n")
        self._buffer[:] = rest
        try:
            return raw.decode("ascii").strip()
        except UnicodeDecodeError as error:
            raise self._nonsense(asked, "a line of text", repr(raw[:40])) from error

    def query_block(self, command: str, expected_bytes: int | None = None, timeout_s: float | None = None) -> bytes:
        """Send a query and return the data of its definite-length block.

        Parameters
        ----------
        command
            The query.
        expected_bytes
            Length that the block must announce; None takes any up to 64 MiB.
        timeout_s
            Deadline of the whole block.

        References
        ----------
        IEEE 488.2-1992, 8.7.9 definite length arbitrary block response data.
        """
        self.write(command)
        deadline_s = time.monotonic() + (self._timeout_s if timeout_s is None else timeout_s)
        wanted = "a definite-length block" + (f" of {expected_bytes} bytes" if expected_bytes is not None else "")
        head = self._exactly(2, command, wanted, deadline_s)
        if head[:1] != b"#" or not b"1" <= head[1:] <= b"9":
            kind = "an indefinite-length block" if head == b"#0" else repr(head + bytes(self._buffer[:30]))
            raise self._nonsense(command, wanted, kind)
        digits = self._exactly(int(head[1:]), command, wanted, deadline_s)
        length = int(digits) if digits.isdigit() else -1
        if length < 0 or length > LARGEST_BLOCK or expected_bytes not in (None, length):
            raise self._nonsense(command, wanted, f"a header that announces {digits!r} bytes")
        data = self._exactly(length, command, wanted, deadline_s)
        end = self._exactly(1, command, "the end of line after the block", deadline_s)
        if end == b"\r":
            end = self._exactly(1, command, "the end of line after the block", deadline_s)
        if end != b"\n":
            raise self._nonsense(command, "the end of line after the block", repr(end))
        return data

    def errors(self) -> list[tuple[int, str]]:
        """Empty the instrument's error queue: code and text of each entry, oldest first."""
        found: list[tuple[int, str]] = []
        for _ in range(ERRORS_READ):
            answer = self.query("SYST:ERR?")
            match = _ERROR.fullmatch(answer)
            if match is None:
                raise self._nonsense("SYST:ERR?", 'a code and a "text"', repr(answer))
            if int(match[1]) == 0:
                return found
            found.append((int(match[1]), match[2]))
        raise self._nonsense("SYST:ERR?", f"an error queue that ends within {ERRORS_READ} entries", repr(found[-1]))

    def check_errors(self, doing: str) -> None:
        """Raise `DeviceFaultError` if the error queue holds anything."""
        found = self.errors()
        if found:
            shown = [f'{code},"{text}"' for code, text in found]
            if len(shown) > 4:
                shown[2:-1] = [f"{len(shown) - 3} more"]
            raise DeviceFaultError(
                f"{self.label}: {doing}: expected an empty error queue, got {', '.join(shown)}; "
                f"see the instrument's manual for the code, then try again"
            )

    def _connected(self) -> _Line:
        if self._line is None:
            raise DeviceAbsentError(f"{self.label}: the port is not open; open it first, or check the cable")
        return self._line

    def _read(self, line: _Line, size: int, doing: str) -> bytes:
        try:
            return line.read(max(size, line.in_waiting))
        except (serial.SerialException, OSError) as error:
            raise self._lost(doing, error) from error

    def _more(self, asked: str, wanted: str, size: int, deadline_s: float) -> None:
        """Read at least one byte, at best `size`, or fail at the deadline."""
        line = self._connected()
        while True:
            doing = f"waiting for {wanted} in answer to {asked!r}"
            data = self._read(line, size, doing)
            if data:
                self._buffer += data
                return
            if time.monotonic() > deadline_s:
                self._quiet_s = max(QUIET_S, self._timeout_s)  # the answer may yet come, late
                raise DeviceSilentError(
                    f"{self.label}: expected {wanted} in answer to {asked!r}, got {len(self._buffer)} bytes "
                    f"by the deadline; check power and cable, then try again"
                )

    def _exactly(self, size: int, asked: str, wanted: str, deadline_s: float) -> bytes:
        while len(self._buffer) < size:
            self._more(asked, wanted, size - len(self._buffer), deadline_s)
        out = bytes(self._buffer[:size])
        del self._buffer[:size]
        return out

    def _nonsense(self, asked: str, wanted: str, seen: str) -> ProtocolError:
        self._quiet_s = QUIET_S
        return ProtocolError(
            f"{self.label}: expected {wanted} in answer to {asked!r}, got {seen}; "
            f"check that the port belongs to this device and its firmware speaks this protocol"
        )

    def _lost(self, doing: str, error: Exception) -> DeviceAbsentError:
        self.close()
        return DeviceAbsentError(
            f"{self.label}: the connection broke while {doing}, {len(self._buffer)} bytes received: {error}; "
            f"check power and cable, and that no other program holds the port"
        )

    def _drain(self) -> None:
        """Throw away late or unread answers until the line is quiet."""
        line = self._connected()
        quiet_since_s = time.monotonic()
        give_up_s = quiet_since_s + 2 * (self._timeout_s + self._quiet_s)
        while time.monotonic() - quiet_since_s < self._quiet_s:
            if self._read(line, 1, "clearing the line"):
                quiet_since_s = time.monotonic()
            if time.monotonic() > give_up_s:
                raise self._nonsense("nothing", "a quiet line", "data without end")
        self._buffer.clear()
        self._quiet_s = 0.0
