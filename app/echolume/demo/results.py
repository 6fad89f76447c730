"""What a finished scan says of itself: ledger rows, archive row, pass times, scores."""

from __future__ import annotations

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, cast

import numpy as np

from echolume import scoring
from echolume_messages.archive import summary
from echolume_messages.plan import MapField

COUNTS = ("planned", "fired", "matched", "missing", "duplicate", "extra")

Json = dict[str, Any]


@dataclass
class Passes:
    """How long the passes of each kind took."""

    seconds: dict[str, float] = field(default_factory=lambda: {"optical": 0.0, "ultrasonic": 0.0, "snap": 0.0})
    _kind: str = ""
    _since_s: float = 0.0

    def follow(self, kind: str) -> None:
        """Charge the time since the last call to the kind of pass that ran then."""
        now_s = time.monotonic()
        if self._kind in self.seconds:
            self.seconds[self._kind] += now_s - self._since_s
        self._kind, self._since_s = kind, now_s


def ledger_rows(ledger: Json) -> dict[str, dict[str, int]]:
    """Counts of a final ledger, summed over the passes of each kind."""
    rows: dict[str, dict[str, int]] = {}
    for found in cast("dict[str, Json]", ledger["passes"]).values():
        row = rows.setdefault(found["kind"], dict.fromkeys(COUNTS, 0))
        for name in COUNTS:
            row[name] += int(found[name])
    return rows


def archive_row(path: Path, ledger: Json) -> Json:
    """How many records of triggers were acknowledged, and how many the archive holds."""
    found = summary(path)
    triggered = ("cameras/left", "cameras/right", "array/echoes")
    return {
        "acknowledged": ledger["acknowledged"],
        "found": sum(found.records.get(name, 0) for name in triggered),
        "bytes": found.bytes,
    }


def score_maps(maps: Path, truth: Path, field_: MapField) -> dict[str, scoring.Scores]:
    """Scores of the hybrid map and its baselines against the emulated rig's truth.

    `maps` holds ``front_mm`` and ``label`` of the hybrid map, and ``optical_mm``, ``ultrasonic_mm``, ``union_mm``.
    """
    with np.load(truth) as real, np.load(maps) as made:
        there = scoring.cut(
            real["front_mm"],
            real["material"],
            float(real["x0_mm"]),
            float(real["y0_mm"]),
            float(real["cell_mm"]),
            field_,
        )
        return {
            "hybrid": scoring.score(made["front_mm"], made["label"], there),
            "optical": scoring.score(made["optical_mm"], None, there),
            "ultrasonic": scoring.score(made["ultrasonic_mm"], None, there),
            "union": scoring.score(made["union_mm"], None, there),
        }
