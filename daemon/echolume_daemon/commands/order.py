"""Orders to the conductor: pause, resume, abort, halt."""

from __future__ import annotations

import argparse
import json
import sys

from echolume_daemon.client import ScanClient
from echolume_daemon.commands.options import add_holder, join
from echolume_messages.rig_option import add_rig


def configure_order(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments of an order."""
    add_rig(parser)
    add_holder(parser)
    parser.add_argument("--json", action="store_true", help="print the state as JSON")


def send_order(args: argparse.Namespace, order: str) -> int:
    """Send an order and print the state that follows."""
    _, bus = join(args.rig)
    with bus:
        state = ScanClient(bus, args.holder).command(order)
    sys.stdout.write(json.dumps(state, indent=1) + "\n" if args.json else f"{state['state']}\n")
    return 0
