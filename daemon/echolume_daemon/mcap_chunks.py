"""An MCAP file as a sequence of chunks, written with plain `write` calls and gone on with after a crash."""

from __future__ import annotations

import os
import zlib
from collections import defaultdict
from pathlib import Path

from mcap import records as mcap_records
from mcap.data_stream import RecordBuilder
from mcap.opcode import Opcode

from echolume_messages import archive_format, mcap_stream
from echolume_messages.mcap_stream import CHUNK_HEAD, HEAD, MAGIC, MESSAGE_HEAD

WRITE_PARTS = 512
"""Buffers of one system call; the system allows 1024."""


def sync_directory(directory: Path) -> None:
    """Bring a directory's entries to the disk."""
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_directory(directory: Path) -> None:
    """Make a directory and those above it, each entry synced."""
    missing = [d for d in (directory, *directory.parents) if not d.exists()]
    for made in reversed(missing):
        made.mkdir(exist_ok=True)
        sync_directory(made.parent)


class ChunkBuilder:
    """The chunk in hand."""

    def __init__(self) -> None:
        self.parts: list[bytes] = []
        self.size = 0
        self.first_ns = self.last_ns = 0
        self.index: dict[int, list[tuple[int, int]]] = defaultdict(list)

    def add_description(self) -> None:
        """Put in the schemas and channels, as the first chunk has to."""
        builder = RecordBuilder()
        for record in descriptions():
            record.write(builder)
        data = builder.end()
        self.parts.append(data)
        self.size += len(data)

    def add_message(self, channel: int, sequence: int, log_ns: int, publish_ns: int, data: bytes) -> None:
        """Put in one message."""
        self.first_ns = min(self.first_ns, log_ns) if self.index else log_ns
        self.last_ns = max(self.last_ns, log_ns)
        self.index[channel].append((log_ns, self.size))
        head = HEAD.pack(Opcode.MESSAGE, MESSAGE_HEAD.size + len(data))
        self.parts += (head, MESSAGE_HEAD.pack(channel, sequence, log_ns, publish_ns), data)
        self.size += HEAD.size + MESSAGE_HEAD.size + len(data)


def descriptions() -> list[mcap_records.McapRecord]:
    """Schema and channel records of every archive."""
    schemas: list[mcap_records.McapRecord] = [
        mcap_records.Schema(id=number, name=name, encoding=encoding, data=data)
        for number, name, encoding, data in archive_format.schemas()
    ]
    return schemas + [
        mcap_records.Channel(id=c.number, topic=c.name, message_encoding=c.encoding, metadata={}, schema_id=c.schema)
        for c in archive_format.CHANNELS
    ]


