"""SCPI as an instrument speaks it: headers in short and long form, IEEE 488.2 common commands, error queue."""

from __future__ import annotations

import re
from collections import deque
from collections.abc import Callable, Mapping

Answer = str | bytes | None
Handler = Callable[[list[str]], Answer]

UNDEFINED_HEADER = (-113, "Undefined header")
MISSING_PARAMETER = (-109, "Missing parameter")
ILLEGAL_PARAMETER = (-224, "Illegal parameter value")
OUT_OF_RANGE = (-222, "Data out of range")
NOT_NUMERIC = (-104, "Data type error")
TRIGGER_IGNORED = (-211, "Trigger ignored")
DATA_STALE = (-230, "Data corrupt or stale")
OVERFLOW = (-350, "Queue overflow")
QUEUE_LENGTH = 16

_STATUS_BITS = {1: 0x20, 2: 0x10, 3: 0x08, 4: 0x04}
"""Event status bit of the error classes -1xx to -4xx."""


class ScpiFault(Exception):
    """A command that the instrument refuses; becomes an entry of its error queue."""

    def __init__(self, code: int, text: str) -> None:
        super().__init__(text)
        self.code = code
        self.text = text


class ErrorQueue:
    """First in, first out; when full, the last entry becomes -350."""

    def __init__(self) -> None:
        self._entries: deque[tuple[int, str]] = deque()
        self.event_status = 0x80  # power on

    def push(self, code: int, text: str) -> None:
        """Add an error; device-dependent ones are positive."""
        self.event_status |= _STATUS_BITS.get(-code // 100, 0x08)
        if len(self._entries) < QUEUE_LENGTH:
            self._entries.append((code, text))
        else:
            self._entries[-1] = OVERFLOW

    def pop(self) -> str:
        """Answer of ``SYST:ERR?``."""
        code, text = self._entries.popleft() if self._entries else (0, "No error")
        return f'{code},"{text}"'

    def clear(self) -> None:
        """Forget all errors and events."""
        self._entries.clear()
        self.event_status = 0

    def __len__(self) -> int:
        return len(self._entries)


def header_pattern(header: str) -> re.Pattern[str]:
    """Pattern of a header such as ``SYSTem:ERRor[:NEXT]?``: capitals are the short form, brackets optional."""
    nodes = re.findall(r"(\[?):?(\*?)([A-Z]+)([a-z]*)(\d*)\]?", header.rstrip("?"))
    out = ""
    for k, (optional, star, short, rest, number) in enumerate(nodes):
        node = f"{re.escape(star)}{short}(?:{rest.upper()})?{number}" if rest else f"{re.escape(star)}{short}{number}"
        node = f":{node}" if k else f":?{node}"
        out += f"(?:{node})?" if optional else node
    return re.compile(out + (r"\?" if header.endswith("?") else "") + r"\Z")


def number(arguments: list[str], low: float, high: float) -> float:
    """The only argument as a number within limits."""
    if not arguments:
        raise ScpiFault(*MISSING_PARAMETER)
    try:
        value = float(arguments[0])
    except ValueError as error:
        raise ScpiFault(*NOT_NUMERIC) from error
    if not low <= value <= high:
        raise ScpiFault(*OUT_OF_RANGE)
    return value


def choice(arguments: list[str], choices: Mapping[str, str]) -> str:
    """The only argument as one of the choices (upper case -> value)."""
    if not arguments:
        raise ScpiFault(*MISSING_PARAMETER)
    if arguments[0].upper() not in choices:
        raise ScpiFault(*ILLEGAL_PARAMETER)
    return choices[arguments[0].upper()]


def block(data: bytes) -> bytes:
    """Definite-length block of IEEE 488.2: ``#``, number of digits, length, data."""
    length = str(len(data)).encode()
    return b"#" + str(len(length)).encode() + length + data


def split_units(line: bytes) -> list[tuple[str, list[str]]]:
    """Program message units of a line: header and arguments of each."""
    text = line.decode("ascii", errors="replace")
    units: list[tuple[str, list[str]]] = []
    for unit in text.split(";"):
        header, _, rest = unit.strip().partition(" ")
        if header:
            units.append((header.upper(), [a.strip() for a in rest.split(",") if a.strip()]))
    return units


class ScpiInstrument:
    """Answers lines: the common commands here, the instrument's own ones from a table."""

    def __init__(self, identity: str, commands: Mapping[str, Handler]) -> None:
        self.errors = ErrorQueue()
        common: dict[str, Handler] = {
            "*IDN?": lambda _: identity,
            "*CLS": self._clear,
            "*RST": lambda _: None,
            "*ESR?": self._event_status,
            "*OPC": self._complete,
            "*OPC?": lambda _: "1",
            "*WAI": lambda _: None,
            "*TST?": lambda _: "0",
            "*STB?": lambda _: str((4 if len(self.errors) else 0) | (0x20 if self.errors.event_status else 0)),
            "SYSTem:ERRor[:NEXT]?": lambda _: self.errors.pop(),
            "SYSTem:VERSion?": lambda _: "1999.0",
        }
        self._commands = [(header_pattern(h), handler) for h, handler in (common | dict(commands)).items()]

    def _clear(self, _: list[str]) -> None:
        self.errors.clear()

    def _event_status(self, _: list[str]) -> str:
        status, self.errors.event_status = self.errors.event_status, 0
        return str(status)

    def _complete(self, _: list[str]) -> None:
        self.errors.event_status |= 1

    def _execute(self, header: str, arguments: list[str]) -> Answer:
        for pattern, handler in self._commands:
            if pattern.match(header):
                return handler(arguments)
        raise ScpiFault(*UNDEFINED_HEADER)

    def handle(self, line: bytes) -> bytes:
        """Execute a line; the answers of its queries joined by ``;``, ended by a line feed."""
        answers: list[bytes] = []
        for header, arguments in split_units(line):
            try:
                answer = self._execute(header, arguments)
            except ScpiFault as fault:
                self.errors.push(fault.code, fault.text)
                break  # IEEE 488.2: the rest of the message is discarded
            if answer is not None:
                answers.append(answer.encode() if isinstance(answer, str) else answer)
        return b";".join(answers) + b"\n" if answers else b""
