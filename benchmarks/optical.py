"""Light: stripe extraction, points of frame pairs and calibration, each figure beside its peers and what is asked."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import cv2
from comparison.points import points_rows
from comparison.real_boards import calibration_rows
from comparison.stripe import stripe_rows


def main() -> None:
    """Run all parts on one thread; `--json` keeps the figures as one flat map."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--json", type=Path, metavar="FILE", help="write all figures as one flat map")
    arguments = parser.parse_args()
    cv2.setNumThreads(1)
    figures: dict[str, float] = {}
    for part in (stripe_rows, points_rows, calibration_rows):
        figures |= part()
    if arguments.json is not None:
        arguments.json.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
