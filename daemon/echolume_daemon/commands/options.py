"""Options that the rig's commands share."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from echolume_daemon.client import default_holder
from echolume_daemon.service import DEFAULT_RIG, load_rig
from echolume_messages.bus import Bus, connect
from echolume_messages.rig import Rig


def add_rig(parser: argparse.ArgumentParser) -> None:
    """``--rig FILE``."""
    given = os.environ.get("ECHOLUME_RIG", "") or DEFAULT_RIG
    parser.add_argument(
        "--rig", type=Path, default=Path(given), metavar="FILE", help=f"rig file (default: $ECHOLUME_RIG, or {given})"
    )


def add_holder(parser: argparse.ArgumentParser) -> None:
    """``--holder NAME``."""
    parser.add_argument(
        "--holder", default=default_holder(), metavar="NAME", help="in whose name to command (default: %(default)s)"
    )


def join(path: Path) -> tuple[Rig, Bus]:
    """Read the rig file and connect to its bus."""
    rig = load_rig(path)
    return rig, connect(rig.bus.endpoint, rig.name, shared_memory=rig.bus.shared_memory)
