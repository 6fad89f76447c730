"""Run one of the rig's services until it is told to stop (SIGTERM or Ctrl-C).

example:
  echolume serve conductor --rig /etc/echolume/rig.toml
"""

from __future__ import annotations

import argparse
from importlib import import_module

from echolume_messages.rig_option import add_rig, load_rig
from echolume_messages.topics import SERVICES


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("service", choices=SERVICES, help="which service")
    add_rig(parser)


def run(args: argparse.Namespace) -> int:
    """Run the service in this process."""
    rig = load_rig(args.rig)
    service = import_module(f"echolume_daemon.{args.service}")
    return int(service.main(rig=rig))
