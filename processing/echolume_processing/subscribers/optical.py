"""The optical subscriber: camera pairs in, points of each stripe out."""

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
from echolume_processing.optical.pipeline import OpticalPipeline
from echolume_processing.subscribers.frame import run_subscriber
from echolume_processing.subscribers.pairing import Pairs

FRAMES_DEPTH = 24
"""Frames of each camera that may wait in the queue."""
HELD_PAIRS = 8
"""Pairs of a scan whose start is not known yet; with more, frames wait in the journals."""
PATIENCE_S = 15.0
"""How long the start of an unknown scan may take to be refilled before its frames are given up."""
MAX_SCANS = 8

log = logging.getLogger("echolume.optical")


@dataclass(frozen=True)
class ScanSetup:
    """What the start of a scan says: pipeline (None without a calibration), digest, and the optical passes."""

    pipeline: OpticalPipeline | None
    digest: str
    passes: frozenset[str]


class _PassEntry(msgspec.Struct):
    name: str
    kind: str = ""


class _PlanEntry(msgspec.Struct):
    passes: list[_PassEntry] = msgspec.field(name="pass", default_factory=list[_PassEntry])


class _Start(msgspec.Struct):
    scan: str
    plan: _PlanEntry
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
        optical = frozenset(p.name for p in start.plan.passes if p.kind == "optical")
        raw = bytes(start.calibration)
        calibration = None if raw == b"null" else msgspec.json.decode(raw, type=Calibration)
    except msgspec.DecodeError as error:
        raise CalibrationMissingError(f"conductor/start seq {message.header.seq}: {error}") from error
    if calibration is None:
        return start.scan, ScanSetup(None, "", optical)
    if calibration.rig != rig:
        raise CalibrationMissingError(
            f"scan {start.scan}: its calibration is of rig {calibration.rig!r}, this is {rig!r}"
        )
    return start.scan, ScanSetup(OpticalPipeline(calibration), calibration.digest, optical)


class OpticalSubscriber:
    """Processes the optical passes of every scan that has a calibration, and publishes their points."""

    def __init__(self, bus: Bus, rig: Rig) -> None:
        self._rig = rig.name
        self._starts = bus.subscribe([topics.SCAN_START], depth=8)
        self._left = bus.subscribe([topics.CAMERA_LEFT], depth=FRAMES_DEPTH)
        self._right = bus.subscribe([topics.CAMERA_RIGHT], depth=FRAMES_DEPTH)
        self._points = bus.publisher(topics.OPTICAL_POINTS)
        self._pairs = Pairs(self._left, self._right)
        self._scans: dict[str, ScanSetup] = {}
        self._held: dict[str, list[tuple[Message, Message]]] = {}
        self._waiting_since_s: dict[str, float] = {}
        self._counts = {"stripes": 0, "points": 0, "skipped": 0, "given_up": 0}
        self._busy_ms = 0.0

    def step(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` for a record, and work on it."""
        while (message := self._starts.get(0.0)) is not None:
            self._begin(message)
        if sum(len(pairs) for pairs in self._held.values()) >= HELD_PAIRS:
            started = self._starts.get(timeout_s)
            if started is not None:
                self._begin(started)
            self._give_up()
            return
        pair = self._pairs.get(timeout_s)
        if pair is not None:
            self._take(*pair)

    def health(self) -> dict[str, object]:
        """Counts, the last stripe's processing time, and the state of the subscription."""
        return {
            **self._counts,
            "unpaired": self._pairs.unpaired,
            "ms_per_pair": round(self._busy_ms, 2),
            "left": self._left.stats,
            "right": self._right.stats,
        }

    def close(self) -> None:
        """Stop receiving."""
        self._starts.close()
        self._left.close()
        self._right.close()

    def _begin(self, message: Message) -> None:
        try:
            scan, setup = read_start(message, self._rig)
        except CalibrationMissingError as error:
            log.error("scan not processed: %s", error)
            scan, setup = message.header.scan, ScanSetup(None, "", frozenset())
        self._remember(scan, setup)
        for pair in self._held.pop(scan, []):
            self._take(*pair)

    def _remember(self, scan: str, setup: ScanSetup) -> None:
        self._scans[scan] = setup
        self._waiting_since_s.pop(scan, None)
        if len(self._scans) > MAX_SCANS:
            del self._scans[next(iter(self._scans))]

    def _give_up(self) -> None:
        """Let go of the frames of scans whose start cannot be got any more."""
        now_s = time.monotonic()
        for scan, since_s in list(self._waiting_since_s.items()):
            if now_s - since_s > PATIENCE_S:
                log.warning("scan %s: its start was not received in %.0f s, its frames are skipped", scan, PATIENCE_S)
                self._counts["given_up"] += len(self._held.pop(scan, []))
                self._remember(scan, ScanSetup(None, "", frozenset()))

    def _take(self, left: Message, right: Message) -> None:
        header = left.header
        setup = self._scans.get(header.scan)
        if setup is None:
            self._waiting_since_s.setdefault(header.scan, time.monotonic())
            self._held.setdefault(header.scan, []).append((left, right))
            return
        if setup.pipeline is None or header.pass_name not in setup.passes:
            self._counts["skipped"] += 1
            return
        if header.source.x_mm is None:
            log.error("trigger %d: the left frame carries no guide position; the stripe is skipped", header.trigger)
            self._counts["skipped"] += 1
            return
        began_s = time.perf_counter()
        pixels = np.asarray(left.payload, dtype=np.uint8), np.asarray(right.payload, dtype=np.uint8)
        points = setup.pipeline.process(pixels[0], pixels[1], header.source.x_mm)
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
        self._counts["stripes"] += 1
        self._counts["points"] += len(points)


def main(
    bus: Bus | None = None, rig: Rig | None = None, out: Path | None = None, stop: threading.Event | None = None
) -> int:
    """Run the optical subscriber until it is told to stop; `out` is not used, it writes no files."""
    del out
    return run_subscriber("optical", _make, bus, rig, stop)


def _make(bus: Bus, rig: Rig) -> OpticalSubscriber:
    OpticalPipeline.warm_up_kernels(
        (rig.cameras.left.height_px, rig.cameras.left.width_px),
        (rig.cameras.right.height_px, rig.cameras.right.width_px),
    )
    return OpticalSubscriber(bus, rig)
