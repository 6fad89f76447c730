"""Score a hybrid map against the truth: heights, labels, glass, steps, flatness, and whether its sigmas hold.

example:
  echolume evaluate demo-out/map.npz demo-out/truth.npz --figure errors.png

MAP is map.npz, hybrid.ply or an export of them. TRUTH is truth.npz of the emulated rig, or another map on the same
cells, e.g. one of the same object with its glass and black coated. A figure that nothing supports is `-`, in JSON null.
How to test a scanner on glass and black with it: docs/protocol.md.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("map", type=Path, help="the map to score")
    parser.add_argument("truth", type=Path, help="what it should be")
    parser.add_argument("--layer", metavar="NAME", help="score another image of map.npz, e.g. optical_mm")
    parser.add_argument("--figure", type=Path, metavar="FILE.png", help="draw the error map")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Evaluate, draw if asked, print."""
    from echolume.evaluation.evaluate import evaluate, load
    from echolume.evaluation.table import table
    from echolume_messages.errors import ConfigError
    from echolume_messages.files import replace_bytes, require_place

    figure: Path | None = args.figure
    if figure is not None and require_place(figure, "--figure").suffix.lower() != ".png":
        raise ConfigError(f"--figure {figure}: pictures are PNG; give a name that ends in .png")
    claimed, truth, field, sources = load(args.map, args.truth, args.layer)
    found = evaluate(claimed, truth, field, sources)
    if figure is not None:
        from echolume.evaluation.picture import picture

        replace_bytes(figure, picture(claimed, truth, field, found))
    sys.stdout.write(json.dumps(found, indent=1, allow_nan=False) + "\n" if args.json else table(found))
    return 0
