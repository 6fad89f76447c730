"""A rig without devices on a free loopback endpoint, and a lab's subscriber that runs on it."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from echolume_messages import rig as rig_file
from echolume_messages.bus import Bus, connect
from echolume_messages.bus.router import open_router
from echolume_messages.rig import Rig

DEADLINE_S = 20.0


def free_endpoint() -> str:
    """An endpoint that nobody uses."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return f"tcp/127.0.0.1:{probe.getsockname()[1]}"


def lab_rig() -> Rig:
    """What a subscriber needs of a rig: its name and its bus; there are no devices."""
    return rig_file.parse(
        f"""
        name = "test"
        [bus]
        endpoint = "{free_endpoint()}"
        [guide]
        port = "none"
        [trigger]
        port = "none"
        [cameras.left]
        address = "none"
        [cameras.right]
        address = "none"
        [robot]
        [array]
        port = "none"
        [recorder]
        directory = "/none"
        """
    )


@contextmanager
def running_subscriber(name: str, rig: Rig, main: Callable[[threading.Event], int]) -> Iterator[Bus]:
    """A router, the subscriber on it, and the bus of everybody else; the subscriber must end with code 0."""
    stop = threading.Event()
    codes: list[int] = []
    with open_router(rig.bus.endpoint), connect(rig.bus.endpoint, rig.name) as bus:
        thread = threading.Thread(target=lambda: codes.append(main(stop)))
        thread.start()
        try:
            deadline_s = time.monotonic() + DEADLINE_S
            while name not in bus.alive():
                assert time.monotonic() < deadline_s, "the subscriber did not come up"
            yield bus
        finally:
            stop.set()
            thread.join(DEADLINE_S)
    assert codes == [0]
