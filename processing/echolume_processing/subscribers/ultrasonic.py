"""The ultrasonic subscriber: echoes in, contact points of each ping out."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np

from echolume_messages import topics
from echolume_messages.bus import Bus, Message
from echolume_messages.calibration import Calibration
from echolume_messages.errors import CalibrationMissingError
from echolume_messages.rig import Rig
from echolume_processing.ping import ping_from_record
from echolume_processing.subscribers.frame import run_subscriber
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline

ECHOES_DEPTH = 256
HELD_PINGS = 64
"""Pings of a scan whose start is not known yet; with more, echoes wait in the journals."""
PATIENCE_S = 15.0
"""How long the start of an unknown scan may take to be refilled before its echoes are given up."""
MAX_SCANS = 8

log = logging.getLogger("echolume.ultrasonic")


@dataclass(frozen=True)
class ScanSetup:
    """What the start of a scan says; without a calibration there is no pipeline, and its pings are skipped."""

    pipeline: UltrasonicPipeline | None
    digest: str


class _Start(msgspec.Struct):
    scan: str
    calibration: msgspec.Raw = msgspec.Raw(b"null")


def read_start(message: Message, rig: str) -> tuple[str, ScanSetup]:
    """Scan id and set-up from a ``conductor/start`` record.

    Raises
    ------
    CalibrationMissingError
        If its calibration is not one of this rig.
    """
    try:
        start = msgspec.json.decode(message.payload.tobytes(), type=_Start)
        raw = bytes(start.calibration)
        calibration = None if raw == b"null" else msgspec.json.decode(raw, type=Calibration)
    except msgspec.DecodeError as error:
        raise CalibrationMissingError(f"conductor/start seq {message.header.seq}: {error}") from error
    if calibration is None:
        return start.scan, ScanSetup(None, "")
    if calibration.rig != rig:
        raise CalibrationMissingError(
            f"scan {start.scan}: its calibration is of rig {calibration.rig!r}, this is {rig!r}"
        )
    try:
        pipeline = UltrasonicPipeline(calibration)
    except ValueError as error:
        raise CalibrationMissingError(
            f"scan {start.scan}: its calibration of the array is unusable: {error}"
        ) from error
    return start.scan, ScanSetup(pipeline, calibration.digest)


class UltrasonicSubscriber:
    """Processes the pings of every scan that has a calibration, and publishes their contact points."""

    def __init__(self, bus: Bus, rig: Rig) -> None:
        self._rig = rig.name
        self._starts = bus.subscribe([topics.SCAN_START], depth=8)
        self._echoes = bus.subscribe([topics.ECHOES], depth=ECHOES_DEPTH)
        self._points = bus.publisher(topics.ULTRASONIC_POINTS)
        self._scans: dict[str, ScanSetup] = {}
        self._held: dict[str, list[Message]] = {}
        self._waiting_since_s: dict[str, float] = {}
        self._counts = {"pings": 0, "points": 0, "skipped": 0, "given_up": 0}
        self._busy_ms = 0.0

    def step(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` for a record, and work on it."""
        while (message := self._starts.get(0.0)) is not None:
            self._begin(message)
        if sum(len(pings) for pings in self._held.values()) >= HELD_PINGS:
            started = self._starts.get(timeout_s)
            if started is not None:
                self._begin(started)
            self._give_up()
            return
        ping = self._echoes.get(timeout_s)
        if ping is not None:
            self._take(ping)

    def health(self) -> dict[str, object]:
        """Counts, the last ping's processing time, and the state of the subscription."""
        return {**self._counts, "ms_per_ping": round(self._busy_ms, 2), "echoes": self._echoes.stats}

    def close(self) -> None:
        """Stop receiving."""
        self._starts.close()
        self._echoes.close()

    def _begin(self, message: Message) -> None:
        try:
            scan, setup = read_start(message, self._rig)
        except CalibrationMissingError as error:
            log.error("scan not processed: %s", error)
            scan, setup = message.header.scan, ScanSetup(None, "")
        self._remember(scan, setup)
        for ping in self._held.pop(scan, []):
            self._take(ping)

    def _remember(self, scan: str, setup: ScanSetup) -> None:
        self._scans[scan] = setup
        self._waiting_since_s.pop(scan, None)
        if len(self._scans) > MAX_SCANS:
            del self._scans[next(iter(self._scans))]

    def _give_up(self) -> None:
        """Let go of the echoes of scans whose start cannot be got any more."""
        now_s = time.monotonic()
        for scan, since_s in list(self._waiting_since_s.items()):
            if now_s - since_s > PATIENCE_S:
                log.warning("scan %s: its start was not received in %.0f s, its echoes are skipped", scan, PATIENCE_S)
                self._counts["given_up"] += len(self._held.pop(scan, []))
                self._remember(scan, ScanSetup(None, ""))

    def _take(self, message: Message) -> None:
        header = message.header
        setup = self._scans.get(header.scan)
        if setup is None:
            self._waiting_since_s.setdefault(header.scan, time.monotonic())
            self._held.setdefault(header.scan, []).append(message)
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
    return run_subscriber("ultrasonic", UltrasonicSubscriber, bus, rig, stop)
