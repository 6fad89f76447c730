"""Calibrate cameras, laser, array, or the whole rig; align the laser's head.

examples:
  echolume calibrate cameras boards/ --pattern 9x6 --square 25
  echolume calibrate cameras --rig rig.toml --save boards
  echolume calibrate align --rig rig.toml
  echolume calibrate laser calibrate.mcap --into calibration.json
  echolume calibrate rig calibrate.mcap --out calibration.json
"""

from __future__ import annotations

import argparse
from importlib import import_module

KINDS = {
    "cameras": "both cameras, from a folder of board images or on the live rig",
    "laser": "cameras, rig frame and laser plane, from the archive of a calibration scan or while it runs",
    "align": "how far the laser plane is from parallel to YZ, live",
    "array": "the ultrasonic array, from the archive of a calibration scan",
    "rig": "cameras, laser and array, from the archive of a calibration scan",
}
_MODULES = {kind: f"echolume_processing.commands.calibrate_{kind}" for kind in KINDS} | {
    "rig": "echolume_processing.commands.calibrate_whole"
}


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands; each imports its libraries only when it runs."""
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="|".join(KINDS))
    for kind, about in KINDS.items():
        one = kinds.add_parser(kind, help=about, formatter_class=argparse.RawDescriptionHelpFormatter)
        import_module(_MODULES[kind]).configure(one)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand that was asked for."""
    return int(import_module(_MODULES[args.kind]).run(args))
