"""Parts of the demo that need no rig: verdict, table, operator, plans, process tree."""

from __future__ import annotations

import io
import os
from pathlib import Path
from typing import Any

import pytest

from echolume.demo.operator import Operator
from echolume.demo.plans import plan_text
from echolume.processes import ProcessEndedError, ProcessTree, pss_kib
from echolume.progress import Progress
from echolume.report import table, verdict
from echolume_messages.errors import ConfigError
from echolume_messages.plan import expand, parse

LEDGER_ROW = {"planned": 3, "fired": 3, "matched": 3, "missing": 0, "duplicate": 0, "extra": 0}


def scores(f1: float) -> dict[str, float | None]:
    return {
        "rmse_mm": 1.0, "f1_at_0p5mm": f1, "f1_at_1mm": f1, "f1_at_2mm": f1,
        "completeness": 1.0, "glass_recall": None, "glass_precision": None,
    }  # fmt: skip


def report() -> dict[str, Any]:
    return {
        "version": "0", "scan": "s", "rule": "synthesis", "seed": 1,
        "calibration": {"digest": "d", "left_rms_px": 0.1, "right_rms_px": 0.1, "stereo_rms_px": 0.1,
                        "plane_rms_mm": 0.1},
        "ledger": {"optical": dict(LEDGER_ROW), "ultrasonic": dict(LEDGER_ROW)},
        "archive": {"acknowledged": 9, "found": 9, "bytes": 10},
        "points": {"stereo": 1, "active_left": 1, "active_right": 1, "ultrasonic": 1},
        "maps": {"hybrid": scores(0.9), "optical": scores(0.8), "ultrasonic": scores(0.1), "union": scores(0.7)},
        "timing": {"total_s": 1.0, "optical_pass_s": 0.5, "ultrasonic_pass_s": 0.5, "processing_lag_p99_ms": 2.0},
        "cells": {"matte": 5, "unknown": 1},
        "resources": {"peak_pss_mib": 12.0},
        "digest": {"hybrid": "abc"},
    }  # fmt: skip


def test_a_good_report_passes() -> None:
    assert verdict(report()) == []


@pytest.mark.parametrize("key", ["missing", "duplicate", "extra"])
def test_an_open_ledger_fails(key: str) -> None:
    found = report()
    found["ledger"]["optical"][key] = 1
    assert any("ledger: optical" in reason for reason in verdict(found))


def test_a_lost_acknowledged_record_fails() -> None:
    found = report()
    found["archive"]["found"] = 8
    assert any(reason.startswith("archive") for reason in verdict(found))


def test_a_map_made_without_some_triggers_fails() -> None:
    found = report()
    found["unprocessed"] = {"light": [3, 4]}
    assert any("2 triggers of pass 'light'" in reason for reason in verdict(found))


@pytest.mark.parametrize("other", ["optical", "ultrasonic"])
def test_a_map_that_one_sensor_beats_fails(other: str) -> None:
    found = report()
    found["maps"][other]["f1_at_1mm"] = found["maps"]["hybrid"]["f1_at_1mm"]
    assert not verdict(found)
    found["maps"][other]["f1_at_1mm"] += 0.001
    assert any(other in reason for reason in verdict(found))


def test_the_table_names_every_map_and_shows_unknown_as_a_dash() -> None:
    text = table(report())
    assert all(name in text for name in ("hybrid", "optical", "ultrasonic", "union", "abc"))
    assert " - " in text or text.rstrip().endswith("-") or "  -" in text


class Hands:
    """Remembers what the operator did."""

    def __init__(self) -> None:
        self.did: list[object] = []

    def place_scene(self, name: str) -> None:
        self.did.append(name)

    def place_board(self, index: int) -> None:
        self.did.append(index)


def test_the_operator_can_follow_every_prompt_of_the_calibration_plan() -> None:
    hands = Hands()
    operator = Operator(hands)
    prompts = [step.prompt for step in expand(parse(plan_text("calibrate"))) if step.prompt]
    for prompt in prompts:
        operator.answer(prompt)
    assert len(hands.did) == len(prompts)
    assert hands.did[0] == 0


def test_the_operator_refuses_what_he_does_not_understand() -> None:
    with pytest.raises(ConfigError, match="cannot follow"):
        Operator(Hands()).answer("sing a song")


def test_progress_writes_whole_lines_where_there_is_no_terminal() -> None:
    stream = io.StringIO()
    progress = Progress(stream, every_s=0.0)
    progress.say("one")
    progress.count("two", 1, 2)
    assert [line.split("] ")[1].strip() for line in stream.getvalue().splitlines()] == ["one", "two: 1/2"]


def test_a_child_that_ends_is_named_with_its_log(tmp_path: Path) -> None:
    with ProcessTree(tmp_path) as tree:
        tree.start("wrong", ["no-such-command"])
        with pytest.raises(ProcessEndedError, match="wrong ended with exit code 2"):
            tree.wait_until(lambda: False, "never", 30.0)


def test_pss_of_this_process_is_known_and_of_none_is_zero() -> None:
    assert pss_kib(os.getpid()) > 1000
    assert pss_kib(2**22 + 1) == 0


def said(**changed: Any) -> dict[str, Any]:
    return {"region": "glass", "what": "labels", "share": 1.0, "at_least": 0.9, "cells": 10, "kept": True, **changed}


def test_a_map_that_does_not_say_what_it_must_fails() -> None:
    found = {**report(), "expectations": [said(), said(what="must transparent", share=0.4, kept=False)]}
    assert [r for r in verdict(found) if "glass" in r] == [
        "map: of 'glass': must transparent: 0.400 of 10 cells, must be 0.9"
    ]
    assert "must transparent" in table(found)


def test_where_a_region_must_stay_unknown_no_sensor_wins_by_claiming_it() -> None:
    found = {**report(), "expectations": [said(what="must unknown")]}
    found["maps"]["hybrid"]["f1_at_1mm"] = 0.5
    assert verdict(found) == []
