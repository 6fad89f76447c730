"""MCAP from its first byte to the last complete record, however the file ends."""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import BinaryIO

from echolume_messages.errors import ArchiveError

MAGIC = b"\x89MCAP0\r\n"
FOOTER, CHANNEL, MESSAGE, CHUNK, MESSAGE_INDEX = 0x02, 0x04, 0x05, 0x06, 0x07
HEAD = struct.Struct("<BQ")
"""Opcode and length of every MCAP record."""
CHUNK_HEAD = struct.Struct("<QQQI")
"""First and last log time, uncompressed size and CRC."""
MESSAGE_HEAD = struct.Struct("<HIQQ")
"""Channel, sequence, log time, publish time."""
CHUNK_LIMIT_BYTES = 1 << 30


@dataclass(frozen=True)
class Chunk:
    """A complete chunk: where it lies, and what it holds, decompressed and checked."""

    start: int
    end: int
    first_ns: int
    last_ns: int
    data: memoryview


@dataclass(frozen=True)
class RawMessage:
    """A message before it is decoded; `offset` counts from the start of the chunk's data."""

    channel: int
    sequence: int
    log_ns: int
    offset: int
    data: memoryview


@dataclass
class Scan:
    """What a walk through the file found, complete once the walk is over."""

    path: Path
    end: int = 0
    """Where the last complete record of the data section ends."""
    complete: bool = False
    """Whether the file ends as it should: footer and magic."""
    indexes: dict[int, dict[int, int]] = field(default_factory=dict[int, dict[int, int]])
    """By chunk start: file offset of each channel's message index."""


def _inflate(compression: str, data: memoryview, size: int, path: Path) -> memoryview:
    if compression == "":
        return data
    if compression == "lz4":
        import lz4.frame

        return memoryview(lz4.frame.decompress(data))
    if compression == "zstd":
        import zstandard

        return memoryview(zstandard.decompress(bytes(data), max_output_size=size))
    raise ArchiveError(f"{path}: chunk compressed with {compression!r}, which this program does not read")


def parse_chunk(body: memoryview, start: int, path: Path) -> Chunk | None:
    """Chunk of its record's body; None if the bytes are not what was written (CRC)."""
    if len(body) < CHUNK_HEAD.size + 4:
        return None
    first_ns, last_ns, size, crc = CHUNK_HEAD.unpack_from(body)
    at = CHUNK_HEAD.size
    name_length = int.from_bytes(body[at : at + 4], "little")
    at += 4
    if name_length > 16 or size > CHUNK_LIMIT_BYTES:
        return None
    compression = bytes(body[at : at + name_length]).decode("ascii", "replace")
    at += name_length
    length = int.from_bytes(body[at : at + 8], "little")
    at += 8
    if at + length != len(body):
        return None
    data = _inflate(compression, body[at:], size, path)
    if len(data) != size or (crc and zlib.crc32(data) != crc):
        return None
    return Chunk(start, start + HEAD.size + len(body), first_ns, last_ns, data)


def split(data: memoryview) -> Iterator[tuple[int, int, memoryview]]:
    """(opcode, offset, body) of the records inside a chunk's data."""
    at = 0
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        body = data[at + HEAD.size : at + HEAD.size + length]
        if len(body) != length:
            return
        yield opcode, at, body
        at += HEAD.size + length


def channel_name(body: memoryview) -> tuple[int, str]:
    """(number, topic) of a channel record."""
    number = int.from_bytes(body[:2], "little")
    length = int.from_bytes(body[4:8], "little")
    return number, bytes(body[8 : 8 + length]).decode("utf-8", "replace")


def message_of(body: memoryview, offset: int) -> RawMessage:
    """Message of its record's body."""
    channel, sequence, log_ns, _ = MESSAGE_HEAD.unpack_from(body)
    return RawMessage(channel, sequence, log_ns, offset, body[MESSAGE_HEAD.size :])


def read_chunk(stream: BinaryIO, start: int, path: Path) -> Chunk | None:
    """Chunk that starts at `start`, or None if there is no whole one."""
    stream.seek(start)
    head = stream.read(HEAD.size)
    if len(head) < HEAD.size:
        return None
    opcode, length = HEAD.unpack(head)
    if opcode != CHUNK or length > CHUNK_LIMIT_BYTES:
        return None
    body = stream.read(length)
    return parse_chunk(memoryview(body), start, path) if len(body) == length else None


def chunks(stream: BinaryIO, scan: Scan) -> Iterator[Chunk]:
    """Chunks in file order, up to the first byte that is missing or wrong; fills `scan` on the way.

    Raises
    ------
    ArchiveError
        The file does not start as an MCAP file does.
    """
    size = stream.seek(0, 2)
    stream.seek(0)
    magic = stream.read(len(MAGIC))
    if not MAGIC.startswith(magic):
        raise ArchiveError(f"{scan.path}: not an archive: starts with {magic!r}, an MCAP file starts with {MAGIC!r}")
    scan.end = at = len(magic)
    inside = -1
    while at + HEAD.size <= size:
        stream.seek(at)
        opcode, length = HEAD.unpack(stream.read(HEAD.size))
        after = at + HEAD.size + length
        if opcode == 0 or after > size:
            return
        if opcode == FOOTER:
            stream.seek(after)
            scan.complete = stream.read() == MAGIC
            return
        if opcode == CHUNK:
            found = read_chunk(stream, at, scan.path)
            if found is None:
                return
            inside = at
            scan.indexes[inside] = {}
            scan.end = after
            yield found
        elif opcode == MESSAGE_INDEX and inside >= 0:
            scan.indexes[inside][int.from_bytes(stream.read(2), "little")] = at
            scan.end = after
        elif inside < 0:
            scan.end = after
        at = after
