"""The frame of every service: signals, bus, liveliness token, health, and a watchdog that asks every loop."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable, Generator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol, TypeAlias

from echolume_daemon.body import Json
from echolume_daemon.notify import notify, watchdog_period_s
from echolume_messages.bus import Bus
from echolume_messages.bus.lifetime import connect_when_up, stopped_by_signals
from echolume_messages.errors import EcholumeError, RouterUnreachableError
from echolume_messages.rig import Rig
from echolume_messages.rig_option import load_rig
from echolume_messages.topics import BY_NAME, health

Handler: TypeAlias = Callable[[Json], Json]

_HEALTH_PERIOD_S = 1.0
_TICK_S = 0.1


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
        Exit code: 0 after an ordinary stop, after a failure (which is logged) the error's own, or 1.
    """
    rig = rig or load_rig()
    stop = stop or threading.Event()
    with stopped_by_signals(stop):
        if bus is not None:
            return _run(Service(name, rig, bus, stop), make)
        own = connect_when_up(rig, stop, lambda error: _waiting(name, rig, error))
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
        return service.failure.exit_code if isinstance(service.failure, EcholumeError) else 1
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


def _waiting(name: str, rig: Rig, error: RouterUnreachableError) -> None:
    logging.getLogger(f"echolume.{name}").warning("waiting for the router: %s", error)
    notify(f"STATUS=waiting for the router at {rig.bus.endpoint}")


def _trace(error: BaseException) -> BaseException | None:
    """Only what we did not foresee is worth a stack trace."""
    return None if isinstance(error, EcholumeError) else error
