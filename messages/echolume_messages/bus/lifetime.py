"""The life of a process on the bus: it waits for the router to come up, and a signal ends it in order."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Generator
from contextlib import contextmanager
from types import FrameType

from echolume_messages.bus.client import Bus, connect
from echolume_messages.errors import RouterUnreachableError
from echolume_messages.rig import Rig

ATTEMPT_S = 1.0
FIRST_PAUSE_S, LONGEST_PAUSE_S = 0.1, 2.0


def connect_when_up(
    rig: Rig, stop: threading.Event, on_waiting: Callable[[RouterUnreachableError], None]
) -> Bus | None:
    """Connect to the rig's router, however long it takes to come up.

    Parameters
    ----------
    rig
        Endpoint, name and journal of the bus.
    stop
        Ends the waiting.
    on_waiting
        Told once why the router cannot be reached yet.

    Returns
    -------
    Bus or None
        None if stopped before there was a router.
    """
    pause_s, told = FIRST_PAUSE_S, False
    while not stop.is_set():
        try:
            return connect(
                rig.bus.endpoint,
                rig.name,
                timeout_s=ATTEMPT_S,
                shared_memory=rig.bus.shared_memory,
                journal_s=rig.bus.journal_s,
                journal_mib=rig.bus.journal_mib,
            )
        except RouterUnreachableError as error:
            if not told:
                on_waiting(error)
                told = True
        stop.wait(pause_s)
        pause_s = min(2 * pause_s, LONGEST_PAUSE_S)
    return None


@contextmanager
def stopped_by_signals(stop: threading.Event) -> Generator[None]:
    """SIGTERM and SIGINT set `stop` while the block runs; only the main thread may install handlers."""
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
