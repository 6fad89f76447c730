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
    """Calibrate on the even-numbered recordings, localise in the odd ones."""
    from echolume_processing.ultrasonic.localise_score import score
    from echolume_processing.ultrasonic.recordings import load_recordings

    found = score(load_recordings(args.file))
    if args.json:
        sys.stdout.write(json.dumps(asdict(found), indent=1) + "\n")
        return 0
    delays = "; ".join(", ".join(f"{d:.2f}" for d in row) for row in found.delays)
    x, y, z = found.offset_mm
    sys.stdout.write(
        f"calibrated on  {found.calibrated_on} recordings (even numbers), {found.setups} set-ups\n"
        f"scored on      {found.scored_on} recordings (odd numbers)\n"
        f"delays         {delays} samples\n"
        f"offset         {x:.1f}, {y:.1f}, {z:.1f} mm\n"
        f"channels       {found.channels_heard:.2f} of {len(found.delays[0])} hear the target\n"
        f"3D error       median {found.median_mm:.1f} mm, mean {found.mean_mm:.1f} mm, "
        f"90 % below {found.p90_mm:.1f} mm\n"
        f"stated         sigma {found.sigma_median_mm:.1f} mm in 3D (median), "
        f"{100 * found.covered_90:.0f} % inside their 90 % ellipsoid\n"
    )
    return 0
