"""The last seconds of everything a session published, for subscribers that missed some of it."""

from __future__ import annotations

import threading
from collections import deque
from dataclasses import dataclass, field

KEEP_BYTES = 1 << 20
KEEP_RECORDS = 64
"""A stream keeps this much whatever its age, so that slow streams can be read by a late subscriber."""
REPLY_RECORDS = 32
REPLY_BYTES = 6 << 20
"""At most this much answers one query, so that a refill never fills the network's queues."""


@dataclass(frozen=True)
class Record:
    """One published record as it went out."""

    key: str
    seq: int
    t_ns: int
    header: bytes
    payload: bytes

    @property
    def size(self) -> int:
        """Bytes that the record holds."""
        return len(self.header) + len(self.payload)


@dataclass
class _Stream:
    records: deque[Record] = field(default_factory=deque[Record])
    size: int = 0

    def spare(self, now_ns: int, span_ns: int) -> bool:
        """Whether the oldest record may go because of its age."""
        if len(self.records) <= 1 or now_ns - self.records[0].t_ns <= span_ns:
            return False
        return self.size > KEEP_BYTES or len(self.records) > KEEP_RECORDS


class Journal:
    """Bounded store of a session's records, by stream and sequence number."""

    def __init__(self, span_s: float, limit_bytes: int) -> None:
        self._span_ns = round(span_s * 1e9)
        self._limit_bytes = limit_bytes
        self._streams: dict[str, _Stream] = {}
        self._size = 0
        self._lock = threading.Lock()

    def add(self, stream: str, record: Record) -> None:
        """Keep a record, and let go of what is too old or too much."""
        with self._lock:
            found = self._streams.setdefault(stream, _Stream())
            found.records.append(record)
            found.size += record.size
            self._size += record.size
            while found.spare(record.t_ns, self._span_ns):
                self._drop(found)
            while self._size > self._limit_bytes:
                largest = max(self._streams.values(), key=lambda s: s.size)
                if len(largest.records) <= 1:
                    break
                self._drop(largest)

    def _drop(self, stream: _Stream) -> None:
        gone = stream.records.popleft()
        stream.size -= gone.size
        self._size -= gone.size

    def select(self, stream: str, first: int, last: int, records: int = REPLY_RECORDS) -> list[Record]:
        """The oldest records with ``first <= seq <= last``, at most `records` and REPLY_BYTES (but at least one)."""
        out: list[Record] = []
        size = 0
        with self._lock:
            found = self._streams.get(stream)
            for record in found.records if found else ():
                if record.seq < first:
                    continue
                if record.seq > last or len(out) >= records or (out and size + record.size > REPLY_BYTES):
                    break
                out.append(record)
                size += record.size
        return out

    def span(self, stream: str) -> tuple[int, int] | None:
        """(first, last) sequence number held, or None."""
        with self._lock:
            found = self._streams.get(stream)
            return (found.records[0].seq, found.records[-1].seq) if found and found.records else None

    def count(self, stream: str) -> int:
        """Records held of one stream."""
        with self._lock:
            found = self._streams.get(stream)
            return len(found.records) if found else 0

    @property
    def size(self) -> int:
        """Bytes held in all."""
        with self._lock:
            return self._size
