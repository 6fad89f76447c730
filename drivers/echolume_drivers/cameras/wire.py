"""The emulated camera's wire: one TCP connection, in the manner of GigE Vision.

The host sends text lines, with the feature names of the GenICam SFNC::

    get ExposureTime            -> ok 4000.0
    set TriggerMode On          -> ok
    run AcquisitionStart        -> ok
    get Colour                  -> error unknown feature Colour

The camera sends messages: a 20 byte header (magic ``ELCV``, kind, reserved, block id, length; little endian), then
`length` bytes. A REPLY's body is text. A frame is a LEADER (device time in ns, width, height, exposure in s, payload
size), PAYLOADs in order, and a TRAILER (payload size, CRC-32 of the payload); all carry the frame's block id, which
counts accepted triggers from 1 after each AcquisitionStart.
"""

from __future__ import annotations

import socket
import struct
import time
from dataclasses import dataclass
from enum import IntEnum

MAGIC = b"ELCV"
HEADER = struct.Struct("<4sHHQI")
LEADER = struct.Struct("<QIIdI")
TRAILER = struct.Struct("<II")
PACKET_BYTES = 1 << 18
LINE_BYTES = 200


class Kind(IntEnum):
    """What a message of the camera is."""

    REPLY = 1
    LEADER = 2
    PAYLOAD = 3
    TRAILER = 4


@dataclass(frozen=True)
class WireMessage:
    """A message of the camera."""

    kind: Kind
    block: int
    body: bytes


class WireError(Exception):
    """The bytes are not a message of this wire."""


class WireEnd(Exception):
    """The other side hung up; `mid_message` bytes of a message had come."""

    def __init__(self, mid_message: int) -> None:
        super().__init__(f"connection ended after {mid_message} bytes of a message")
        self.mid_message = mid_message


def pack(kind: Kind, block: int, body: bytes | memoryview) -> bytes:
    """A message as bytes."""
    return HEADER.pack(MAGIC, kind, 0, block, len(body)) + body


class WireReader:
    """Cuts the camera's byte stream into messages; what came before a timeout is kept for the next call."""

    def __init__(self, port: socket.socket) -> None:
        self._port = port
        self._buffer = bytearray()

    def next(self, deadline_s: float) -> WireMessage:
        """The next message, until `deadline_s` on the monotonic clock.

        Raises
        ------
        TimeoutError
            If it is not complete in time.
        WireEnd
            If the camera hung up.
        WireError
            If the bytes are no message.
        """
        self._fill(HEADER.size, deadline_s)
        magic, kind, _, block, length = HEADER.unpack_from(self._buffer)
        if magic != MAGIC:
            raise WireError(f"a message starts with {magic!r}, expected {MAGIC!r}")
        if length > PACKET_BYTES:
            raise WireError(f"a message promises {length} bytes, at most {PACKET_BYTES} are allowed")
        if kind not in Kind.__members__.values():
            raise WireError(f"a message is of unknown kind {kind}")
        self._fill(HEADER.size + length, deadline_s)
        body = bytes(memoryview(self._buffer)[HEADER.size : HEADER.size + length])
        del self._buffer[: HEADER.size + length]
        return WireMessage(Kind(kind), block, body)

    def _fill(self, size: int, deadline_s: float) -> None:
        while len(self._buffer) < size:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0:
                raise TimeoutError
            self._port.settimeout(left_s)
            try:
                data = self._port.recv(max(size - len(self._buffer), 1 << 12))
            except ConnectionError as error:
                raise WireEnd(len(self._buffer)) from error
            if not data:
                raise WireEnd(len(self._buffer))
            self._buffer += data
