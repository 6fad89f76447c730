"""What a growing map costs: processor time of each stripe, ping and look, and of its end beside all at once."""

from __future__ import annotations

import time
from collections.abc import Callable

import numpy as np

from comparison.hybrid_scans import Recorded
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.growing import GrowingMap
from echolume_processing.hybrid.rules.names import DEFAULT
from echolume_processing.hybrid.rules.registry import fuse_by

SLOWEST = 99
"""Per cent of the stripes and pings that take no longer than what is stated."""
LOOKS = 5


def spent_ms(work: Callable[[], object]) -> float:
    """Processor time of all threads."""
    began_s = time.process_time()
    work()
    return 1e3 * (time.process_time() - began_s)


def growing_rows(recorded: Recorded) -> dict[str, float]:
    """Light first, then sound, as on the rig; and whether the end is bit for bit that of all evidence at once."""
    evidence = recorded.evidence
    optical = {trigger: points for trigger, (_, points) in sorted(evidence.optical.items())}
    pings = evidence.all_pings()
    grown = GrowingMap(evidence.calibration, evidence.plan.map)
    stripe_ms = [spent_ms(lambda t=t: grown.add_stripe(t, optical[t])) for t in optical]
    settle_ms = spent_ms(grown.settle)
    ping_ms = [spent_ms(lambda p=p: grown.add_ping(p)) for p in pings]
    live_ms = float(np.median([spent_ms(grown.live) for _ in range(LOOKS)]))
    ends = list[str]()
    finish_ms = spent_ms(lambda: ends.append(digest(grown.finish())))
    given = evidence.all_optical(), evidence.all_ultrasonic(), pings, evidence.calibration, evidence.plan.map
    triggers = evidence.optical_triggers(), evidence.ultrasonic_triggers()
    batch_ms = spent_ms(lambda: ends.append(digest(fuse_by(DEFAULT, *given, *triggers))))
    rows = {
        "stripe_ms": float(np.median(stripe_ms)),
        "stripe_p99_ms": float(np.percentile(stripe_ms, SLOWEST)),
        "ping_ms": float(np.median(ping_ms)),
        "ping_p99_ms": float(np.percentile(ping_ms, SLOWEST)),
        "settle_ms": settle_ms,
        "live_ms": live_ms,
        "finish_s": 1e-3 * finish_ms,
        "batch_s": 1e-3 * batch_ms,
        "grown_is_batch": float(len(set(ends)) == 1),
    }
    print(f"\na growing map, {len(optical)} stripes and {len(pings)} pings, processor time of all threads")
    for name, value in rows.items():
        print(f"{name:24}{value:14.4g}")
    return rows
