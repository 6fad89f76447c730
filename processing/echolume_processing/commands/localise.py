"""Localise a target in pulse-echo recordings of one emitter and N receivers, and score it.

example: echolume localise spiel-echoes/echoes.npz --json
"""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("file", type=Path, help=".npz with frames, background (n, 4, samples) and target_mm (n, 3)")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Calibrate the channels' delays on the even-numbered recordings, localise in the odd ones."""
    from echolume_processing.ultrasonic.localise import load_recordings, score

    found = score(load_recordings(args.file))
    if args.json:
        sys.stdout.write(json.dumps(asdict(found), indent=1) + "\n")
        return 0
    delays = ", ".join(f"{d:.2f}" for d in found.delays)
    sys.stdout.write(
        f"calibrated on  {found.calibrated_on} recordings (even numbers)\n"
        f"scored on      {found.scored_on} recordings (odd numbers)\n"
        f"delays         {delays} samples\n"
        f"3D error       median {found.median_mm:.1f} mm, mean {found.mean_mm:.1f} mm, "
        f"90 % below {found.p90_mm:.1f} mm\n"
    )
    return 0
