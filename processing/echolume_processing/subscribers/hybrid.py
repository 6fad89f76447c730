"""The hybrid subscriber: a scan's map grows with its points and pings, and is finished when its ledger is closed."""

from __future__ import annotations

import logging
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from echolume_messages import topics
from echolume_messages.bus import Bus, Message
from echolume_messages.calibration import Calibration
from echolume_messages.errors import EcholumeError
from echolume_messages.plan import expand
from echolume_messages.rig import Rig
from echolume_messages.types import Structured
from echolume_processing.evidence import Evidence, ScanStart, read_start
from echolume_processing.hybrid.growing import GrowingMap
from echolume_processing.hybrid.warm_up import warm_up
from echolume_processing.ping import ping_from_record
from echolume_processing.review import REPORTS
from echolume_processing.session import conclude
from echolume_processing.subscribers.frame import run_subscriber

DEPTH = 256
STALLED_S = 20.0
"""After the final ledger, so long without anything new means that the rest will not come."""
HELD_RECORDS = 2000
"""Records of scans whose start is not known yet."""
MAX_SCANS = 4
SHOWN_EVERY_S = 2.0
"""How often the growing map is shown at most: a picture of it costs as much as a hundred pings."""
FRAMES_DEPTH = 8
"""Frames that may wait to be made pictures; of more, the oldest is not shown."""

log = logging.getLogger("echolume.hybrid")
Json = dict[str, Any]


@dataclass
class _Scan:
    """One scan while it runs."""

    evidence: Evidence
    kinds: dict[str, str]
    stripes: int
    """That the plan asks for."""
    growing: GrowingMap
    shown: int = 0
    """Records that the last picture of the growing map rests on."""
    shown_s: float = field(default_factory=time.monotonic)
    lags_ms: list[float] = field(default_factory=list[float])
    ledger: Json | None = None
    last_s: float = field(default_factory=time.monotonic)

    @classmethod
    def of(cls, start: ScanStart, calibration: Calibration) -> _Scan:
        """A scan that has begun."""
        kinds = {p.name: str(p.__struct_config__.tag) for p in start.plan.passes}
        stripes = sum(kinds[step.pass_name] == "optical" for step in expand(start.plan))
        return cls(Evidence.of(start, calibration), kinds, stripes, GrowingMap(calibration, start.plan.map))

    @property
    def records(self) -> int:
        """Stripes and pings so far."""
        return len(self.evidence.optical) + len(self.evidence.pings)

    def missing(self) -> dict[str, list[int]]:
        """Triggers that the ledger calls matched and that have not arrived in full, by pass."""
        out: dict[str, list[int]] = {}
        for name, triggers in cast("dict[str, list[int]]", (self.ledger or {}).get("triggers", {})).items():
            have = self.evidence.optical.keys()
            if self.kinds.get(name) == "ultrasonic":
                have = self.evidence.pings.keys() & self.evidence.ultrasonic.keys()
            elif self.kinds.get(name) != "optical":
                continue
            lacking = sorted(set(triggers) - set(have))
            if lacking:
                out[name] = lacking
        return out


