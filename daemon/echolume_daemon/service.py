"""The frame of every service: signals, bus, liveliness token, health, and a watchdog that asks every loop."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType
from typing import Protocol, TypeAlias

from echolume_daemon.notify import notify, watchdog_period_s
from echolume_messages import rig as rig_file
from echolume_messages.bus import Bus, connect
from echolume_messages.errors import EcholumeError, RouterUnreachableError
from echolume_messages.rig import Rig
from echolume_messages.topics import BY_NAME, health

Json: TypeAlias = dict[str, object]
Handler: TypeAlias = Callable[[Json], Json]

DEFAULT_RIG = "/etc/echolume/rig.toml"
_HEALTH_PERIOD_S = 1.0
_TICK_S = 0.1
_BACK_OFF_S = (0.1, 2.0)


@dataclass
class Loop:
    """One loop of a service and its promise to answer again in time.

    A loop that waits for work rests; while it works it owes an answer within its limit.
    """

    name: str
    limit_s: float
    now_s: Callable[[], float] = time.monotonic
    _due_s: float | None = None

    def answer(self, within_s: float | None = None) -> None:
        """Say "I am here", and promise to say so again `within_s` (default: the loop's limit)."""
        self._due_s = self.now_s() + (self.limit_s if within_s is None else within_s)

    def rest(self) -> None:
        """Nothing to do until work arrives: no answer is owed."""
        self._due_s = None

    @property
    def late_s(self) -> float:
        """How long the answer is overdue; 0 if it is not."""
        due_s = self._due_s
        return 0.0 if due_s is None else max(0.0, self.now_s() - due_s)

    @contextmanager
    def working(self, within_s: float | None = None) -> Generator[None]:
        """Owe an answer while the block runs."""
        self.answer(within_s)
        try:
            yield
        finally:
            self.rest()


class Part(Protocol):
    """What a service adds to the frame."""

    def health(self) -> Json:
        """State of the part, published once a second."""
        ...

    def close(self) -> None:
        """Go to the safe state and let go of the devices."""
        ...


@dataclass
class Service:
    """What the frame gives to the part: bus, rig, stop event, loops and commands."""

    name: str
    rig: Rig
    bus: Bus
    stop: threading.Event
    loops: list[Loop] = field(default_factory=list[Loop])
    failure: BaseException | None = None
    _threads: list[threading.Thread] = field(default_factory=list[threading.Thread])

    def __post_init__(self) -> None:
        self.log = logging.getLogger(f"echolume.{self.name}")

    def loop(self, name: str, limit_s: float) -> Loop:
        """Register a loop with the watchdog."""
        made = Loop(name, limit_s)
        self.loops.append(made)
        return made

    def thread(self, name: str, body: Callable[[Loop], None], limit_s: float) -> None:
        """Call `body(loop)` over and over in a thread of its own until the service stops.

        An exception that `body` lets out ends the service: a loop that is gone must not go unnoticed.
        """
        loop = self.loop(name, limit_s)

        def run() -> None:
            try:
                while not self.stop.is_set():
                    loop.answer()
                    body(loop)
            except Exception as error:  # noqa: BLE001  the frame reports it and ends the service
                self.failure = error
                self.stop.set()
            finally:
                loop.rest()

        made = threading.Thread(target=run, name=f"{self.name}.{name}", daemon=True)
        self._threads.append(made)
        made.start()

    def serve(self, commands: Mapping[str, Handler], limit_s: float = 30.0) -> None:
        """Answer commands, one after the other; while one is worked on, the watchdog waits for it at most `limit_s`.

        Each call answers in a thread of its own: what must get through at once goes into a call of its own.
        """
        loop = self.loop("commands " + "/".join(commands), limit_s)

        def watched(handler: Handler) -> Handler:
            def handle(body: Json) -> Json:
                with loop.working():
                    return handler(body)

            return handle

        self.bus.serve(self.name, {name: watched(handler) for name, handler in commands.items()})

    def late(self) -> dict[str, float]:
        """Loops that owe an answer, with the seconds they are late."""
        return {loop.name: round(loop.late_s, 3) for loop in self.loops if loop.late_s > 0}

    def join(self, timeout_s: float = 2.0) -> None:
        """Wait for the threads to see the stop."""
        deadline_s = time.monotonic() + timeout_s
        for thread in self._threads:
            thread.join(max(0.0, deadline_s - time.monotonic()))
            if thread.is_alive():
                self.log.warning("loop %s did not stop within %.1f s", thread.name, timeout_s)


def load_rig(path: Path | str | None = None) -> Rig:
    """Read the rig file: `path`, else ``$ECHOLUME_RIG``, else /etc/echolume/rig.toml."""
    return rig_file.load(Path(path or os.environ.get("ECHOLUME_RIG", "") or DEFAULT_RIG))


def run_service(
    name: str,
    make: Callable[[Service], Part],
    bus: Bus | None = None,
    rig: Rig | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run one service until SIGTERM, SIGINT or `stop`.

    Parameters
    ----------
    name
        Name of the service, as in its topics and commands.
    make
        Builds the service's part; it may start threads and serve commands.
    bus
        A bus that somebody else owns (tests, the demo); without one the service connects, and waits for the router.
    rig
        The rig; without one it is read from the rig file.
    stop
        Ends the service when set.

    Returns
    -------
    int
        Exit code: 0 after an ordinary stop, 1 after a failure (which is logged).
    """
    rig = rig or load_rig()
    stop = stop or threading.Event()
    with _signals(stop):
        if bus is not None:
            return _run(Service(name, rig, bus, stop), make)
        own = _connect(name, rig, stop)
        if own is None:
            return 0
        with own:
            return _run(Service(name, rig, own, stop), make)


def _run(service: Service, make: Callable[[Service], Part]) -> int:
    part: Part | None = None
    try:
        part = make(service)
        service.bus.declare_alive(service.name)
        service.log.info("ready")
        notify("READY=1", f"STATUS=rig {service.rig.name}")
        _watch(service, part)
    except EcholumeError as error:
        service.failure = error
    finally:
        notify("STOPPING=1")
        service.stop.set()
        if part is not None:
            part.close()
        service.join()
    if service.failure is not None:
        service.log.error("stopped: %s", service.failure, exc_info=_trace(service.failure))
        return 1
    service.log.info("stopped")
    return 0


def _watch(service: Service, part: Part) -> None:
    """Publish health once a second and stroke the watchdog while every loop answers."""
    topic = health(service.name)
    publisher = service.bus.publisher(topic) if topic.name in BY_NAME else None
    watchdog_s = watchdog_period_s()
    next_health_s = next_stroke_s = time.monotonic()
    was_late = False
    while not service.stop.wait(min(_TICK_S, watchdog_s or _TICK_S)):
        now_s = time.monotonic()
        late = service.late()
        if late and not was_late:
            service.log.error("loops do not answer: %s", ", ".join(f"{k} ({v:.1f} s late)" for k, v in late.items()))
        was_late = bool(late)
        if watchdog_s is not None and not late and now_s >= next_stroke_s:
            notify("WATCHDOG=1")
            next_stroke_s = now_s + watchdog_s
        if publisher is not None and now_s >= next_health_s:
            publisher.put_json({"service": service.name, "pid": os.getpid(), "late": late, **part.health()})
            next_health_s = now_s + _HEALTH_PERIOD_S


def _connect(name: str, rig: Rig, stop: threading.Event) -> Bus | None:
    """Connect to the router, however long it takes to come up; None if stopped before."""
    wait_s, longest_s = _BACK_OFF_S
    said = False
    while not stop.is_set():
        try:
            return connect(
                rig.bus.endpoint,
                rig.name,
                timeout_s=1.0,
                shared_memory=rig.bus.shared_memory,
                journal_s=rig.bus.journal_s,
                journal_mib=rig.bus.journal_mib,
            )
        except RouterUnreachableError as error:
            if not said:
                logging.getLogger(f"echolume.{name}").warning("waiting for the router: %s", error)
                notify(f"STATUS=waiting for the router at {rig.bus.endpoint}")
                said = True
        stop.wait(wait_s)
        wait_s = min(2 * wait_s, longest_s)
    return None


@contextmanager
def _signals(stop: threading.Event) -> Generator[None]:
    """SIGTERM and SIGINT set `stop`; only the main thread may install handlers."""
    if threading.current_thread() is not threading.main_thread():
        yield
        return

    def handle(_number: int, _frame: FrameType | None) -> None:
        stop.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGTERM, signal.SIGINT)}
    try:
        yield
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)


def _trace(error: BaseException) -> BaseException | None:
    """Only what we did not foresee is worth a stack trace."""
    return None if isinstance(error, EcholumeError) else error
