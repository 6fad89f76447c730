"""Writes the raw archive: what `sync` has returned survives a power cut."""

from __future__ import annotations

import contextlib
import os
import time
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

from mcap import records as mcap_records
from mcap.data_stream import RecordBuilder

from echolume_messages import archive_format, mcap_stream
from echolume_messages.archive import ChunkReader
from echolume_messages.bus.message import Message
from echolume_messages.errors import ArchiveError

CHUNK_BYTES = 4 << 20
"""A chunk is written when it holds this much, and at each sync."""


class Durable(NamedTuple):
    """A record that is on the disk."""

    topic: str
    trigger: int
    attempt: int
    seq: int


@dataclass(frozen=True)
class Place:
    """Where a written record lies."""

    stream: str
    boot: str
    seq: int
    chunk: int


def _sync_directory(directory: Path) -> None:
    handle = os.open(directory, os.O_RDONLY | os.O_DIRECTORY)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)


def make_directory(directory: Path) -> None:
    """Make a directory and those above it, each entry synced."""
    missing = [d for d in (directory, *directory.parents) if not d.exists()]
    for made in reversed(missing):
        made.mkdir(exist_ok=True)
        _sync_directory(made.parent)


class ArchiveWriter:
    """One archive being written. Not thread-safe: its owner is one loop.

    Parameters
    ----------
    path
        The file; it is created, or, with `resume`, gone on with after its last complete chunk.
    resume
        Go on with a file that a recorder left behind.

    Raises
    ------
    ArchiveError
        The file exists (without `resume`), is no archive, or cannot be made.

    Notes
    -----
    After a write or a sync has failed, nothing is acknowledged on this file any more: the kernel may have dropped
    the pages and would report the next sync as good.
    """

    def __init__(self, path: Path, resume: bool = False) -> None:
        self.path = path
        self.unsynced_since_s: float | None = None
        self.count = 0
        self.bytes = 0
        self.records: dict[str, int] = {}
        self._failure: ArchiveError | None = None
        self._written: set[tuple[str, str, int]] = set()
        self._places: list[Place] = []
        self._pending: list[Durable] = []
        self._clear_chunk()
        self._chunk_indexes: list[mcap_records.ChunkIndex] = []
        self._channel_counts: dict[int, int] = {}
        self._first_ns = self._last_ns = 0
        self._described = False
        self._fd = -1
        try:
            if resume:
                self._resume()
            else:
                self._create()
        except FileExistsError as error:
            raise ArchiveError(f"{path}: exists already; an archive is never written over") from error
        except OSError as error:
            raise ArchiveError(f"{path}: cannot make the archive: {error.strerror}") from error

    def write(self, message: Message) -> bool:
        """Take a record; False if it is a double of one already taken.

        Raises
        ------
        ArchiveError
            The file cannot be written (disk full, I/O error); what was acknowledged stays readable.
        """
        self._check()
        header = message.header
        identity = (header.stream, header.boot, header.seq)
        if identity in self._written:
            return False
        self._describe()
        for number, data in archive_format.encode_message(message):
            self._add(number, header.seq & 0xFFFFFFFF, header.t_wall_ns, header.t_ns, data)
        self._written.add(identity)
        self._places.append(Place(header.stream, header.boot, header.seq, self.bytes))
        self._pending.append(Durable(header.stream, header.trigger, header.attempt, header.seq))
        self.records[header.stream] = self.records.get(header.stream, 0) + 1
        self.count += 1
        if self.unsynced_since_s is None:
            self.unsynced_since_s = time.monotonic()
        if self._size >= CHUNK_BYTES:
            self._end_chunk()
        return True

    def sync(self) -> list[Durable]:
        """Bring everything taken to the disk, and return what that made durable.

        Raises
        ------
        ArchiveError
            The disk did not take it; nothing is acknowledged on this file any more.
        """
        self._check()
        if not self._pending:
            return []
        self._end_chunk()
        self._guard(lambda: os.fdatasync(self._fd))
        out, self._pending = self._pending, []
        self.unsynced_since_s = None
        return out

    def places(self) -> list[Place]:
        """Where the records written since the last call lie; call it after `sync`."""
        out, self._places = self._places, []
        return out

    def close(self) -> list[Durable]:
        """Write the index and close the file; returns what that made durable.

        Raises
        ------
        ArchiveError
            The disk did not take it, or had failed before.
        """
        try:
            out = self.sync()
            self._guard(lambda: self._put(self._ending()))
            self._guard(lambda: os.fsync(self._fd))
        finally:
            if self._fd >= 0:
                os.close(self._fd)
                self._fd = -1
        return out

    def abandon(self) -> None:
        """Close the file as it is."""
        if self._fd >= 0:
            os.close(self._fd)
            self._fd = -1

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if self._fd < 0:
            raise ArchiveError(f"{self.path}: the archive is closed")

    def _guard(self, action: object) -> None:
        assert callable(action)
        try:
            action()
        except OSError as error:
            with contextlib.suppress(OSError):
                os.ftruncate(self._fd, self.bytes)
            self._failure = ArchiveError(
                f"{self.path}: {error.strerror}: the archive ends after {self.bytes} bytes; "
                f"what was acknowledged is in it. Free space or check the disk, then scan again"
            )
            raise self._failure from error

    def _create(self) -> None:
        make_directory(self.path.parent)
        self._fd = os.open(self.path, os.O_WRONLY | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o640)
        builder = RecordBuilder()
        mcap_records.Header(profile="", library="echolume").write(builder)
        self._put(mcap_stream.MAGIC + builder.end())
        os.fsync(self._fd)
        _sync_directory(self.path.parent)

    def _resume(self) -> None:
        scan = mcap_stream.Scan(self.path)
        reader = ChunkReader(self.path)
        with self.path.open("rb") as stream:
            for chunk in mcap_stream.chunks(stream, scan):
                self._adopt(chunk, reader)
        for index in self._chunk_indexes:
            index.message_index_offsets = scan.indexes[index.chunk_start_offset]
        self._fd = os.open(self.path, os.O_WRONLY | os.O_CLOEXEC)
        os.ftruncate(self._fd, scan.end)
        os.lseek(self._fd, scan.end, os.SEEK_SET)
        os.fsync(self._fd)
        self.bytes = scan.end

    def _adopt(self, chunk: mcap_stream.Chunk, reader: ChunkReader) -> None:
        """Count a chunk that is there already."""
        self._chunk_indexes.append(
            mcap_records.ChunkIndex(
                chunk_length=chunk.end - chunk.start,
                chunk_start_offset=chunk.start,
                compression="",
                compressed_size=len(chunk.data),
                message_end_time=chunk.last_ns,
                message_index_length=0,
                message_index_offsets={},
                message_start_time=chunk.first_ns,
                uncompressed_size=len(chunk.data),
            )
        )
        self._span(chunk.first_ns, chunk.last_ns)
        for record in reader.records(chunk):
            header = record.header
            self._written.add((header.stream, header.boot, header.seq))
            self._places.append(Place(header.stream, header.boot, header.seq, chunk.start))
            self._pending.append(Durable(header.stream, header.trigger, header.attempt, header.seq))
            self.records[header.stream] = self.records.get(header.stream, 0) + 1
            self.count += 1
