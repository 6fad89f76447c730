"""Tell in plain words what one cell of a map is, how sure that is, and which stripes and pings it rests on.

example:
  echolume explain demo-out/map.npz 35 -20

MAP is map.npz, hybrid.ply or an export of them; the place is x and y in mm in the rig frame. Stripes and pings are
named by their triggers, as in the archive and the recording. Of the map's notes those are told that are about a place
nearby, or about the map as a whole.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("map", type=Path, help="the map")
    parser.add_argument("x_mm", type=float, metavar="X_MM", help="place along the guide")
    parser.add_argument("y_mm", type=float, metavar="Y_MM", help="place along the laser line")
    parser.add_argument("--json", action="store_true", help="print it as JSON")


def run(args: argparse.Namespace) -> int:
    """Read the map, find the cell, print what is known of it."""
    from echolume_processing.explain import explain, text
    from echolume_processing.export import formats

    said = explain(formats.read(args.map), args.x_mm, args.y_mm)
    sys.stdout.write(json.dumps(said, indent=1, allow_nan=False) + "\n" if args.json else text(said))
    return 0
