"""The optical subscriber: camera pairs in, points of each stripe out."""

from __future__ import annotations

import logging
import threading
import time
from pathlib import Path

import numpy as np

from echolume_messages import topics
from echolume_messages.bus import Bus, Message
from echolume_messages.rig import Rig
from echolume_processing.optical.pipeline import OpticalPipeline
from echolume_processing.optical.sweep import Sweep
from echolume_processing.subscribers.frame import run_subscriber
from echolume_processing.subscribers.pairing import Pairs
from echolume_processing.subscribers.scans import Scans

FRAMES_DEPTH = 24
"""Frames of each camera that may wait in the queue."""
HELD_PAIRS = 8
"""Pairs of a scan whose start is not known yet; with more, frames wait in the journals."""

log = logging.getLogger("echolume.optical")


class OpticalSubscriber:
    """Processes the optical passes of every scan that has a calibration, and publishes their points."""

    def __init__(self, bus: Bus, rig: Rig) -> None:
        self._starts = bus.subscribe([topics.SCAN_START], depth=8)
        self._left = bus.subscribe([topics.CAMERA_LEFT], depth=FRAMES_DEPTH)
        self._right = bus.subscribe([topics.CAMERA_RIGHT], depth=FRAMES_DEPTH)
        self._points = bus.publisher(topics.OPTICAL_POINTS)
        self._pairs = Pairs(self._left, self._right)
        self._scans = Scans[OpticalPipeline, tuple[Message, Message]](
            self._starts, rig.name, OpticalPipeline, HELD_PAIRS, log
        )
        self._counts = {"stripes": 0, "points": 0, "skipped": 0}
        self._candidates: dict[str, int] = {}
        self._sweep = Sweep(log)
        self._busy_ms = 0.0

    def step(self, timeout_s: float) -> None:
        """Wait for at most `timeout_s` for a record, and work on it."""
        while (held := self._scans.next_start(0.0)) is not None:
            self._take_all(held)
        if self._scans.full:
            self._take_all(self._scans.next_start(timeout_s) or [])
            self._scans.give_up()
            return
        pair = self._pairs.get(timeout_s)
        if pair is not None:
            self._take(*pair)

    def health(self) -> dict[str, object]:
        """Counts, the last stripe's time, what became of all candidates, both cameras' agreement, the subscription."""
        return {
            **self._counts,
            "given_up": self._scans.given_up,
            "unpaired": self._pairs.unpaired,
            "ms_per_pair": round(self._busy_ms, 2),
            "candidates": dict(self._candidates),
            "agreement": self._sweep.report(),
            "left": self._left.stats,
            "right": self._right.stats,
        }

    def close(self) -> None:
        """Stop receiving."""
        self._starts.close()
        self._left.close()
        self._right.close()

    def _take_all(self, pairs: list[tuple[Message, Message]]) -> None:
        for pair in pairs:
            self._take(*pair)

    def _take(self, left: Message, right: Message) -> None:
        header = left.header
        setup = self._scans.setup(header.scan, (left, right))
        if setup is None:
            return
        if setup.pipeline is None or setup.kinds.get(header.pass_name) != "optical":
            self._counts["skipped"] += 1
            return
        if header.source.x_mm is None:
            log.error("trigger %d: the left frame carries no guide position; the stripe is skipped", header.trigger)
            self._counts["skipped"] += 1
            return
        began_s = time.perf_counter()
        pixels = np.asarray(left.payload, dtype=np.uint8), np.asarray(right.payload, dtype=np.uint8)
        try:
            found = setup.pipeline.measure(pixels[0], pixels[1], header.source.x_mm, header.source.sigma_mm)
        except ValueError as error:
            log.error("trigger %d: the stripe is skipped: %s", header.trigger, error)
            self._counts["skipped"] += 1
            return
        self._points.put(
            found.points,
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
        self._counts["points"] += len(found.points)
        for name, count in found.counts.items():
            self._candidates[name] = self._candidates.get(name, 0) + count
        limit_mm = setup.pipeline.plane_limit_mm
        self._sweep.add((header.scan, header.pass_name), limit_mm, found.agreement, header.source.x_mm, header.t_ns)


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
