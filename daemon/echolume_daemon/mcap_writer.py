"""Writes the raw archive of a scan: what `sync` has returned survives a power cut."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Callable
from pathlib import Path
from typing import NamedTuple

from echolume_daemon.mcap_chunks import ChunkBuilder, ChunkFile
from echolume_messages import archive_format, mcap_stream
from echolume_messages.archive import ChunkReader
from echolume_messages.bus import Message
from echolume_messages.errors import ArchiveError

CHUNK_BYTES = 4 << 20
"""A chunk is written when it holds this much, and at each sync."""


class Durable(NamedTuple):
    """A record that is on the disk."""

    topic: str
    trigger: int
    attempt: int
    seq: int


class Place(NamedTuple):
    """Where a written record lies: the byte at which its chunk starts."""

    stream: str
    boot: str
    seq: int
    chunk: int


class ArchiveWriter:
    """One archive being written. Not thread-safe: its owner is one loop.

    Parameters
    ----------
    path
        The file; it is created, or, with `resume`, gone on with after its last whole chunk.
    resume
        Go on with a file that a recorder left behind. What it holds is synced and returned by the next `sync`.

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
        self.records: dict[str, int] = {}
        self.unsynced_since_s: float | None = None
        """CLOCK_MONOTONIC of the oldest record that is not durable yet."""
        self._file = ChunkFile(path)
        self._chunk = ChunkBuilder()
        self._failure: ArchiveError | None = None
        self._known: set[tuple[str, str, int]] = set()
        self._pending: list[Durable] = []
        self._places: list[Place] = []
        try:
            if resume:
                self._resume()
            else:
                self._file.create()
        except FileExistsError as error:
            raise ArchiveError(f"{path}: exists already; an archive is never written over") from error
        except OSError as error:
            self._file.close()
            raise ArchiveError(f"{path}: cannot open the archive: {error.strerror}") from error

    @property
    def bytes(self) -> int:
        """Bytes in the file."""
        return self._file.end

    @property
    def failure(self) -> ArchiveError | None:
        """Why nothing is acknowledged any more, if so."""
        return self._failure

    def write(self, message: Message) -> bool:
        """Take a record; False if it is a double of one taken before.

        Raises
        ------
        ArchiveError
            The file cannot be written (disk full, I/O error); what was acknowledged stays readable.
        """
        self._check()
        header = message.header
        identity = (header.stream, header.boot, header.seq)
        if identity in self._known:
            return False
        if not self._file.described and not self._chunk.parts:
            self._chunk.add_description()
        for channel, data in archive_format.encode_message(message):
            self._chunk.add_message(channel, header.seq & 0xFFFFFFFF, header.t_wall_ns, header.t_ns, data)
        self._count(message, self._file.end)
        if self.unsynced_since_s is None:
            self.unsynced_since_s = time.monotonic()
        if self._chunk.size >= CHUNK_BYTES:
            self._end_chunk()
        return True

    def sync(self) -> list[Durable]:
        """Bring everything taken to the disk; returns what that made durable.

        Raises
        ------
        ArchiveError
            The disk did not take it; nothing is acknowledged on this file any more.
        """
        self._check()
        if not self._pending:
            return []
        self._end_chunk()
        self._guard(self._file.sync)
        out, self._pending = self._pending, []
        self.unsynced_since_s = None
        return out

    def places(self) -> list[Place]:
        """Where the records synced since the last call lie."""
        out, self._places = self._places, []
        return out

    def close(self) -> list[Durable]:
        """Sync, write the index and close the file; returns what became durable.

        Raises
        ------
        ArchiveError
            The disk did not take it, or had failed before.
        """
        try:
            out = self.sync()
            self._guard(self._file.finish)
        finally:
            self._file.close()
        return out

    def abandon(self) -> None:
        """Close the file as it is, without an index."""
        self._file.close()

    def _count(self, message: Message, chunk: int) -> None:
        header = message.header
        self._known.add((header.stream, header.boot, header.seq))
        self._pending.append(Durable(header.stream, header.trigger, header.attempt, header.seq))
        self._places.append(Place(header.stream, header.boot, header.seq, chunk))
        self.records[header.stream] = self.records.get(header.stream, 0) + 1

    def _end_chunk(self) -> None:
        chunk, self._chunk = self._chunk, ChunkBuilder()
        if chunk.index:
            self._guard(lambda: self._file.append(chunk))

    def _resume(self) -> None:
        scan = mcap_stream.Scan(self.path)
        reader = ChunkReader(self.path)
        with self.path.open("rb") as stream:
            for chunk in mcap_stream.chunks(stream, scan):
                self._file.adopt(chunk)
                for message in reader.records(chunk):
                    self._count(message, chunk.start)
        if self._file.described:
            self._file.reopen(scan)
        else:
            self.path.unlink()  # cut before its first chunk: nothing in it is worth keeping
            self._file.create()

    def _check(self) -> None:
        if self._failure is not None:
            raise self._failure
        if not self._file.is_open:
            raise ArchiveError(f"{self.path}: the archive is closed")

    def _guard(self, action: Callable[[], None]) -> None:
        try:
            action()
        except OSError as error:
            with contextlib.suppress(OSError):
                self._file.cut()
            self._failure = ArchiveError(
                f"{self.path}: {error.strerror}; nothing is acknowledged any more, what was acknowledged is readable. "
                "Free space or check the disk, then scan again"
            )
            raise self._failure from error