class ChunkFile:
    """An MCAP file that grows by whole chunks. Raises OSError as the system does."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.end = 0
        """Bytes up to the end of the last whole chunk."""
        self._fd = -1
        self._indexes: list[mcap_records.ChunkIndex] = []
        self._counts: dict[int, int] = defaultdict(int)

    @property
    def is_open(self) -> bool:
        """Whether it can be written."""
        return self._fd >= 0

    @property
    def described(self) -> bool:
        """Whether a chunk holds the schemas and channels already."""
        return bool(self._indexes)

    def create(self) -> None:
        """Make the file and its directory; both entries are on the disk when this returns."""
        make_directory(self.path.parent)
        self._fd = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        builder = RecordBuilder()
        mcap_records.Header(profile="", library="echolume").write(builder)
        self._put(MAGIC + builder.end())
        os.fsync(self._fd)
        sync_directory(self.path.parent)

    def adopt(self, chunk: mcap_stream.Chunk) -> None:
        """Count a chunk that the file holds already; `reopen` comes after the last one."""
        self._note(chunk.start, chunk.end, chunk.first_ns, chunk.last_ns, len(chunk.data))
        for opcode, _, body in mcap_stream.split(chunk.data):
            if opcode == Opcode.MESSAGE:
                self._counts[mcap_stream.message_of(body, 0).channel] += 1

    def reopen(self, scan: mcap_stream.Scan) -> None:
        """Go on after the last whole chunk; what lies behind it is cut off."""
        starts = [index.chunk_start_offset for index in self._indexes]
        for index, following in zip(self._indexes, [*starts[1:], scan.end], strict=True):
            index.message_index_offsets = scan.indexes[index.chunk_start_offset]
            index.message_index_length = following - index.chunk_start_offset - index.chunk_length
        self._fd = os.open(self.path, os.O_WRONLY | os.O_CLOEXEC)
        os.ftruncate(self._fd, scan.end)
        os.lseek(self._fd, scan.end, os.SEEK_SET)
        os.fsync(self._fd)
        self.end = scan.end

    def append(self, chunk: ChunkBuilder) -> None:
        """Write a chunk and its message indexes."""
        body_size = CHUNK_HEAD.size + 4 + 8 + chunk.size
        crc = 0
        for part in chunk.parts:
            crc = zlib.crc32(part, crc)
        head = (
            HEAD.pack(Opcode.CHUNK, body_size)
            + CHUNK_HEAD.pack(chunk.first_ns, chunk.last_ns, chunk.size, crc)
            + (0).to_bytes(4, "little")  # no compression
            + chunk.size.to_bytes(8, "little")
        )
        start, after = self.end, self.end + HEAD.size + body_size
        builder = RecordBuilder()
        offsets: dict[int, int] = {}
        for channel, entries in chunk.index.items():
            offsets[channel] = after + builder.count
            mcap_records.MessageIndex(channel_id=channel, records=entries).write(builder)
        tail = builder.end()
        self._put(head, *chunk.parts, tail)
        self._note(start, after, chunk.first_ns, chunk.last_ns, chunk.size, offsets, len(tail))
        for channel, entries in chunk.index.items():
            self._counts[channel] += len(entries)

    def sync(self) -> None:
        """Bring the data to the disk."""
        os.fdatasync(self._fd)

    def finish(self) -> None:
        """Write the index that lets readers seek, and sync."""
        builder = RecordBuilder()
        mcap_records.DataEnd(data_section_crc=0).write(builder)
        summary_start = self.end + builder.count
        data_end = builder.end()
        summary = RecordBuilder()
        offsets: list[mcap_records.SummaryOffset] = []
        groups = (
            (Opcode.SCHEMA, [r for r in descriptions() if isinstance(r, mcap_records.Schema)]),
            (Opcode.CHANNEL, [r for r in descriptions() if isinstance(r, mcap_records.Channel)]),
            (Opcode.STATISTICS, [self._statistics()]),
            (Opcode.CHUNK_INDEX, self._indexes),
        )
        for opcode, group in groups:
            start = summary.count
            for record in group:
                record.write(summary)
            offsets.append(mcap_records.SummaryOffset(opcode, summary_start + start, summary.count - start))
        offset_start = summary_start + summary.count
        for offset in offsets:
            offset.write(summary)
        text = summary.end()
        head = HEAD.pack(Opcode.FOOTER, 20) + summary_start.to_bytes(8, "little") + offset_start.to_bytes(8, "little")
        crc = zlib.crc32(head, zlib.crc32(text))
        self._put(data_end, text, head, crc.to_bytes(4, "little"), MAGIC)
        os.fsync(self._fd)

    def cut(self) -> None:
        """Take off what was written after the last whole chunk."""
        os.ftruncate(self._fd, self.end)

    def close(self) -> None:
        """Close the file as it is."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _put(self, *parts: bytes) -> None:
        for first in range(0, len(parts), WRITE_PARTS):
            batch = parts[first : first + WRITE_PARTS]
            size = sum(len(part) for part in batch)
            written = os.writev(self._fd, batch)
            left = memoryview(b"".join(batch))[written:] if written < size else memoryview(b"")
            while left:
                left = left[os.write(self._fd, left) :]
        self.end += sum(len(part) for part in parts)

    def _note(
        self,
        start: int,
        after: int,
        first_ns: int,
        last_ns: int,
        size: int,
        offsets: dict[int, int] | None = None,
        index_length: int = 0,
    ) -> None:
        self._indexes.append(
            mcap_records.ChunkIndex(
                chunk_length=after - start,
                chunk_start_offset=start,
                compression="",
                compressed_size=size,
                message_end_time=last_ns,
                message_index_length=index_length,
                message_index_offsets=offsets or {},
                message_start_time=first_ns,
                uncompressed_size=size,
            )
        )

    def _statistics(self) -> mcap_records.Statistics:
        return mcap_records.Statistics(
            attachment_count=0,
            channel_count=len(archive_format.CHANNELS),
            channel_message_counts=dict(self._counts),
            chunk_count=len(self._indexes),
            message_count=sum(self._counts.values()),
            metadata_count=0,
            message_start_time=min((i.message_start_time for i in self._indexes), default=0),
            message_end_time=max((i.message_end_time for i in self._indexes), default=0),
            schema_count=len(archive_format.schemas()),
        )
