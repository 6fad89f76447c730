"""report.json and the final table of a scan."""

from __future__ import annotations

import json
import math
from pathlib import Path
from typing import Any, cast

Report = dict[str, Any]


def write(report: Report, out: Path) -> None:
    """Write report.json into a folder."""
    (out / "report.json").write_text(json.dumps(report, indent=1) + "\n", encoding="utf-8")


def verdict(report: Report) -> list[str]:
    """Why the demo failed; empty where it succeeded.

    It succeeds only if the ledger closes, every acknowledged record is in the archive, every matched trigger is in the
    map, the map says of the scene's regions what it must, and no sensor alone beats the hybrid map on ``f1_at_1mm``.
    Where a region must stay unknown, whoever claims it wins that score, so that it does not count.
    """
    reasons: list[str] = []
    for name, row in cast("dict[str, dict[str, int]]", report["ledger"]).items():
        if row["matched"] != row["planned"] or row["missing"] or row["duplicate"] or row["extra"]:
            reasons.append(
                f"ledger: {name}: planned {row['planned']}, matched {row['matched']}, missing {row['missing']}, "
                f"duplicate {row['duplicate']}, extra {row['extra']}"
            )
    archive = report["archive"]
    if archive["found"] < (archive["acknowledged"] or 0):
        reasons.append(f"archive: {archive['acknowledged']} records acknowledged, {archive['found']} found")
    reasons.extend(
        f"map: made without {len(triggers)} triggers of pass {name!r} that never reached it"
        for name, triggers in cast("dict[str, list[int]]", report.get("unprocessed", {})).items()
    )
    said = cast("list[dict[str, Any]]", report.get("expectations", []))
    reasons.extend(
        f"map: of {s['region']!r}: {s['what']}: {s['share']:.3f} of {s['cells']} cells, must be {s['at_least']:g}"
        for s in said
        if not s["kept"]
    )
    maps = report.get("maps")
    if maps and not any(s["what"] == "must unknown" for s in said):
        hybrid = maps["hybrid"]["f1_at_1mm"]
        reasons.extend(
            f"map: hybrid f1_at_1mm {hybrid:.3f} is beaten by {other} alone ({maps[other]['f1_at_1mm']:.3f})"
            for other in ("optical", "ultrasonic")
            if not hybrid >= maps[other]["f1_at_1mm"]
        )
    return reasons


def _cell(value: Any) -> str:
    if value is None or (isinstance(value, float) and math.isnan(value)):
        return "-"
    return f"{value:.3f}" if isinstance(value, float) else str(value)


def _table(head: list[str], rows: list[list[Any]]) -> list[str]:
    text = [head, *([_cell(v) for v in row] for row in rows)]
    widths = [max(len(row[k]) for row in text) for k in range(len(head))]
    return [
        "  " + "  ".join(v.ljust(w) if k == 0 else v.rjust(w) for k, (v, w) in enumerate(zip(row, widths, strict=True)))
        for row in text
    ]


def table(report: Report) -> str:
    """What a person wants to know, as text."""
    lines: list[str] = []
    calibration = report["calibration"]
    lines.append(
        f"Calibration {calibration['digest']}: left {calibration['left_rms_px']:.3f} px, "
        f"right {calibration['right_rms_px']:.3f} px, stereo {calibration['stereo_rms_px']:.3f} px, "
        f"laser plane {calibration['plane_rms_mm']:.3f} mm"
    )
    lines.append("")
    columns = ["planned", "fired", "matched", "missing", "duplicate", "extra"]
    lines += _table(["ledger", *columns], [[n, *(r[c] for c in columns)] for n, r in report["ledger"].items()])
    archive = report["archive"]
    lines.append("")
    lines.append(
        f"Archive: {archive['acknowledged']} records acknowledged, {archive['found']} found, "
        f"{archive['bytes'] / 1e6:.0f} MB"
    )
    cells = ", ".join(f"{name} {n}" for name, n in report["cells"].items())
    points = ", ".join(f"{name.replace('_', ' ')} {n}" for name, n in report["points"].items())
    lines.append(f"Points: {points}")
    lines.append(f"Cells: {cells}")
    if report.get("maps"):
        columns = [
            "f1_at_0p5mm",
            "f1_at_1mm",
            "f1_at_2mm",
            "rmse_mm",
            "completeness",
            "glass_recall",
            "glass_precision",
        ]
        lines.append("")
        lines += _table(["map", *columns], [[n, *(r.get(c) for c in columns)] for n, r in report["maps"].items()])
    if report.get("expectations"):
        lines.append("")
        head = ["the map must say", "what", "share", "at least", "cells", "kept"]
        rows = [
            [s["region"], s["what"], s["share"], s["at_least"], s["cells"], "yes" if s["kept"] else "NO"]
            for s in report["expectations"]
        ]
        lines += _table(head, rows)
    lines.append("")
    if "timing" in report:
        lines.append(_timing(report["timing"], report["resources"]["peak_pss_mib"]))
    lines.append(f"Rule: {report['rule']}. Digest of the hybrid map: {report['digest']['hybrid']}")
    lines.extend(f"Note: {note}" for note in report.get("notes", []))
    return "\n".join(lines) + "\n"


def _timing(timing: dict[str, float], peak_pss_mib: float) -> str:
    return (
        f"Time: {timing['total_s']:.0f} s from calibration to map (light {timing['optical_pass_s']:.0f} s, sound "
        f"{timing['ultrasonic_pass_s']:.0f} s), processing lag p99 {timing['processing_lag_p99_ms']:.0f} ms, memory at "
        f"most {peak_pss_mib:.0f} MiB"
    )
