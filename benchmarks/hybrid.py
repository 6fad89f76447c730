"""The hybrid map: every fusion rule on scans of the emulated rig through its wires, beside what is asked."""

from __future__ import annotations

import argparse
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from comparison.fusion_speed import fusion_speed_rows
from comparison.growing_speed import growing_rows
from comparison.hybrid_asked import Table, beam_rows, disturbed_rows, flat, headline, show_asked, show_scenes
from comparison.hybrid_mismatch import mismatch_rows
from comparison.hybrid_scans import PAPER, Recorded, load, scan
from comparison.hybrid_scores import Row, broken, fused, mean_of, row

from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.rules.names import DEFAULT, DESCRIPTIONS

SCENES = ("demo", "matte")
FULL_SCENES = (
    "demo", "matte", "glass-steep", "glass-small", "glass-low", PAPER, "glass-two", "glass-stair", "glass-hole",
    "glass-tilt-5", "glass-tilt-10", "glass-tilt-20", "bottle", "mirror", "perforated", "smoke", "bright", "drift",
    "sphere", "nothing-shared",
)  # fmt: skip
"""All shipped scenes but those that only calibrate, and the demo scene with the paper's array."""
THRICE = ("demo", "matte", "glass-steep", "glass-small", "glass-low", PAPER)
"""Scenes that `--full` scans with three rigs: those that a figure with a bar is taken from."""
COLUMNS = (
    "f1_1mm", "f1_1mm_nonedge", "rmse_mm", "f1_0p5mm_matte_nonedge", "black_f1_2mm", "glass_recall", "glass_precision",
    "glass_height_mm", "transparent_pct", "nees", "coverage95_pct", "expect_broken", "seconds",
)  # fmt: skip

WIDTH = 11
"""Of a figure, in characters."""


@dataclass
class Found:
    """Figures of the scenes so far, what their maps lack, and the scans of the demo scene."""

    table: Table = field(default_factory=dict)
    lacking: dict[str, list[str]] = field(default_factory=dict)
    demos: list[Recorded] = field(default_factory=list)

    def add(self, scene: str, seeds: Sequence[int], scans: Sequence[Recorded], rules: Sequence[str]) -> None:
        """Score every rule on a scene's scans, mean over them, and print that."""
        self.lacking[scene], rows = [], {}
        for rule in rules:
            made = [(fused(rule, each), each) for each in scans]
            rows[rule] = mean_of([scored(*found, each) for found, each in made])
            if rule == DEFAULT:
                self.lacking[scene] = [
                    f"seed {seed}: {said.region} {said.what} {said.share:.3f} < {said.at_least:g}"
                    for seed, ((found, _), each) in zip(seeds, made, strict=True)
                    for said in broken(found, each)
                ]
        self.table[scene] = rows
        show(scene, rows, len(scans))
        if scene == "demo":
            self.demos += scans


def scored(found: HybridMap, took_s: float, recorded: Recorded) -> Row:
    """Figures of one map."""
    lacks = {"expect_broken": float(len(broken(found, recorded)))} if recorded.asked is not None else {}
    return {**row(found, recorded), **lacks, "seconds": took_s}


def show(scene: str, rows: Mapping[str, Row], scans: int) -> None:
    """Print one scene's rules beside each other."""
    width = max(map(len, rows))
    print(f"\n{scene}, {scans} scan{'s' if scans > 1 else ''}")
    print(" " * width + "".join(f"{name:>{max(WIDTH, len(name) + 2)}}" for name in COLUMNS))
    for rule, each in rows.items():
        values = ((name, each.get(name, np.nan)) for name in COLUMNS)
        print(
            f"{rule:{width}}" + "".join(f"{value:{max(WIDTH, len(name) + 2)}.4g}" for name, value in values), flush=True
        )


def seeds_of(scene: str, asked: Sequence[int] | None, full: bool) -> Sequence[int]:
    """The rigs that a scene is scanned with."""
    return asked or ((1, 2, 3) if full and scene in THRICE else (1,))


def parsed() -> argparse.Namespace:
    """The command's options."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--scenes", nargs="+", metavar="SCENE", help=f"default: {' '.join(SCENES)}; also {PAPER}")
    parser.add_argument("--seeds", nargs="+", type=int, metavar="N", help="rigs, each with its own flaws (default: 1)")
    parser.add_argument("--rules", nargs="+", choices=list(DESCRIPTIONS), metavar="RULE", help="default: all")
    parser.add_argument(
        "--full", action="store_true", help=f"all scenes and the mismatch; three seeds of {', '.join(THRICE)}"
    )
    parser.add_argument("--mismatch", action="store_true", help="also with calibrations that are not the array's")
    parser.add_argument(
        "--keep", type=Path, metavar="DIR", help="keep each scan in DIR/SCENE-SEED, and use those there"
    )
    parser.add_argument(
        "--from", dest="folder", type=Path, metavar="DIR", help="score this demo's folder; scan nothing"
    )
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures as one flat map")
    return parser.parse_args()


def main() -> None:
    """Scan, fuse by every rule, score; `--json` keeps the figures as one flat map."""
    given = parsed()
    rules, found = given.rules or list(DESCRIPTIONS), Found()
    if given.folder is not None:
        found.add("demo", (1,), [load(given.folder, "demo")], rules)
    else:
        for scene in given.scenes or (FULL_SCENES if given.full else SCENES):
            seeds = seeds_of(scene, given.seeds, given.full)
            found.add(scene, seeds, [scan(scene, seed, given.keep) for seed in seeds], rules)
    figures = headline(found.table) | flat("hybrid", found.table)
    if found.demos:
        figures |= fusion_speed_rows(found.demos[0].evidence.calibration) | growing_rows(found.demos[0])
    if found.demos and (given.mismatch or given.full):
        others: Table = {}
        for name, rows in mismatch_rows(found.demos, rules):
            others[name] = rows
            show(f"demo, {name}", rows, len(found.demos))
        figures |= beam_rows(others) | disturbed_rows(others) | flat("mismatch", others)
    show_scenes(found.table, found.lacking)
    show_asked(figures)
    if given.json is not None:
        finite = {key: value for key, value in figures.items() if np.isfinite(value)}
        given.json.write_text(json.dumps(finite, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
