"""The frame of a subscriber: bus, signals, liveliness token, and health once a second around a loop of small steps."""

from __future__ import annotations

import logging
import os
import signal
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from pathlib import Path
from types import FrameType
from typing import Protocol

from echolume_messages import rig as rig_file
from echolume_messages.bus import Bus, connect
from echolume_messages.errors import EcholumeError, RouterUnreachableError
from echolume_messages.rig import Rig
from echolume_messages.topics import health

DEFAULT_RIG = "/etc/echolume/rig.toml"
STEP_S = 0.2
HEALTH_S = 1.0


class Worker(Protocol):
    """What a subscriber adds to the frame."""

    def step(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` for a record, and work on it."""
        ...

    def health(self) -> dict[str, object]:
        """Counts and queue depths, published once a second."""
        ...

    def close(self) -> None:
        """Stop receiving."""
        ...


def run_subscriber(
    name: str,
    make: Callable[[Bus, Rig], Worker],
    bus: Bus | None = None,
    rig: Rig | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run one subscriber until SIGTERM, SIGINT or `stop`.

    Parameters
    ----------
    name
        As in its topics.
    make
        Builds the subscriber; warm-up belongs there, it is announced as alive afterwards.
    bus
        A bus that somebody else owns; without one the subscriber connects, and waits for the router.
    rig
        The rig; without one it is read from ``$ECHOLUME_RIG``, else /etc/echolume/rig.toml.
    stop
        Ends the subscriber when set.

    Returns
    -------
    int
        0 after an ordinary stop, else the error's exit code; the error is logged.
    """
    rig = rig or rig_file.load(Path(os.environ.get("ECHOLUME_RIG", "") or DEFAULT_RIG))
    stop = stop or threading.Event()
    log = logging.getLogger(f"echolume.{name}")
    with _signals(stop):
        own = None
        if bus is None:
            own = bus = _connect(rig, stop, log)
        if bus is None:
            return 0
        try:
            _run(name, make(bus, rig), bus, stop, log)
        except EcholumeError as error:
            log.error("stopped: %s", error)
            return error.exit_code
        finally:
            if own is not None:
                own.close()
    log.info("stopped")
    return 0


def _run(name: str, worker: Worker, bus: Bus, stop: threading.Event, log: logging.Logger) -> None:
    publisher = bus.publisher(health(name))
    next_s = time.monotonic()
    try:
        bus.declare_alive(name)
        log.info("ready")
        while not stop.is_set():
            worker.step(STEP_S)
            if time.monotonic() >= next_s:
                publisher.put_json({"service": name, "pid": os.getpid(), **worker.health()})
                next_s = time.monotonic() + HEALTH_S
    finally:
        worker.close()


def _connect(rig: Rig, stop: threading.Event, log: logging.Logger) -> Bus | None:
    """Connect to the router, however long it takes to come up; None if stopped before."""
    said = False
    while not stop.is_set():
        try:
            return connect(
                rig.bus.endpoint,
                rig.name,
                timeout_s=2.0,
                shared_memory=rig.bus.shared_memory,
                journal_s=rig.bus.journal_s,
                journal_mib=rig.bus.journal_mib,
            )
        except RouterUnreachableError as error:
            if not said:
                log.warning("waiting for the router: %s", error)
                said = True
        stop.wait(0.5)
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
