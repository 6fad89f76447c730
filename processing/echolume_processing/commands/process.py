"""Run one of the lab's subscribers: optical or ultrasonic points from raw data, or the hybrid map of each scan.

example:
  echolume process hybrid --rig rig.toml --out results

`optical` and `ultrasonic` publish points on the bus; `hybrid` writes the map and its pictures to --out after a scan.
"""

from __future__ import annotations

import argparse
import importlib
from pathlib import Path

from echolume_messages import topics
from echolume_messages.files import make_folder
from echolume_messages.rig_option import add_rig, load_rig


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("subscriber", choices=topics.SUBSCRIBERS)
    add_rig(parser)
    parser.add_argument("--out", type=Path, default=Path(), help="folder for the hybrid map (default: this folder)")


def run(args: argparse.Namespace) -> int:
    """Run the subscriber until SIGTERM or Ctrl-C."""
    rig = load_rig(args.rig)
    if args.subscriber == "hybrid":
        make_folder(args.out)
    module = importlib.import_module(f"echolume_processing.subscribers.{args.subscriber}")
    return int(module.main(rig=rig, out=args.out))
