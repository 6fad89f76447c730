"""Write a hybrid map for other programs; the ending of each file's name is its format.

example:
  echolume export demo-out/map.npz --to map.las map.e57 map.mesh.ply

  .ply       a point a cell with a height, mm, every field a property
  .mesh.ply  triangles, mm: the solid surface and the glass on its own; unknown cells are holes, steps stay open
             (--walls closes them)
  .las       LAS 1.4, metres, every field as extra bytes
  .e57       ASTM E57, metres, every field in an extension
  .npz       every field an image, for numpy

MAP is any of them. What is known about the map (scan, calibration, notes, field, digest) goes along.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("map", type=Path, help="map.npz or hybrid.ply of a scan, or an export of them")
    parser.add_argument("--to", type=Path, nargs="+", required=True, metavar="FILE", help="files to write")
    parser.add_argument(
        "--walls", action="store_true", help="in .mesh.ply, close steps with walls, which nothing measured"
    )
    parser.add_argument("--json", action="store_true", help="print what was written as JSON")


def run(args: argparse.Namespace) -> int:
    """Read the map, write each file as a whole or not at all."""
    from echolume_messages.files import require_place
    from echolume_processing.export import formats, mesh

    to: list[Path] = args.to
    kinds = [formats.format_of(require_place(path, "--to")) for path in to]
    stored = formats.read(args.map)
    rows: list[dict[str, object]] = []
    for path, kind in zip(to, kinds, strict=True):
        walled = args.walls and kind.counts == "triangles"
        count = mesh.write(stored, path, walls=True) if walled else kind.write(stored, path)
        rows.append({"file": str(path), kind.counts: count, "bytes": path.stat().st_size})
        if not args.json:
            sys.stdout.write(f"{path}: {count} {kind.counts}, {path.stat().st_size / 1e6:.1f} MB\n")
    if args.json:
        sys.stdout.write(json.dumps(rows, indent=1) + "\n")
    return 0
