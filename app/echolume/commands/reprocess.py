"""Rebuild the hybrid map of a scan from its raw archive; the same archive gives the same digest.

example:
  echolume reprocess demo-out/raw.mcap --out again

Writes hybrid.rrd, hybrid.ply, map.npz, report.json and figures/ to --out, by default `reprocessed` beside the archive.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from echolume.progress import Progress


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("archive", type=Path, help="raw.mcap of a scan")
    parser.add_argument("--out", type=Path, help="folder for the results (default: `reprocessed` beside the archive)")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def run(args: argparse.Namespace) -> int:
    """Reprocess the archive and print what came out."""
    from echolume.report import table, write
    from echolume.results import scan_report
    from echolume_processing.session import reprocess

    archive: Path = args.archive
    out: Path = args.out or archive.parent / "reprocessed"
    progress = Progress()
    progress.say(f"reading {archive}")
    results = reprocess(archive, out, progress.count)
    report = scan_report(archive, results)
    write(report, out)
    if report["archive"]["torn"]:
        sys.stderr.write(
            f"echolume: {archive}: its end is missing or damaged; the map is made of what is before that\n"
        )
    sys.stdout.write(json.dumps(report, indent=1) + "\n" if args.json else "\n" + table(report))
    if not args.json:
        sys.stdout.write(f"\nResults are in {out}: {', '.join(results['files'])}, report.json\n")
    return 0
