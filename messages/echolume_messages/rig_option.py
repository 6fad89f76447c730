"""Where a program finds its rig file: ``--rig FILE``, else ``$ECHOLUME_RIG``, else /etc/echolume/rig.toml."""

from __future__ import annotations

import argparse
import os
from pathlib import Path

from echolume_messages import rig as rig_file
from echolume_messages.rig import Rig

INSTALLED = Path("/etc/echolume/rig.toml")


def default_path() -> Path:
    """The rig file of a program that was not told one."""
    given = os.environ.get("ECHOLUME_RIG", "")
    return Path(given) if given else INSTALLED


def add_rig(parser: argparse.ArgumentParser) -> None:
    """``--rig FILE``."""
    default = default_path()
    parser.add_argument(
        "--rig", type=Path, default=default, metavar="FILE", help=f"rig file (default: $ECHOLUME_RIG, or {default})"
    )


def load_rig(path: Path | None = None) -> Rig:
    """Read the rig file: `path`, else the default one."""
    return rig_file.load(path or default_path())
