"""Rebuild the hybrid map of a scan from its raw archive; the same archive gives the same digest.

example:
  echolume reprocess demo-out/raw.mcap --out again
  echolume reprocess demo-out/raw.mcap --out gated --rule footprint-gate

Writes hybrid.rrd, hybrid.ply, map.npz, report.json and figures/ to --out, by default `reprocessed` beside the archive.
"""

from __future__ import annotations

import argparse
import json
import sys
from collections.abc import Sequence
from pathlib import Path

from echolume.progress import Progress
from echolume_processing.hybrid.rules.names import DEFAULT, DESCRIPTIONS


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("archive", type=Path, help="raw.mcap of a scan")
    parser.add_argument("--out", type=Path, help="folder for the results (default: `reprocessed` beside the archive)")
    parser.add_argument(
        "--rule",
        default=DEFAULT,
        metavar="NAME",
        help=f"how light and sound are fused: {', '.join(DESCRIPTIONS)} (default {DEFAULT})",
    )
    parser.add_argument("--list-rules", nargs=0, action=_ListRules, help="say what each rule does, and end")
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


class _ListRules(argparse.Action):
    """Prints the rules, each with what it does, and ends."""

    def __call__(
        self,
        parser: argparse.ArgumentParser,
        namespace: argparse.Namespace,
        values: str | Sequence[object] | None,
        option_string: str | None = None,
    ) -> None:
        del namespace, values, option_string
        width = max(map(len, DESCRIPTIONS))
        sys.stdout.write("".join(f"{name:{width}}  {text}\n" for name, text in DESCRIPTIONS.items()))
        parser.exit(0)


def run(args: argparse.Namespace) -> int:
    """Reprocess the archive and print what came out."""
    from echolume.report import table, write
    from echolume.results import scan_report
    from echolume_processing.session import reprocess

    archive: Path = args.archive
    out: Path = args.out or archive.parent / "reprocessed"
    progress = Progress()
    progress.say(f"reading {archive}")
    results = reprocess(archive, out, progress.count, args.rule)
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
