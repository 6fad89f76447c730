"""Scan the emulated rig into a hybrid map: calibration, light, sound, fusion, report.

Needs no hardware. Starts the emulated rig, the rig's services and the lab's subscribers as processes of their own on
127.0.0.1, and stops them all at the end.

example: echolume demo --out demo-out
then look at demo-out/figures/, demo-out/hybrid.ply, demo-out/report.json, and `rerun demo-out/hybrid.rrd`
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
from pathlib import Path
from types import FrameType

from echolume.scene_option import add_scene_option


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--out", type=Path, default=Path("demo-out"), help="folder for the results (default demo-out)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the rig's build and its noise (default 1)")
    add_scene_option(parser)
    parser.add_argument(
        "--pulse",
        choices=("wideband", "paper"),
        default="wideband",
        help="ultrasonic transducers: 30-60 kHz, or the paper's 40 kHz narrow band",
    )
    parser.add_argument("--plan", type=Path, help="scan plan (default: the demo's own)")
    parser.add_argument("--speed", type=float, default=50.0, help="how much faster than real the emulated axes move")
    parser.add_argument("--json", action="store_true", help="print report.json instead of a table")


def _terminate(number: int, frame: FrameType | None) -> None:
    del frame
    raise SystemExit(128 + number)


def run(args: argparse.Namespace) -> int:
    """Run the demo; 0 only if the ledger closes, the archive is whole and no sensor alone beats the map."""
    signal.signal(signal.SIGTERM, _terminate)
    signal.signal(signal.SIGHUP, _terminate)
    from echolume.demo.run import DemoSettings, run_demo
    from echolume.progress import Progress
    from echolume.report import table, verdict

    settings = DemoSettings(args.out, args.seed, args.speed, args.scene, args.pulse, args.plan)
    report = run_demo(settings, Progress())
    reasons = verdict(report)
    sys.stdout.write(json.dumps(report, indent=1) + "\n" if args.json else "\n" + table(report))
    for reason in reasons:
        sys.stderr.write(f"echolume: demo failed: {reason}\n")
    if not reasons and not args.json:
        sys.stdout.write(f"\nResults are in {args.out}; `rerun {args.out}/hybrid.rrd` shows the recording.\n")
    return 9 if reasons else 0
