"""The ultrasonic subscriber: echoes in, contact points of each ping out."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

import numpy as np

from echolume_messages import topics
from echolume_messages.bus import Bus, Message
from echolume_messages.rig import Rig
from echolume_processing.ping import ping_from_record
from echolume_processing.subscribers.frame import run_subscriber
from echolume_processing.subscribers.scans import Scans
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline
from echolume_processing.ultrasonic.warm_up import warm_up

ECHOES_DEPTH = 256
HELD_PINGS = 64
"""Pings of a scan whose start is not known yet; with more, echoes wait in the journals."""

log = logging.getLogger("echolume.ultrasonic")


class UltrasonicSubscriber:
    """Processes the pings of every scan that has a calibration, and publishes their contact points."""

    def __init__(self, bus: Bus, rig: Rig) -> None:
        self._starts = bus.subscribe([topics.SCAN_START], depth=8)
        self._echoes = bus.subscribe([topics.ECHOES], depth=ECHOES_DEPTH)
        self._points = bus.publisher(topics.ULTRASONIC_POINTS)
        self._scans = Scans[UltrasonicPipeline, Message](self._starts, rig.name, UltrasonicPipeline, HELD_PINGS, log)
        self._counts = {"pings": 0, "points": 0, "skipped": 0}
        self._busy_ms = 0.0

    def step(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` for a record, and work on it."""
        while (held := self._scans.next_start(0.0)) is not None:
            self._take_all(held)
        if self._scans.full:
            self._take_all(self._scans.next_start(timeout_s) or [])
            self._scans.give_up()
            return
        ping = self._echoes.get(timeout_s)
        if ping is not None:
            self._take(ping)

    def health(self) -> dict[str, object]:
        """Counts, the last ping's processing time, and the state of the subscription."""
        return {
            **self._counts,
            "given_up": self._scans.given_up,
            "ms_per_ping": round(self._busy_ms, 2),
            "echoes": self._echoes.stats,
        }

    def close(self) -> None:
        """Stop receiving."""
        self._starts.close()
        self._echoes.close()

    def _take_all(self, pings: list[Message]) -> None:
        for ping in pings:
            self._take(ping)

    def _take(self, message: Message) -> None:
        header = message.header
        setup = self._scans.setup(header.scan, message)
        if setup is None:
            return
        if setup.pipeline is None:
            self._counts["skipped"] += 1
            return
        began_s = time.perf_counter()
        try:
            ping = ping_from_record(header, message.payload.astype(np.int16, copy=False))
            points = setup.pipeline.process(ping)
        except ValueError as error:
            log.error("trigger %d: the ping is skipped: %s", header.trigger, error)
            self._counts["skipped"] += 1
            return
        self._points.put(
            points,
            scan=header.scan,
            pass_name=header.pass_name,
            trigger=header.trigger,
            attempt=header.attempt,
            calibration=setup.digest,
            source=header.source,
            t_ns=header.t_ns,
        )
        self._busy_ms = 1e3 * (time.perf_counter() - began_s)
        self._counts["pings"] += 1
        self._counts["points"] += len(points)


def main(
    bus: Bus | None = None, rig: Rig | None = None, out: Path | None = None, stop: threading.Event | None = None
) -> int:
    """Run the ultrasonic subscriber until it is told to stop; `out` is not used, it writes no files."""
    del out
    return run_subscriber("ultrasonic", _make, bus, rig, stop)


def _make(bus: Bus, rig: Rig) -> UltrasonicSubscriber:
    warm_up()
    return UltrasonicSubscriber(bus, rig)
