"""What a finished scan says of itself, read from its archive; and its scores against a truth."""

from __future__ import annotations

from collections.abc import Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np

from echolume import scoring
from echolume.report import Report
from echolume_messages import archive, topics
from echolume_messages.calibration import Calibration
from echolume_messages.plan import MapField

COUNTS = ("planned", "fired", "matched", "missing", "duplicate", "extra")
TRIGGERED = tuple(topic for topic in topics.TOPICS if topic.recorded and topic.triggered)

Json = dict[str, Any]


def ledger_rows(ledger: Json) -> dict[str, dict[str, int]]:
    """Counts of a final ledger, summed over the passes of each kind."""
    rows: dict[str, dict[str, int]] = {}
    for found in cast("dict[str, Json]", ledger["passes"]).values():
        row = rows.setdefault(found["kind"], dict.fromkeys(COUNTS, 0))
        for name in COUNTS:
            row[name] += int(found[name])
    return rows


def scan_report(path: Path, results: Mapping[str, Any]) -> Report:
    """The part of report.json that the archive and the map know.

    Parameters
    ----------
    path
        Raw archive of the scan.
    results
        What the map came to: ``scan``, ``rule``, ``registration``, ``digest``, ``points``, ``cells``,
        ``notes``.

    Raises
    ------
    ArchiveError
        It is no archive.
    """
    start, ledger = _start_and_ledger(path)
    found = archive.summary(path)
    return {
        "version": version("echolume"),
        "scan": results["scan"],
        "rule": results["rule"],
        "calibration": _calibration_row(start),
        "ledger": ledger_rows(ledger),
        "archive": {
            "acknowledged": ledger.get("acknowledged"),
            "found": sum(found.records.get(topic.name, 0) for topic in TRIGGERED),
            "bytes": found.bytes,
            "torn": found.torn,
        },
        "points": results["points"],
        "cells": results["cells"],
        "registration": results["registration"],
        "digest": {"hybrid": results["digest"]},
        "notes": results["notes"],
    }


def _start_and_ledger(path: Path) -> tuple[Json, Json]:
    start: Json = {}
    ledger: Json = {"passes": {}}
    for message in archive.read(path, {topics.SCAN_START.name, topics.LEDGER.name}):
        if message.topic is topics.SCAN_START:
            start = cast("Json", message.json())
        else:
            ledger = cast("Json", message.json())
    return start, ledger


def _calibration_row(start: Json) -> Json:
    calibration = msgspec.convert(start["calibration"], Calibration)
    return {
        "digest": calibration.digest,
        "left_rms_px": calibration.left.rms_px,
        "right_rms_px": calibration.right.rms_px,
        "stereo_rms_px": calibration.stereo_rms_px,
        "plane_rms_mm": calibration.laser.rms_mm,
        "path_rms_mm": calibration.array.path_rms_mm,
    }


def judge_map(maps: Path, truth: Path, field_: MapField) -> list[Json]:
    """What the hybrid map says of the scene's regions beside what it must; empty for a truth without expectations."""
    from echolume_drivers.emulated.expectations import judge
    from echolume_drivers.emulated.scene_model import Expectation

    with np.load(truth) as real, np.load(maps) as made:
        at = scoring.window(
            real["front_mm"].shape, float(real["x0_mm"]), float(real["y0_mm"]), float(real["cell_mm"]), field_
        )
        said = judge(
            msgspec.json.decode(str(real["expect"]), type=list[Expectation]),
            [str(name) for name in real["regions"]],
            real["region"][at],
            made["label"],
            made["front_mm"],
            real["front_mm"][at],
            real["optical_mm"][at],
            float(real["cell_mm"]),
        )
    return [
        {
            "region": s.region,
            "what": s.what,
            "share": s.share,
            "at_least": s.at_least,
            "cells": s.cells,
            "kept": bool(s.kept),
        }
        for s in said
    ]


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
