"""What a rule's map of a scan is worth: one flat row of figures."""

from __future__ import annotations

import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from comparison.hybrid_scans import Recorded
from echolume import scoring
from echolume.evaluation import images
from echolume.evaluation.evaluate import Evaluation, Metrology, Sources, evaluate, metrology
from echolume_drivers.emulated.expectations import Said, judge
from echolume_messages.calibration import Calibration
from echolume_messages.types import Label, Structured
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.rules.registry import fuse_by
from echolume_processing.hybrid.stored import StoredMap
from echolume_processing.ping import Ping

NAN = float("nan")
Row = dict[str, float]


def fused(
    rule: str,
    recorded: Recorded,
    calibration: Calibration | None = None,
    pings: list[Ping] | None = None,
    ultrasonic: Structured | None = None,
) -> tuple[HybridMap, float]:
    """A rule's map of a scan and the seconds that it took; with other pings, points or calibration where given."""
    evidence = recorded.evidence
    heard = evidence.all_ultrasonic() if ultrasonic is None else ultrasonic
    given = evidence.all_pings() if pings is None else pings
    light = evidence.all_optical()
    began_s = time.perf_counter()
    found = fuse_by(rule, light, heard, given, calibration or evidence.calibration, evidence.plan.map)
    return found, time.perf_counter() - began_s


def row(found: HybridMap, recorded: Recorded) -> Row:
    """Figures of a map; nan where nothing supports one."""
    truth, field = recorded.truth, found.field
    if not np.isfinite(found.cells["front_mm"]).any():
        return {}
    claimed = images.claimed(StoredMap(found), None, Path(recorded.scene))
    sources = Sources(
        map="", layer=None, digest="", scan="", calibration="", truth="", truth_kind="", cell_mm=field.cell_mm
    )
    said: Evaluation = evaluate(claimed, truth, field, sources)
    label = found.image("label")
    there = scoring.Truth(front_mm=truth.front_mm, glass=truth.label == Label.TRANSPARENT)

    def among(wanted: Label, key: str, away: bool = False) -> float:
        cells = (truth.label == wanted) & np.isfinite(truth.front_mm)
        if away:
            cells &= scoring.away_from_edges(truth.front_mm)
        return float(scoring.score(found.image("front_mm"), None, there, cells)[key]) if cells.any() else NAN

    glass = said["glass"] or {}
    transparent = truth.label == Label.TRANSPARENT
    within = said["consistency"]["non_edge"]
    stated = said["reliability"] or {}
    matte = replace(truth, front_mm=np.where(truth.label == Label.MATTE, truth.front_mm, np.nan))
    made = metrology(claimed, matte, field)
    return {
        "f1_1mm": said["all"]["f1_at_1mm"],
        "f1_1mm_nonedge": said["non_edge"]["f1_at_1mm"],
        "rmse_mm": _number(said["non_edge"]["rmse_mm"]),
        "f1_0p5mm_matte": among(Label.MATTE, "f1_at_0p5mm"),
        "f1_0p5mm_matte_nonedge": among(Label.MATTE, "f1_at_0p5mm", away=True),
        "black_f1_2mm": among(Label.ABSORBING, "f1_at_2mm"),
        "glass_recall": _number(said["all"]["glass_recall"]),
        "glass_precision": _number(said["all"]["glass_precision"]),
        "glass_height_mm": _number(glass.get("median_abs_mm")),
        "transparent_pct": 100 * float(np.mean(label == Label.TRANSPARENT)),
        "glass_unknown_pct": 100 * float(np.mean(label[transparent] == Label.UNKNOWN)) if transparent.any() else NAN,
        "label_brier": _number(stated.get("label_brier")),
        "label_ece": _number(stated.get("label_ece")),
        "nees": _number(within["nees"]),
        "nees_median": _number(within["nees_median"]),
        "coverage95_pct": 100 * _number(within["coverage95"]),
        "step_light_mm": _step(made, "light"),
        "step_sound_mm": _step(made, "sound"),
        "flatness_mm": _number(made["flatness_mm"]),
        **plate_rows(found, recorded),
    }


def plate_rows(found: HybridMap, recorded: Recorded) -> Row:
    """Recall and median error of the height of each region of glass: ``REGION_recall``, ``REGION_mm``."""
    if recorded.asked is None:
        return {}
    truth, asked, rows = recorded.truth, recorded.asked, Row()
    named = found.image("label") == Label.TRANSPARENT
    off_mm = np.abs(found.image("front_mm") - truth.front_mm)
    for number, region in enumerate(asked.regions):
        cells = (asked.region == number) & (truth.label == Label.TRANSPARENT)
        if not cells.any():
            continue
        name, claimed = region.replace("-", "_"), named & cells & np.isfinite(off_mm)
        rows[f"{name}_recall"] = float(named[cells].mean())
        rows[f"{name}_mm"] = float(np.median(off_mm[claimed])) if claimed.any() else NAN
    return rows


def broken(found: HybridMap, recorded: Recorded) -> list[Said]:
    """What a map does not say, of that which the scene asks of it."""
    asked = recorded.asked
    if asked is None:
        return []
    said = judge(
        asked.expect,
        asked.regions,
        asked.region,
        found.image("label"),
        found.image("front_mm"),
        recorded.truth.front_mm,
        asked.behind_mm,
        found.field.cell_mm,
    )
    return [each for each in said if not each.kept]


def _step(made: Metrology, sense: str) -> float:
    """Root mean square error of the steps that rest on one sense."""
    rows = made["steps_by_sense"]
    return rows[sense]["rms_mm"] if sense in rows else NAN


def _number(value: object) -> float:
    return float(value) if isinstance(value, int | float) else NAN


def mean_of(rows: list[Row]) -> Row:
    """Mean of each figure over the rows that have it."""
    out: Row = {}
    for key in dict.fromkeys(key for each in rows for key in each):
        values = [each[key] for each in rows if key in each and np.isfinite(each[key])]
        out[key] = float(np.mean(values)) if values else NAN
    return out
