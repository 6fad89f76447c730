"""The object dictionary of an emulated axis, and its SDO server."""

from __future__ import annotations

import struct
from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

OBJECTS: Final[dict[tuple[int, int], tuple[str, int]]] = {
    (0x1000, 0): ("I", 0x00020192),
    (0x1001, 0): ("B", 0),
    (0x1016, 0): ("B", 1),
    (0x1016, 1): ("I", 0),
    (0x1017, 0): ("H", 0),
    (0x1018, 0): ("B", 4),
    (0x1018, 1): ("I", 0),
    (0x1018, 2): ("I", 0x402),
    (0x1018, 3): ("I", 1),
    (0x1018, 4): ("I", 1),
    (0x1400, 1): ("I", 0x80000200),
    (0x1400, 2): ("B", 255),
    (0x1600, 0): ("B", 0),
    (0x1600, 1): ("I", 0),
    (0x1600, 2): ("I", 0),
    (0x1800, 1): ("I", 0x80000180),
    (0x1800, 2): ("B", 255),
    (0x1800, 5): ("H", 0),
    (0x1A00, 0): ("B", 0),
    (0x1A00, 1): ("I", 0),
    (0x1A00, 2): ("I", 0),
    (0x603F, 0): ("H", 0),
    (0x6040, 0): ("H", 0),
    (0x6041, 0): ("H", 0),
    (0x605A, 0): ("h", 2),
    (0x6060, 0): ("b", 0),
    (0x6061, 0): ("b", 0),
    (0x6064, 0): ("i", 0),
    (0x6065, 0): ("I", 2000),
    (0x606C, 0): ("i", 0),
    (0x607A, 0): ("i", 0),
    (0x607D, 0): ("B", 2),
    (0x607D, 1): ("i", 0),
    (0x607D, 2): ("i", 0),
    (0x6081, 0): ("I", 100_000),
    (0x6083, 0): ("I", 1_000_000),
    (0x6085, 0): ("I", 4_000_000),
    (0x60F4, 0): ("i", 0),
    (0x6502, 0): ("I", 0b1010_0001),
}
NAME: Final = b"echolume emulated axis"
READ_ONLY: Final = (0x1000, 0x1001, 0x1018, 0x603F, 0x6041, 0x6061, 0x6064, 0x606C, 0x60F4, 0x6502)

NO_OBJECT: Final = 0x06020000
NO_SUBINDEX: Final = 0x06090011
WRONG_LENGTH: Final = 0x06070010
IS_READ_ONLY: Final = 0x06010002
OUT_OF_RANGE: Final = 0x06090030
BAD_COMMAND: Final = 0x05040001
NOT_NOW: Final = 0x08000022
"""Data cannot be stored because of the present device state."""
NOT_MAPPABLE: Final = 0x06040041


class SdoAbort(Exception):
    """The server refuses with a code."""

    def __init__(self, code: int) -> None:
        super().__init__(f"0x{code:08X}")
        self.code = code


@dataclass
class ObjectDictionary:
    """Values by (index, subindex); `read` and `written` let the axis supply and act on live ones."""

    node_id: int
    read: Callable[[int], int | None]
    written: Callable[[int, int, int], None]

    def __post_init__(self) -> None:
        self.values = {key: value for key, (_, value) in OBJECTS.items()}
        self.values[0x1400, 1] += self.node_id
        self.values[0x1800, 1] += self.node_id
        self.values[0x1018, 4] = self.node_id
        self._segments = b""
        self._toggle = 0

    def get(self, index: int, sub: int = 0) -> int:
        """Present value of an object."""
        live = self.read(index)
        return self.values[index, sub] if live is None else live

    def bytes_of(self, index: int, sub: int) -> bytes:
        """An object as it goes on the wire."""
        return struct.pack("<" + OBJECTS[index, sub][0], self.get(index, sub))

    def store(self, index: int, sub: int, data: bytes) -> None:
        """Write an object from the wire."""
        layout = OBJECTS[index, sub][0]
        if len(data) != struct.calcsize(layout):
            raise SdoAbort(WRONG_LENGTH)
        if index in READ_ONLY or (sub == 0 and index in (0x1016, 0x607D)):
            raise SdoAbort(IS_READ_ONLY)
        value = int(struct.unpack("<" + layout, data)[0])
        self._check(index, sub, value)
        self.values[index, sub] = value
        self.written(index, sub, value)

    def _check(self, index: int, sub: int, value: int) -> None:
        if index in (0x1600, 0x1A00):
            link = self.values[index - 0x200, 1]
            if not link & 0x8000_0000:
                raise SdoAbort(NOT_NOW)  # a mapping changes only while its PDO is switched off
            if sub and not _mappable(value):
                raise SdoAbort(NOT_MAPPABLE)
            if not sub and value > 2:
                raise SdoAbort(OUT_OF_RANGE)
        if index == 0x6060 and value not in (0, 1, 6, 8):
            raise SdoAbort(OUT_OF_RANGE)

    def sdo(self, request: bytes) -> bytes:
        """Answer one SDO request of 8 bytes."""
        index, sub = struct.unpack_from("<HB", request, 1)
        try:
            return self._answer(request, index, sub)
        except SdoAbort as abort:
            return struct.pack("<BHBI", 0x80, index, sub, abort.code)

    def _answer(self, request: bytes, index: int, sub: int) -> bytes:
        kind = request[0] >> 5
        if kind == 3:  # upload segment
            return self._next_segment()
        if (index, sub) == (0x1008, 0) and kind == 2:
            self._segments, self._toggle = NAME, 0
            return struct.pack("<BHBI", 0x41, index, sub, len(NAME))
        if (index, sub) not in OBJECTS:
            raise SdoAbort(NO_SUBINDEX if (index, 0) in OBJECTS or (index, 1) in OBJECTS else NO_OBJECT)
        if kind == 2:  # upload
            data = self.bytes_of(index, sub)
            return struct.pack("<BHB", 0x43 | (4 - len(data)) << 2, index, sub) + data.ljust(4, b"\0")
        if kind == 1 and request[0] & 0x02:  # expedited download
            size = 4 - (request[0] >> 2 & 3) if request[0] & 1 else 4
            self.store(index, sub, request[4 : 4 + size])
            return struct.pack("<BHBI", 0x60, index, sub, 0)
        raise SdoAbort(BAD_COMMAND)

    def _next_segment(self) -> bytes:
        part, self._segments = self._segments[:7], self._segments[7:]
        head = self._toggle << 4 | (7 - len(part)) << 1 | (0 if self._segments else 1)
        self._toggle ^= 1
        return bytes([head]) + part.ljust(7, b"\0")


def _mappable(entry: int) -> bool:
    layout = OBJECTS.get((entry >> 16, entry >> 8 & 0xFF))
    return layout is not None and struct.calcsize("<" + layout[0]) * 8 == entry & 0xFF
