"""Sound: physics, echoes, contact points, the array's calibration, images and real recordings, beside their peers."""

from __future__ import annotations

import argparse
import json
from collections.abc import Callable, Mapping
from pathlib import Path

from comparison.array_calibration import array_calibration_rows
from comparison.contacts import contacts_rows
from comparison.echoes import echoes_rows
from comparison.imaging import imaging_rows
from comparison.physics import physics_rows
from comparison.spiel import spiel_rows
from threadpoolctl import threadpool_limits

PARTS: Mapping[str, Callable[[], dict[str, float]]] = {
    "physics": physics_rows,
    "echoes": echoes_rows,
    "contacts": contacts_rows,
    "calibration": array_calibration_rows,
    "imaging": imaging_rows,
    "recordings": spiel_rows,
}


def main() -> None:
    """Run all parts, or those named; `--json` keeps the figures as one flat map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("parts", nargs="*", metavar="PART", help=f"of {', '.join(PARTS)} (default: all)")
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures as one flat map")
    arguments = parser.parse_args()
    unknown = [name for name in arguments.parts if name not in PARTS]
    if unknown:
        parser.error(f"no part {', '.join(unknown)}; there are {', '.join(PARTS)}")
    figures: dict[str, float] = {}
    with threadpool_limits(1):  # all figures are of one core
        for name in arguments.parts or PARTS:
            figures |= PARTS[name]()
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
