"""Commands are queries: the service's own answer or its refusal comes back; no reply is a failure."""

from __future__ import annotations

import logging
import queue
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import msgspec
import zenoh

from echolume_messages import errors, topics
from echolume_messages.errors import CommandRefusedError, EcholumeError, NoReplyError

Handler = Callable[[dict[str, object]], Mapping[str, object]]
WAITING = 32
"""Commands that may wait in line at one service."""

logger = logging.getLogger(__name__)


class _Refusal(msgspec.Struct):
    error: str
    message: str


class _Order(msgspec.Struct, forbid_unknown_fields=True):
    timeout_s: float
    body: dict[str, object] = msgspec.field(default_factory=dict[str, object])


@dataclass(frozen=True)
class _Waiting:
    query: zenoh.Query
    key: str
    command: str
    arrived_s: float


class CommandServer:
    """Answers the commands of one `Bus.serve` call, one after the other, in a thread of its own."""

    def __init__(self, session: zenoh.Session, rig: str, service: str, handlers: Mapping[str, Handler]) -> None:
        self._service = service
        self._handlers = dict(handlers)
        self._line: queue.Queue[_Waiting | None] = queue.Queue(WAITING)
        self._queryables = [
            self._declare(session, topics.command_key(rig, service, command), command) for command in handlers
        ]
        self._thread = threading.Thread(target=self._run, name=f"serve-{service}", daemon=True)
        self._thread.start()

    def _declare(self, session: zenoh.Session, key: str, command: str) -> zenoh.Queryable[None]:
        def enqueue(query: zenoh.Query) -> None:
            try:
                self._line.put_nowait(_Waiting(query, key, command, time.monotonic()))
            except queue.Full:
                query.drop()  # the sender sees no reply

        return session.declare_queryable(key, zenoh.handlers.Callback(enqueue, indirect=False))

    def close(self, wait_s: float = 1.0) -> None:
        """Take no more commands; wait for the one at work for at most `wait_s`."""
        for queryable in self._queryables:
            queryable.undeclare()
        self._queryables.clear()
        while True:
            try:
                waiting = self._line.get_nowait()
            except queue.Empty:
                break
            if waiting is not None:
                waiting.query.drop()
        self._line.put(None)
        self._thread.join(wait_s)

    def _run(self) -> None:
        while (waiting := self._line.get()) is not None:
            with waiting.query:
                self._answer(waiting)

    def _answer(self, waiting: _Waiting) -> None:
        query = waiting.query
        payload = query.payload
        try:
            order = msgspec.json.decode(payload.to_bytes() if payload is not None else b"", type=_Order)
            # Nobody waits for it any more; to move or fire now would surprise whoever has given up.
            if time.monotonic() - waiting.arrived_s > order.timeout_s:
                return
            reply = msgspec.json.encode(self._handlers[waiting.command](order.body))
        except EcholumeError as error:
            self._refuse(query, type(error).__name__, str(error))
        except msgspec.DecodeError as error:
            self._refuse(query, "PayloadError", f"{self._service}.{waiting.command}: {error}")
        except Exception as error:
            logger.exception("%s.%s failed", self._service, waiting.command)
            self._refuse(query, type(error).__name__, f"{self._service}.{waiting.command}: internal error: {error}")
        else:
            try:
                query.reply(waiting.key, reply, encoding="application/json")
            except zenoh.ZError as error:
                logger.warning("%s.%s: the answer could not be sent: %s", self._service, waiting.command, error)

    def _refuse(self, query: zenoh.Query, name: str, message: str) -> None:
        try:
            query.reply_err(msgspec.json.encode(_Refusal(name, message)), encoding="application/json")
        except zenoh.ZError as error:
            logger.warning("%s: the refusal could not be sent: %s (%s)", self._service, message, error)


def _raise_refusal(data: bytes, service: str, command: str, timeout_s: float) -> None:
    if data == b"Timeout":
        raise NoReplyError(
            f"{service}.{command}: no answer within {timeout_s:g} s; the service is alive but busy or hung"
        )
    try:
        refusal = msgspec.json.decode(data, type=_Refusal)
    except msgspec.DecodeError:
        raise CommandRefusedError(f"{service}.{command}: {data[:200]!r}") from None
    known: object = getattr(errors, refusal.error, None)
    if isinstance(known, type) and issubclass(known, EcholumeError):
        raise known(refusal.message)
    refused = CommandRefusedError(refusal.message)
    refused.error_name = refusal.error
    raise refused


def request(
    session: zenoh.Session, rig: str, service: str, command: str, body: Mapping[str, object], timeout_s: float
) -> dict[str, object]:
    """Send one command and return the service's answer; see `Bus.request`."""
    replies = session.get(
        topics.command_key(rig, service, command),
        payload=msgspec.json.encode({"timeout_s": timeout_s, "body": body}),
        encoding="application/json",
        timeout=timeout_s,
        consolidation=zenoh.ConsolidationMode.NONE,
        congestion_control=zenoh.CongestionControl.BLOCK,
        priority=zenoh.Priority.INTERACTIVE_HIGH,
    )
    for reply in replies:
        if reply.ok is not None:
            answer: object = msgspec.json.decode(reply.ok.payload.to_bytes())
            if isinstance(answer, dict):
                return answer
        elif reply.err is not None:
            _raise_refusal(reply.err.payload.to_bytes(), service, command, timeout_s)
    raise NoReplyError(
        f"{service}.{command}: nobody answered: is `echolume serve {service}` running on rig {rig!r}, "
        "does it know this command, and may this user send it?"
    )
