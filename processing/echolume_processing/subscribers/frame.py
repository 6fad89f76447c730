"""The frame of a subscriber: bus, signals, liveliness token, and health once a second around a loop of small steps."""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from typing import Protocol

from echolume_messages.bus import Bus
from echolume_messages.bus.lifetime import connect_when_up, stopped_by_signals
from echolume_messages.errors import EcholumeError
from echolume_messages.rig import Rig
from echolume_messages.rig_option import load_rig
from echolume_messages.topics import health

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
        The rig; without one it is read from the default rig file.
    stop
        Ends the subscriber when set.

    Returns
    -------
    int
        0 after an ordinary stop, else the error's exit code; the error is logged.
    """
    rig = rig or load_rig()
    stop = stop or threading.Event()
    log = logging.getLogger(f"echolume.{name}")
    with stopped_by_signals(stop):
        own = None
        if bus is None:
            own = bus = connect_when_up(rig, stop, lambda error: log.warning("waiting for the router: %s", error))
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
