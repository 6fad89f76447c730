"""Time ways of doing the same in one run, turn by turn, and show them side by side."""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np

Work = Callable[[], object]


class Comparison:
    """Collects sections; each prints a table, and all go into one flat map of figures."""

    def __init__(self, about: str, seconds: float = 2.5) -> None:
        parser = argparse.ArgumentParser(description=about)
        parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures as one flat map")
        parser.add_argument("--seconds", type=float, default=seconds, help=f"for each section (default: {seconds})")
        arguments = parser.parse_args()
        self._file: Path | None = arguments.json
        self._seconds: float = arguments.seconds
        self._figures: dict[str, float] = {}

    def section(self, name: str, title: str, ways: Mapping[str, Work], error: Mapping[str, str] | None = None) -> None:
        """Time each way, the first is the unit of the others; `error` says how good its answer is."""
        spent_s = self._measure(ways)
        self.show(name, title, {way: 1e3 * float(np.median(s)) for way, s in spent_s.items()}, error)

    def show(self, name: str, title: str, ms: Mapping[str, float], error: Mapping[str, str] | None = None) -> None:
        """Print times (ms) that were measured elsewhere, and keep them."""
        unit, *_ = ms
        width = max(len(way) for way in ms)
        print(f"\n{title}\n{'':{width}}  {'median':>10}  {'times ' + unit:>10}")
        for way, value in ms.items():
            note = (error or {}).get(way, "")
            print(f"{way:{width}}  {value:>7.3f} ms  {value / ms[unit]:>10.2f}  {note}".rstrip())
            self._figures[f"{name}/{way}/ms"] = value
            self._figures[f"{name}/{way}/times {unit}"] = value / ms[unit]

    def finish(self) -> None:
        """Write the figures if they were asked for."""
        if self._file is not None:
            self._file.write_text(json.dumps(self._figures, indent=1) + "\n", encoding="utf-8")

    def _measure(self, ways: Mapping[str, Work]) -> dict[str, list[float]]:
        """Seconds of each call; the ways take turns, so that a busy machine slows all of them."""
        for work in ways.values():
            work()
        spent_s: dict[str, list[float]] = {way: [] for way in ways}
        end_s = time.perf_counter() + self._seconds
        while time.perf_counter() < end_s or len(spent_s[next(iter(ways))]) < 5:
            for way, work in ways.items():
                began_s = time.perf_counter()
                work()
                spent_s[way].append(time.perf_counter() - began_s)
        return spent_s
