"""The receiving side: a bounded queue per subscription, records in order, gaps refilled from the journals."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Sequence

import msgspec
import zenoh

from echolume_messages import topics
from echolume_messages.bus.journal_server import JSON_ENCODING, Beat, journal_key
from echolume_messages.bus.message import Message
from echolume_messages.bus.tracker import ATTEMPTS_PROMISED, ATTEMPTS_SILENT, Track
from echolume_messages.codec import decode, decode_header
from echolume_messages.errors import PayloadError
from echolume_messages.topics import Topic

QUERY_S = 2.0
RING_RECORDS = 64
BOOTS_PER_STREAM = 4
"""Publisher sessions remembered per stream; older ones are forgotten."""


def read_sample(sample: zenoh.Sample, topic: Topic) -> Message:
    """Message of a zenoh sample; PayloadError if header or payload do not fit the topic."""
    if sample.attachment is None:
        raise PayloadError(f"{topic.name}: a record without a header")
    header = decode_header(sample.attachment.to_bytes())
    if header.stream != topic.name:
        raise PayloadError(f"{topic.name}: a header of stream {header.stream!r}")
    if len(sample.payload) > topic.limit_bytes + 8192:
        raise PayloadError(f"{topic.name}: payload of {len(sample.payload)} bytes, limit {topic.limit_bytes}")
    message = Message(header, topic, decode(sample.payload.to_bytes(), topic))
    if topic.is_json and not isinstance(message.json(), dict):
        raise PayloadError(f"{topic.name}: expected a JSON object")
    return message


class Subscription:
    """Records of some topics. Made by `Bus.subscribe`.

    With `refill`, each publisher's records come in the order of their `seq`, and what the queue had no room for is
    asked for again once it has; without, the queue is a ring that drops its oldest record.
    """

    def __init__(
        self,
        session: zenoh.Session,
        rig: str,
        wanted: Sequence[Topic],
        depth: int,
        refill: bool,
        archive: bool,
        decimated: bool = False,
    ) -> None:
        self._session = session
        self._rig = rig
        self._topics = {topic.name: topic for topic in wanted}
        self._depth = depth
        self._refill = refill
        self._archive = archive
        self._queue: deque[Message] = deque()
        self._tracks: dict[tuple[str, str], Track] = {}
        self._counts = {"received": 0, "refilled": 0, "lost": 0, "dropped": 0, "duplicate": 0, "rejected": 0}
        self._last_error = ""
        self._changed = threading.Condition()
        self._closing = False
        self._subscribers: list[zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]]] = []
        self._threads: list[threading.Thread] = []
        for topic in wanted:
            keys = topics.keys_decimated(rig, "data", topic) if decimated else [topics.key_all(rig, "data", topic)]
            for key in keys:
                self._listen(key, topic)
            if refill:
                self._listen(journal_key(rig, "meta", topic), topic)
        if refill:
            self._start(threading.Thread(target=self._run_refill, name="bus-refill", daemon=True))

    def get(self, timeout_s: float) -> Message | None:
        """The next record, or None if none came within `timeout_s` or the subscription is closed."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not self._queue:
                left_s = deadline - time.monotonic()
                if left_s <= 0 or self._closing:
                    return None
                self._changed.wait(left_s)
            message = self._queue.popleft()
            for track in self._tracks.values():
                self._drain(track)
            self._changed.notify_all()
            return message

    @property
    def stats(self) -> dict[str, int]:
        """Records received, refilled, lost for good, turned away by a full queue, doubled, rejected; queue depth."""
        with self._changed:
            return {**self._counts, "depth": len(self._queue)}

    @property
    def last_error(self) -> str:
        """Why the last rejected record was rejected."""
        return self._last_error

    @property
    def closed(self) -> bool:
        """Whether it has been closed."""
        return self._closing

    def close(self) -> None:
        """Stop receiving."""
        with self._changed:
            self._closing = True
            self._changed.notify_all()
        for subscriber in self._subscribers:
            subscriber.undeclare()
        self._subscribers.clear()
        for thread in self._threads:
            thread.join(QUERY_S + 0.5)
        self._threads.clear()

    def __enter__(self) -> Subscription:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def _start(self, thread: threading.Thread) -> None:
        self._threads.append(thread)
        thread.start()

    def _listen(self, key: str, topic: Topic) -> None:
        subscriber = self._session.declare_subscriber(
            key, zenoh.handlers.RingChannel(max(2, min(self._depth, RING_RECORDS)))
        )
        self._subscribers.append(subscriber)
        self._start(
            threading.Thread(
                target=self._receive, args=(subscriber.handler, topic), name=f"bus-{topic.name}", daemon=True
            )
        )

    def _receive(self, handler: zenoh.handlers.Handler[zenoh.Sample], topic: Topic) -> None:
        """Take samples off zenoh's ring until the subscriber is undeclared."""
        while True:
            try:
                sample = handler.recv()
            except zenoh.ZError:
                return
            self._take(sample, topic, "received")

    def _take(self, sample: zenoh.Sample, topic: Topic, count: str) -> Beat | None:
        """Accept a record, or return the beat that the sample is."""
        try:
            if sample.attachment is None and str(sample.encoding) == JSON_ENCODING:
                beat = msgspec.json.decode(sample.payload.to_bytes(), type=Beat)
                self._notice(topic, beat)
                return beat
            self._accept(read_sample(sample, topic), count)
        except (PayloadError, msgspec.DecodeError) as error:
            with self._changed:
                self._counts["rejected"] += 1
                self._last_error = str(error)
        return None

    def _track(self, stream: str, boot: str) -> Track:
        found = self._tracks.get((stream, boot))
        if found is None:
            found = self._tracks[stream, boot] = Track(stream, boot)
            of_stream = [key for key in self._tracks if key[0] == stream]
            for key in of_stream[:-BOOTS_PER_STREAM]:
                del self._tracks[key]
        return found

    def _notice(self, topic: Topic, beat: Beat) -> None:
        with self._changed:
            self._track(topic.name, beat.boot).notice(beat.last, time.monotonic_ns())
            self._changed.notify_all()

    def _accept(self, message: Message, count: str) -> None:
        header = message.header
        with self._changed:
            if not self._refill:
                self._push_ring(message)
                return
            track = self._track(header.stream, header.boot)
            track.notice(header.seq, time.monotonic_ns())
            if not track.wants(header.seq):
                self._counts["duplicate"] += 1
            elif not self._room(track, header.seq):
                self._counts["dropped"] += 1
            else:
                track.held[header.seq] = message
                self._counts[count] += 1
                self._drain(track)
            self._changed.notify_all()

    def _push_ring(self, message: Message) -> None:
        self._counts["received"] += 1
        self._queue.append(message)
        if len(self._queue) > self._depth:
            self._queue.popleft()
            self._counts["dropped"] += 1
        self._changed.notify_all()

    def _room(self, track: Track, seq: int) -> bool:
        """Whether a record may be kept: always if it brings its stream on, else while there is room."""
        if seq < min(track.held, default=track.following + 1):
            return True
        return sum(len(t.held) for t in self._tracks.values()) < self._depth

    def _drain(self, track: Track) -> None:
        while track.ready() and len(self._queue) < self._depth:
            self._queue.append(track.pop())

    def _next_gap(self) -> tuple[Track, int, int] | None:
        """Wait for a gap that may be asked for; None when the subscription closes."""
        with self._changed:
            while not self._closing:
                now_ns = time.monotonic_ns()
                open_gaps = [(t.due_ns, t, gap) for t in self._tracks.values() if (gap := t.gap()) is not None]
                if len(self._queue) > self._depth // 2:
                    open_gaps = []  # the consumer is behind: what it has no room for is asked for later
                due_ns, track, gap = min(open_gaps, key=lambda g: g[0], default=(0, None, (0, 0)))
                if track is not None and due_ns <= now_ns:
                    return track, *gap
                self._changed.wait((due_ns - now_ns) * 1e-9 if track is not None else None)
            return None

    def _run_refill(self) -> None:
        while (found := self._next_gap()) is not None:
            track, first, last = found
            span = self._ask("journal/live", track, first, last)
            with self._changed:
                moved = track.following > first
                fresh = track.fresh
            if moved:
                continue
            promised = span is not None and span.first <= first
            if not promised and not fresh and self._archive:
                self._ask("journal/archive", track, first, last)
            with self._changed:
                self._settle(track, first, span)
                self._changed.notify_all()

    def _settle(self, track: Track, first: int, span: Beat | None) -> None:
        """After an answer that did not bring the record that is due: ask again, or step over it."""
        gap = track.gap()
        if gap is None or gap[0] != first:
            return
        now_ns = time.monotonic_ns()
        if span is None:
            again = track.later(now_ns, ATTEMPTS_SILENT)
            to_seq = gap[1] + 1
        else:
            again = span.first <= first and track.later(now_ns, ATTEMPTS_PROMISED)
            to_seq = min(span.first, gap[1] + 1) if span.first > first else gap[1] + 1
        if not again:
            self._counts["lost"] += track.step_over(to_seq)
            self._drain(track)

    def _ask(self, tree: str, track: Track, first: int, last: int) -> Beat | None:
        """Ask a journal for a gap; what it spans, or None if nobody answered."""
        topic = self._topics[track.stream]
        key = journal_key(self._rig, tree, topic)
        span: Beat | None = None
        try:
            replies = self._session.get(
                f"{key}?boot={track.boot};from={first};to={last}",
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,
                timeout=QUERY_S,
                congestion_control=zenoh.CongestionControl.DROP,
                priority=zenoh.Priority.DATA_LOW,
            )
            for reply in replies:
                if reply.ok is not None:
                    span = self._take(reply.ok, topic, "refilled") or span
        except zenoh.ZError as error:
            self._last_error = f"{track.stream}: refill: {error}"
        return span
