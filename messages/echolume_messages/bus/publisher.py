"""The acquisition side: `put` never waits; one thread of the session sends, a journal answers who missed something."""

from __future__ import annotations

import contextlib
import threading
import time
from collections import deque
from dataclasses import dataclass

import msgspec
import numpy as np
import zenoh
from numpy.typing import NDArray

from echolume_messages import topics
from echolume_messages.bus.journal import Journal, Record
from echolume_messages.bus.journal_server import JSON_ENCODING, Beat, JournalServer, journal_key
from echolume_messages.clock import Clock
from echolume_messages.codec import ENCODING, check, encode, encode_header, json_array
from echolume_messages.errors import BusError
from echolume_messages.header import Header, Source
from echolume_messages.topics import Topic

QUEUE_RECORDS = 512
BEAT_FIRST_NS = 100_000_000
BEAT_NS = 1_000_000_000
DRAIN_S = 2.0
QUIET_NS = 150_000_000
"""A session that closes stays until nobody has asked its journal for this long, for at most LINGER_S."""
LINGER_S = 2.0


@dataclass(frozen=True)
class _Outgoing:
    publisher: Publisher
    record: Record


class Outbox:
    """The session's one publisher thread and its bounded queue."""

    def __init__(self, session: zenoh.Session, limit_bytes: int) -> None:
        self._session = session
        self._limit_bytes = limit_bytes
        self._queue: deque[_Outgoing] = deque()
        self._size = 0
        self._publishers: list[Publisher] = []
        self._wake = threading.Condition()
        self._closing = False
        self._thread = threading.Thread(target=self._run, name="bus-publisher", daemon=True)
        self._thread.start()

    def register(self, publisher: Publisher) -> None:
        """Let a publisher's beat be sent."""
        with self._wake:
            self._publishers.append(publisher)

    def add(self, publisher: Publisher, record: Record) -> None:
        """Queue a record; when the queue is full the oldest leaves it (the journal still has it)."""
        with self._wake:
            if self._closing:
                raise BusError(f"{publisher.topic.name}: the bus is closed")
            self._queue.append(_Outgoing(publisher, record))
            self._size += record.size
            while len(self._queue) > QUEUE_RECORDS or (self._size > self._limit_bytes and len(self._queue) > 1):
                gone = self._queue.popleft()
                self._size -= gone.record.size
                gone.publisher.count_drop()
            self._wake.notify()

    def queued(self, publisher: Publisher) -> int:
        """Records of one publisher that wait to be sent."""
        with self._wake:
            return sum(1 for item in self._queue if item.publisher is publisher)

    def close(self) -> None:
        """Send what is queued, for at most DRAIN_S, end the thread, and stay while subscribers still refill."""
        with self._wake:
            self._closing = True
            self._wake.notify()
        self._thread.join(DRAIN_S)
        deadline_ns = time.monotonic_ns() + round(LINGER_S * 1e9)
        pause = threading.Event()
        while time.monotonic_ns() < deadline_ns and any(p.busy() for p in self._publishers):
            pause.wait(0.01)

    def _next(self) -> tuple[_Outgoing | None, list[Publisher]]:
        """The next record to send, or the publishers whose beat is due (at the end: those just used)."""
        with self._wake:
            while True:
                if self._queue:
                    item = self._queue.popleft()
                    self._size -= item.record.size
                    return item, []
                if self._closing:
                    return None, [p for p in self._publishers if p.busy()]
                now_ns = time.monotonic_ns()
                due = [p for p in self._publishers if p.beat_due_ns <= now_ns]
                if due:
                    return None, due
                soonest_ns = min((p.beat_due_ns for p in self._publishers), default=now_ns + BEAT_NS)
                self._wake.wait(max((soonest_ns - now_ns) * 1e-9, 0.001))

    def _run(self) -> None:
        while True:
            item, due = self._next()
            if item is not None:
                self._send(item.record.key, item.record.payload, item.record.header, ENCODING)
                continue
            for publisher in due:
                self._beat(publisher)
            if self._closing and not self._queue:
                return

    def _beat(self, publisher: Publisher) -> None:
        publisher.beat_due_ns = time.monotonic_ns() + BEAT_NS
        beat = publisher.beat()
        if beat is not None:
            key = journal_key(publisher.rig, "meta", publisher.topic)
            self._send(key, msgspec.json.encode(beat), None, JSON_ENCODING)

    def _send(self, key: str, payload: bytes, header: bytes | None, encoding: str) -> None:
        # A put that fails is a drop: the journal has the record, and the reconnecting session will carry the refill.
        with contextlib.suppress(zenoh.ZError):
            self._session.put(
                key,
                payload,
                encoding=encoding,
                attachment=header,
                congestion_control=zenoh.CongestionControl.DROP,
            )


