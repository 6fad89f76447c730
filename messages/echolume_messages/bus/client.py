"""The bus as a service or a lab PC sees it: publish, subscribe, serve, request, alive."""

from __future__ import annotations

import atexit
import secrets
import threading
from collections.abc import Callable, Mapping, Sequence

import zenoh

from echolume_messages import topics
from echolume_messages.bus.commands import CommandServer, Handler, request
from echolume_messages.bus.journal import Journal
from echolume_messages.bus.journal_server import JournalServer, JournalSource
from echolume_messages.bus.publisher import Outbox, Publisher
from echolume_messages.bus.session import open_client
from echolume_messages.bus.subscription import Subscription
from echolume_messages.clock import Clock, SystemClock
from echolume_messages.topics import Topic


class Bus:
    """A client's session on the bus of one rig. Made by `connect`; close it, or use it in a ``with`` block."""

    def __init__(
        self, session: zenoh.Session, rig: str, journal_s: float, journal_mib: int, clock: Clock | None = None
    ) -> None:
        self.rig = rig
        self.boot = secrets.token_hex(6)
        """Tells this session's sequence numbers from those of a session before or after it."""
        self._session = session
        self._clock = clock or SystemClock()
        limit_bytes = journal_mib << 20
        self._journal = Journal(journal_s, limit_bytes)
        self._outbox = Outbox(session, limit_bytes)
        self._publishers: dict[str, Publisher] = {}
        self._subscriptions: list[Subscription] = []
        self._servers: list[CommandServer | JournalServer] = []
        self._tokens: dict[str, zenoh.LivelinessToken] = {}
        self._watchers: list[tuple[zenoh.Subscriber[zenoh.handlers.Handler[zenoh.Sample]], threading.Thread]] = []
        self._closed = False
        self._lock = threading.Lock()
        atexit.register(self.close)

    def publisher(self, topic: Topic) -> Publisher:
        """The publisher of a topic; one per topic and session."""
        with self._lock:
            found = self._publishers.get(topic.name)
            if found is None:
                found = Publisher(self._session, self._outbox, self._journal, self.rig, self.boot, self._clock, topic)
                self._publishers[topic.name] = found
            return found

    def subscribe(
        self,
        wanted: Sequence[Topic],
        depth: int = 64,
        refill: bool = True,
        archive: bool = True,
        decimated: bool = False,
    ) -> Subscription:
        """Receive some topics.

        Parameters
        ----------
        wanted
            Rows of the topic table.
        depth
            Records that may wait for the reader.
        refill
            Records missed are asked for from the journals, and each stream comes in order; else the newest win.
        archive
            Ask the recorder too for what is no longer in the publisher's journal.
        decimated
            For looking on: only every `live_decimation`-th trigger of a topic crosses the wire. Nothing is refilled.
        """
        subscription = Subscription(
            self._session, self.rig, wanted, depth, refill and not decimated, archive, decimated
        )
        self._subscriptions = [s for s in self._subscriptions if not s.closed] + [subscription]
        return subscription

    def serve(self, service: str, handlers: Mapping[str, Handler]) -> None:
        """Answer commands, one after the other, in a thread of this call's own.

        A command that must get through while another one is at work goes into a `serve` call of its own. An
        EcholumeError of a handler is sent back as the refusal. A command whose sender no longer waits is not executed.
        """
        self._servers.append(CommandServer(self._session, self.rig, service, handlers))

    def serve_archive(self, wanted: Sequence[Topic], source: JournalSource) -> None:
        """Answer subscribers that miss records which have left their publisher's journal; the recorder calls it."""
        for topic in wanted:
            self._servers.append(JournalServer(self._session, self.rig, "journal/archive", topic, source))

    def request(
        self, service: str, command: str, body: Mapping[str, object] | None = None, timeout_s: float = 5.0
    ) -> dict[str, object]:
        """Send a command and return the service's answer.

        Raises
        ------
        NoReplyError
            Nobody answered within `timeout_s`.
        CommandRefusedError
            The service said no for a reason that has no class here; `error_name` names it.
        EcholumeError
            The very error that the service raised.
        """
        return request(self._session, self.rig, service, command, body or {}, timeout_s)

    def declare_alive(self, service: str) -> None:
        """Show others that this service lives, until the session ends."""
        with self._lock:
            if service not in self._tokens:
                key = topics.alive_key(self.rig, service)
                self._tokens[service] = self._session.liveliness().declare_token(key)

    def alive(self, timeout_s: float = 2.0) -> set[str]:
        """Services that are alive now."""
        replies = self._session.liveliness().get(topics.alive_key(self.rig, "*"), timeout=timeout_s)
        return {_service(reply.ok) for reply in replies if reply.ok is not None}

    def watch_alive(self, callback: Callable[[str, bool], None]) -> None:
        """Call ``callback(service, alive)`` for each service alive now and at each change, in a thread of its own.

        When the router goes, every service is reported as gone.
        """
        subscriber = self._session.liveliness().declare_subscriber(
            topics.alive_key(self.rig, "*"), zenoh.handlers.FifoChannel(256), history=True
        )

        def run(handler: zenoh.handlers.Handler[zenoh.Sample]) -> None:
            while True:
                try:
                    sample = handler.recv()
                except zenoh.ZError:
                    return
                callback(_service(sample), sample.kind == zenoh.SampleKind.PUT)

        thread = threading.Thread(target=run, args=(subscriber.handler,), name="bus-alive", daemon=True)
        thread.start()
        self._watchers.append((subscriber, thread))

    @property
    def connected(self) -> bool:
        """Whether a router is reached at this moment."""
        return bool(self._session.info.routers_zid())

    def close(self) -> None:
        """Send what is queued (for at most 2 s), then leave the bus; a second call does nothing."""
        with self._lock:
            if self._closed:
                return
            self._closed = True
        atexit.unregister(self.close)
        for server in self._servers:
            server.close()
        self._outbox.close()
        for subscription in self._subscriptions:
            subscription.close()
        for publisher in self._publishers.values():
            publisher.undeclare()
        for subscriber, _ in self._watchers:
            subscriber.undeclare()
        self._session.close()
        for _, thread in self._watchers:
            if thread is not threading.current_thread():
                thread.join(1.0)

    def __enter__(self) -> Bus:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _service(sample: zenoh.Sample) -> str:
    return str(sample.key_expr).rsplit("/", 1)[-1]


def connect(
    endpoint: str,
    rig: str,
    *,
    timeout_s: float = 5.0,
    shared_memory: bool = False,
    journal_s: float = 5.0,
    journal_mib: int = 256,
    clock: Clock | None = None,
) -> Bus:
    """Join the bus of a rig.

    Parameters
    ----------
    endpoint
        Where the router listens, e.g. ``tcp/127.0.0.1:7447``.
    rig
        Name of the rig, as in its rig file.
    timeout_s
        How long to wait for the router.
    shared_memory
        Carry large records to clients on the same machine in shared memory.
    journal_s, journal_mib
        How much of what this session publishes is kept for subscribers that missed it.
    clock
        Stamps the records; the machine's, if not given.

    Raises
    ------
    RouterUnreachableError
        No router answered.

    Examples
    --------
    ::

        with connect("tcp/127.0.0.1:7447", "demo") as bus:
            with bus.subscribe([topics.CAMERA_LEFT]) as frames:
                message = frames.get(timeout_s=10)
    """
    return Bus(open_client(endpoint, timeout_s, shared_memory), rig, journal_s, journal_mib, clock)
