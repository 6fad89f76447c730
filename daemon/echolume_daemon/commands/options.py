"""Options that the rig's commands share."""

from __future__ import annotations

import argparse
from pathlib import Path

from echolume_daemon.client import default_holder
from echolume_messages.bus import Bus, connect
from echolume_messages.rig import Rig
from echolume_messages.rig_option import load_rig


def add_holder(parser: argparse.ArgumentParser) -> None:
    """``--holder NAME``."""
    parser.add_argument(
        "--holder", default=default_holder(), metavar="NAME", help="in whose name to command (default: %(default)s)"
    )


def join(path: Path) -> tuple[Rig, Bus]:
    """Read the rig file and connect to its bus."""
    rig = load_rig(path)
    return rig, join_bus(rig)


def join_bus(rig: Rig) -> Bus:
    """Connect to the bus of a rig."""
    return connect(rig.bus.endpoint, rig.name, shared_memory=rig.bus.shared_memory)
