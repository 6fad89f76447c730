"""docs/protocol.md tells the truth: the figures that it names exist, and its numbers are right."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Any

import pytest

from app.test_evaluate import Case
from echolume.evaluation.form import LEFT_OUT
from echolume_drivers.emulated.scene import demo

PAGE = (Path(__file__).resolve().parents[2] / "docs" / "protocol.md").read_text(encoding="utf-8")
GROUPS = ("all", "non_edge", "labels", "glass", "metrology", "consistency", "provenance")


def test_every_figure_that_the_protocol_asks_for_is_computed(tmp_path: Path) -> None:
    found: Any = Case.of(demo(), tmp_path).scores()
    named = re.findall(rf"`((?:{'|'.join(GROUPS)})\.[\w.]+)`", PAGE)
    assert len(named) > 15
    for key in named:
        at = found
        for part in key.split("."):
            assert part in at, key
            at = at[part]


def test_its_numbers_are_right() -> None:
    a = math.radians(30)
    b = math.asin(math.sin(a) / 1.52)
    assert 1 - math.tan(b) / math.tan(a) == pytest.approx(0.40, abs=0.005)
    assert 0.95**59 < 0.05 < 0.95**58
    assert pytest.approx(0.74, abs=0.005) == 0.05 ** (1 / 10)
    assert pytest.approx(0.0017, abs=5e-5) == 0.5 / 293.15
    assert LEFT_OUT == 3 / 1000
