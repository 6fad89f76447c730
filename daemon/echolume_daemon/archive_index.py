"""Finds records in the archives being written, for subscribers that missed more than the live journals hold."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

from echolume_daemon.mcap_writer import Place
from echolume_messages import mcap_stream
from echolume_messages.archive import ChunkReader
from echolume_messages.archive_format import CHANNELS
from echolume_messages.bus.journal import REPLY_BYTES, REPLY_RECORDS
from echolume_messages.codec import encode, encode_header
from echolume_messages.errors import ArchiveError


@dataclass
class _Session:
    """Records of one stream of one publisher session, ordered by seq."""

    seqs: list[int] = field(default_factory=list[int])
    places: list[tuple[Path, int]] = field(default_factory=list[tuple[Path, int]])

    def add(self, seq: int, place: tuple[Path, int]) -> None:
        at = bisect_left(self.seqs, seq)
        if at < len(self.seqs) and self.seqs[at] == seq:
            self.places[at] = place
        else:
            self.seqs.insert(at, seq)
            self.places.insert(at, place)


class ArchiveIndex:
    """Source of refills from archives; thread-safe."""

    def __init__(self) -> None:
        self._sessions: dict[tuple[str, str], _Session] = {}
        self._lock = threading.Lock()

    def add(self, path: Path, places: Iterable[Place]) -> None:
        """Note where records lie; they must be in the file already."""
        with self._lock:
            for place in places:
                session = self._sessions.setdefault((place.stream, place.boot), _Session())
                session.add(place.seq, (path, place.chunk))

    def keep_only(self, paths: Iterable[Path]) -> None:
        """Forget what lies in other files."""
        kept = set(paths)
        with self._lock:
            for key, session in list(self._sessions.items()):
                left = [(s, p) for s, p in zip(session.seqs, session.places, strict=True) if p[0] in kept]
                if left:
                    session.seqs, session.places = [s for s, _ in left], [p for _, p in left]
                else:
                    del self._sessions[key]

    def span(self, stream: str, boot: str) -> tuple[int, int] | None:
        """(first, last) sequence number in the archives, or None."""
        with self._lock:
            session = self._sessions.get((stream, boot))
            return (session.seqs[0], session.seqs[-1]) if session and session.seqs else None

    def select(self, stream: str, boot: str, first: int, last: int) -> list[tuple[bytes, bytes]]:
        """(header, payload) of the oldest records with ``first <= seq <= last``, as many as fit one answer.

        Raises
        ------
        ArchiveError
            An archive cannot be read.
        """
        with self._lock:
            session = self._sessions.get((stream, boot))
            if session is None:
                return []
            at = bisect_left(session.seqs, first)
            found = list(zip(session.seqs[at:], session.places[at:], strict=True))[:REPLY_RECORDS]
        wanted = [(seq, place) for seq, place in found if seq <= last]
        out: list[tuple[bytes, bytes]] = []
        size = 0
        chunk: dict[int, tuple[bytes, bytes]] = {}
        at_place: tuple[Path, int] | None = None
        for seq, place in wanted:
            if place != at_place:
                chunk, at_place = _records(*place, stream, boot), place
            record = chunk.get(seq)
            if record is None:
                continue
            size += len(record[1])
            if out and size > REPLY_BYTES:
                break
            out.append(record)
        return out


def _records(path: Path, start: int, stream: str, boot: str) -> dict[int, tuple[bytes, bytes]]:
    """Records of one stream and publisher session in the chunk at `start`, by seq."""
    reader = ChunkReader(path, {stream}, {channel.number: channel for channel in CHANNELS})
    try:
        with path.open("rb") as file:
            chunk = mcap_stream.read_chunk(file, start, path)
    except OSError as error:
        raise ArchiveError(f"{path}: cannot read the archive: {error.strerror}") from error
    if chunk is None:
        raise ArchiveError(f"{path}: no whole chunk at byte {start}")
    return {
        message.header.seq: (encode_header(message.header), encode(message.payload))
        for message in reader.records(chunk)
        if message.header.boot == boot
    }