class HybridSubscriber:
    """Makes the hybrid map of every scan that has a calibration."""

    def __init__(self, bus: Bus, rig: Rig, out: Path) -> None:
        self._rig = rig.name
        self._out = out
        self._starts = bus.subscribe([topics.SCAN_START], depth=8)
        self._records = bus.subscribe([topics.OPTICAL_POINTS, topics.ECHOES, topics.ULTRASONIC_POINTS], depth=DEPTH)
        self._reports = bus.subscribe(REPORTS, depth=64)
        self._frames = bus.subscribe(
            [topics.CAMERA_LEFT, topics.CAMERA_RIGHT], depth=FRAMES_DEPTH, refill=False, decimated=True
        )
        self._map = bus.publisher(topics.HYBRID_MAP)
        self._growing = bus.publisher(topics.HYBRID_GROWING)
        self._done = bus.publisher(topics.HYBRID_DONE)
        self._scans: dict[str, _Scan | None] = {}
        self._held: dict[str, list[Message]] = {}
        self._held_ledgers: dict[str, Message] = {}
        self._counts = {"records": 0, "maps": 0, "dropped": 0, "pictures": 0, "shown": 0}
        self._error = ""

    def step(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` for a record, and work on it."""
        self._take_starts()
        while (message := self._reports.get(0.0)) is not None:
            self._take_report(message)
        record = self._records.get(timeout_s)
        while record is not None:
            self._take(record)
            self._keep_frames(1)
            record = self._records.get(0.0)
        self._keep_frames(FRAMES_DEPTH)
        for name, scan in list(self._scans.items()):
            if scan is not None:
                self._grow(name, scan)
            if scan is not None and scan.ledger is not None:
                self._finish_if_complete(name, scan)

    def health(self) -> dict[str, object]:
        """Counts, scans in work, and the state of the subscription."""
        running = [name for name, scan in self._scans.items() if scan is not None]
        return {
            **self._counts,
            "error": self._error,
            "running": running,
            "subscription": self._records.stats,
            "frames": self._frames.stats,
        }

    def close(self) -> None:
        """Stop receiving."""
        for subscription in (self._starts, self._records, self._reports, self._frames):
            subscription.close()

    def _take_starts(self) -> None:
        while (message := self._starts.get(0.0)) is not None:
            self._begin(message)

    def _begin(self, message: Message) -> None:
        name = message.header.scan
        try:
            start = read_start(message)
            name = start.scan
            found = None
            if start.calibration is not None and start.calibration.rig == self._rig:
                found = _Scan.of(start, start.calibration)
            elif start.calibration is not None:
                log.error("scan %s: its calibration is of rig %r; no map", name, start.calibration.rig)
        except EcholumeError as error:
            log.error("scan %s: no map: %s", name, error)
            found = None
        self._scans[name] = found
        if len(self._scans) > MAX_SCANS:
            del self._scans[next(iter(self._scans))]
        for held in self._held.pop(name, []):
            self._take(held)
        ledger = self._held_ledgers.pop(name, None)
        if ledger is not None:
            self._take_report(ledger)

    def _take_report(self, message: Message) -> None:
        scan = self._scans.get(message.header.scan)
        if scan is not None:
            scan.evidence.review.add_report(message)
        if message.topic == topics.LEDGER:
            self._close_ledger(message)

    def _keep_frames(self, most: int) -> None:
        """Make pictures of at most so many of the frames that came; a frame that was missed is not in the recording."""
        for _ in range(most):
            message = self._frames.get(0.0)
            if message is None:
                return
            if message.header.scan not in self._scans:
                self._take_starts()
            scan = self._scans.get(message.header.scan)
            if scan is not None and scan.kinds.get(message.header.pass_name) == "optical":
                self._counts["pictures"] += scan.evidence.review.add_frame(message)

    def _close_ledger(self, message: Message) -> None:
        ledger = cast("Json", message.json())
        if not ledger.get("final", False):
            return
        name = message.header.scan
        if name not in self._scans:
            self._held_ledgers[name] = message
            if len(self._held_ledgers) > MAX_SCANS:
                del self._held_ledgers[next(iter(self._held_ledgers))]
            return
        scan = self._scans[name]
        if scan is not None:
            scan.ledger = ledger
            scan.last_s = time.monotonic()

    def _take(self, message: Message) -> None:
        header = message.header
        if header.scan not in self._scans:
            if sum(len(h) for h in self._held.values()) >= HELD_RECORDS:
                self._counts["dropped"] += len(self._held.pop(next(iter(self._held))))
            self._held.setdefault(header.scan, []).append(message)
            return
        scan = self._scans[header.scan]
        if scan is None:
            return
        key = (header.trigger, header.attempt)
        kind = scan.kinds.get(header.pass_name)
        if message.topic == topics.OPTICAL_POINTS and kind == "optical":
            points = cast("Structured", message.payload)
            if scan.evidence.add_optical(*key, points):
                scan.growing.add_stripe(header.trigger, points)
        elif message.topic == topics.ULTRASONIC_POINTS and kind == "ultrasonic":
            scan.evidence.add_ultrasonic(*key, cast("Structured", message.payload))
        elif message.topic == topics.ECHOES and kind == "ultrasonic":
            try:
                ping = ping_from_record(header, np.asarray(message.payload, dtype=np.int16))
                if scan.evidence.add_ping(*key, ping):
                    scan.growing.add_ping(ping)
            except ValueError as error:
                log.error("trigger %d: the ping is skipped: %s", header.trigger, error)
                return
        else:
            return
        if message.topic != topics.ULTRASONIC_POINTS:
            scan.evidence.review.add_moment(header)
        self._counts["records"] += 1
        scan.last_s = time.monotonic()
        if message.topic != topics.ECHOES:
            scan.lags_ms.append((time.monotonic_ns() - header.t_ns) * 1e-6)

    def _grow(self, name: str, scan: _Scan) -> None:
        """Nothing waits: prepare light's surface once it is whole, and show what there is."""
        if len(scan.evidence.optical) == scan.stripes and not scan.growing.settled:
            scan.growing.settle()
        if scan.records == scan.shown or time.monotonic() - scan.shown_s < SHOWN_EVERY_S:
            return
        found = scan.growing.live()
        scan.shown, scan.shown_s = scan.records, time.monotonic()
        self._growing.put(found.cells, scan=name, calibration=scan.evidence.calibration.digest)
        self._counts["shown"] += 1

    def _finish_if_complete(self, name: str, scan: _Scan) -> None:
        missing = scan.missing()
        if missing and time.monotonic() - scan.last_s < STALLED_S:
            return
        if missing:
            log.error("scan %s: %s did not arrive; the map is made without", name, missing)
        self._scans[name] = None
        try:
            found, results = conclude(scan.evidence, self._out, grown=scan.growing)
        except OSError as error:
            self._error = (
                f"scan {name}: its map cannot be written to {self._out}: {error.strerror}; "
                "`echolume reprocess` makes it from the archive"
            )
            log.error("%s", self._error)
            return
        self._counts["maps"] += 1
        log.info("scan %s: map of %d cells, digest %s", name, found.cells.size, results["digest"])
        lag_ms = float(np.percentile(scan.lags_ms, 99)) if scan.lags_ms else 0.0
        digest = scan.evidence.calibration.digest
        self._map.put(found.cells, scan=name, calibration=digest)
        self._done.put_json({**results, "lag_p99_ms": lag_ms, "missing": missing}, scan=name, calibration=digest)


def main(
    bus: Bus | None = None, rig: Rig | None = None, out: Path | None = None, stop: threading.Event | None = None
) -> int:
    """Run the subscriber until SIGTERM or SIGINT; files go to `out`, by default the working folder."""
    folder = out or Path.cwd()

    def make(bus: Bus, rig: Rig) -> HybridSubscriber:
        # beside the first scan, not before it: nothing is fused until that scan is over
        threading.Thread(target=warm_up, name="hybrid-warm-up", daemon=True).start()
        return HybridSubscriber(bus, rig, folder)

    return run_subscriber("hybrid", make, bus, rig, stop)