class Publisher:
    """Publishes one topic. Made by `Bus.publisher`."""

    def __init__(
        self, session: zenoh.Session, outbox: Outbox, journal: Journal, rig: str, boot: str, clock: Clock, topic: Topic
    ) -> None:
        self.topic = topic
        self._clock = clock
        self.rig = rig
        self.beat_due_ns = time.monotonic_ns() + BEAT_NS
        self._active_ns = 0
        self._boot = boot
        self._outbox = outbox
        self._journal = journal
        self._seq = 0
        self._dropped = 0
        self._lock = threading.Lock()
        self._server = JournalServer(session, rig, "journal/live", topic, _OwnJournal(journal, boot))
        outbox.register(self)

    def put(
        self,
        array: NDArray[np.generic],
        *,
        scan: str = "",
        pass_name: str = "",
        trigger: int = -1,
        attempt: int = 0,
        calibration: str = "",
        source: Source | None = None,
        t_ns: int | None = None,
    ) -> int:
        """Hand a record over for sending and return its sequence number; never waits for the network.

        Parameters
        ----------
        array
            Of the topic's dtype and shape; it is copied.
        scan, pass_name, trigger, attempt, calibration, source
            Header fields, see `Header`.
        t_ns
            CLOCK_MONOTONIC of the capture; now, if not given.

        Raises
        ------
        PayloadError
            The array is not what the topic table promises.
        BusError
            The bus is closed.
        """
        check(array, self.topic)
        payload = encode(array)
        now_ns = self._clock.monotonic_ns()
        captured_ns = now_ns if t_ns is None else t_ns
        with self._lock:
            seq = self._seq
            header = Header(
                stream=self.topic.name,
                seq=seq,
                t_ns=captured_ns,
                t_wall_ns=self._clock.wall_ns() - (now_ns - captured_ns),
                boot=self._boot,
                scan=scan,
                pass_name=pass_name,
                trigger=trigger,
                attempt=attempt,
                calibration=calibration,
                source=source if source is not None else Source(),
            )
            key = topics.key(self.rig, "data", self.topic, trigger)
            record = Record(key, seq, now_ns, encode_header(header), payload)
            self._outbox.add(self, record)
            self._journal.add(self.topic.name, record)
            self._seq += 1
            self._active_ns = time.monotonic_ns()
            self.beat_due_ns = self._active_ns + BEAT_FIRST_NS
        return seq

    def put_json(
        self,
        obj: object,
        *,
        scan: str = "",
        pass_name: str = "",
        trigger: int = -1,
        attempt: int = 0,
        calibration: str = "",
        source: Source | None = None,
        t_ns: int | None = None,
    ) -> int:
        """`put` of an object on a JSON topic."""
        return self.put(
            json_array(obj),
            scan=scan,
            pass_name=pass_name,
            trigger=trigger,
            attempt=attempt,
            calibration=calibration,
            source=source,
            t_ns=t_ns,
        )

    @property
    def stats(self) -> dict[str, int]:
        """Records queued and dropped from the queue, records in the journal, and the bytes the whole journal holds."""
        return {
            "queued": self._outbox.queued(self),
            "dropped": self._dropped,
            "journal": self._journal.count(self.topic.name),
            "journal_bytes": self._journal.size,
            "sent": self._seq,
        }

    def count_drop(self) -> None:
        """Note that a record left the queue unsent."""
        self._dropped += 1

    def busy(self) -> bool:
        """Whether a record was put or asked for a moment ago."""
        return time.monotonic_ns() - max(self._active_ns, self._server.asked_ns) < QUIET_NS

    def beat(self) -> Beat | None:
        """First and last sequence number in the journal; None before the first record."""
        span = self._journal.span(self.topic.name)
        return Beat(self._boot, *span) if span else None

    def undeclare(self) -> None:
        """Stop answering; `Bus.close` calls it."""
        self._server.close()


class _OwnJournal:
    """This session's journal as a source of refills."""

    def __init__(self, journal: Journal, boot: str) -> None:
        self._journal = journal
        self._boot = boot

    def span(self, stream: str, boot: str) -> tuple[int, int] | None:
        return self._journal.span(stream) if boot == self._boot else None

    def select(self, stream: str, boot: str, first: int, last: int) -> list[tuple[bytes, bytes]]:
        if boot != self._boot:
            return []
        return [(record.header, record.payload) for record in self._journal.select(stream, first, last)]
