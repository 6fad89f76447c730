"""Run one of the lab's subscribers: optical or ultrasonic points from raw data, or the hybrid map of each scan.

example:
  echolume process hybrid --rig rig.toml --out results

`optical` and `ultrasonic` publish points on the bus; `hybrid` writes the map and its pictures to --out after a scan.
"""

from __future__ import annotations

import argparse
import importlib
import os
from pathlib import Path

from echolume_messages import rig as rig_file
from echolume_messages import topics

DEFAULT_RIG = "/etc/echolume/rig.toml"


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("subscriber", choices=topics.SUBSCRIBERS)
    parser.add_argument(
        "--rig",
        type=Path,
        default=Path(os.environ.get("ECHOLUME_RIG", DEFAULT_RIG)),
        help=f"the rig file (default: $ECHOLUME_RIG, else {DEFAULT_RIG})",
    )
    parser.add_argument("--out", type=Path, default=Path(), help="folder for the hybrid map (default: this folder)")


def run(args: argparse.Namespace) -> int:
    """Run the subscriber until SIGTERM or Ctrl-C."""
    rig = rig_file.load(args.rig)
    module = importlib.import_module(f"echolume_processing.subscribers.{args.subscriber}")
    return int(module.main(rig=rig, out=args.out))
