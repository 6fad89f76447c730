"""Answers who missed records: ``journal/live`` from a publisher's memory, ``journal/archive`` from the archive."""

from __future__ import annotations

import contextlib
import threading
import time
from typing import Protocol

import msgspec
import zenoh

from echolume_messages.codec import ENCODING
from echolume_messages.errors import EcholumeError
from echolume_messages.topics import Topic

JSON_ENCODING = "application/json"
WAITING = 32
"""Queries that may wait in line at one journal."""


class Beat(msgspec.Struct, forbid_unknown_fields=True):
    """What there is of a stream: sent now and then while it is quiet, and first in every answer of a journal."""

    boot: str
    first: int
    last: int


class JournalSource(Protocol):
    """Where a journal's records come from."""

    def span(self, stream: str, boot: str) -> tuple[int, int] | None:
        """(first, last) sequence number held of a publisher session, or None."""
        ...

    def select(self, stream: str, boot: str, first: int, last: int) -> list[tuple[bytes, bytes]]:
        """(header, payload) of the oldest records with ``first <= seq <= last``, a bounded number of them."""
        ...


def journal_key(rig: str, tree: str, topic: Topic) -> str:
    """Key of what is said about a stream as a whole (no shard)."""
    return f"echolume/v1/{rig}/{tree}/{topic.name}"


class JournalServer:
    """A queryable ``?boot=..;from=..;to=..`` over one stream, with a thread of its own."""

    def __init__(self, session: zenoh.Session, rig: str, tree: str, topic: Topic, source: JournalSource) -> None:
        self.asked_ns = 0
        """CLOCK_MONOTONIC of the last query."""
        self._key = journal_key(rig, tree, topic)
        self._stream = topic.name
        self._source = source
        self._queryable = session.declare_queryable(self._key, zenoh.handlers.FifoChannel(WAITING))
        self._thread = threading.Thread(
            target=self._run, args=(self._queryable.handler,), name=f"{tree}-{topic.name}", daemon=True
        )
        self._thread.start()

    def close(self) -> None:
        """Stop answering."""
        self._queryable.undeclare()
        self._thread.join(1.0)

    def _run(self, handler: zenoh.handlers.Handler[zenoh.Query]) -> None:
        while True:
            try:
                query = handler.recv()
            except zenoh.ZError:
                return
            self.asked_ns = time.monotonic_ns()
            with query:
                self._answer(query)

    def _answer(self, query: zenoh.Query) -> None:
        wanted = query.parameters
        boot, first, last = (wanted.get(name) or "" for name in ("boot", "from", "to"))
        if not (first.isdecimal() and last.isdecimal() and len(first) < 20 and len(last) < 20):
            return
        span = self._source.span(self._stream, boot)
        if span is None:
            return
        records: list[tuple[bytes, bytes]] = []
        refusal = ""
        try:
            records = self._source.select(self._stream, boot, int(first), int(last))
        except EcholumeError as error:
            refusal = str(error)
        # The asker may have gone; what it still misses it asks for again.
        with contextlib.suppress(zenoh.ZError):
            query.reply(self._key, msgspec.json.encode(Beat(boot, *span)), encoding=JSON_ENCODING)
            for header, payload in records:
                query.reply(self._key, payload, encoding=ENCODING, attachment=header)
            if refusal:
                query.reply_err(refusal)
