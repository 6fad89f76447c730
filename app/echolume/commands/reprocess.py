"""Rebuild the hybrid map of a scan from its raw archive; the same archive gives the same digest.

example:
  echolume reprocess demo-out/raw.mcap --out again

Writes hybrid.rrd, hybrid.ply, map.npz and figures/ to --out, by default `reprocessed` beside the archive.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from echolume.progress import Progress

if TYPE_CHECKING:
    from echolume_processing.session import Results


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("archive", type=Path, help="raw.mcap of a scan")
    parser.add_argument("--out", type=Path, help="folder for the results (default: `reprocessed` beside the archive)")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def run(args: argparse.Namespace) -> int:
    """Reprocess the archive and print what came out."""
    from echolume_processing.session import reprocess

    archive: Path = args.archive
    out: Path = args.out or archive.parent / "reprocessed"
    progress = Progress()
    progress.say(f"reading {archive}")
    results = reprocess(archive, out, progress.count)
    sys.stdout.write(json.dumps(results, indent=1) + "\n" if args.json else table(results, out))
    return 0


def table(results: Results, out: Path) -> str:
    """The results as text for people."""
    rows = [
        ("scan", results["scan"]),
        *((f"{name.replace('_', ' ')} points", str(count)) for name, count in results["points"].items()),
        *((f"{name} cells", str(count)) for name, count in results["cells"].items()),
        ("registration", f"{results['registration']['dz_mm']:+.3f} mm"),
        ("residual", f"{results['registration']['residual_db']:.1f} dB"),
        ("digest", results["digest"]),
        ("files", f"{out}: {', '.join(results['files'])}"),
        *(("note", note) for note in results["notes"]),
    ]
    width = max(len(name) for name, _ in rows)
    return "".join(f"{name:<{width}}  {value}\n" for name, value in rows)
