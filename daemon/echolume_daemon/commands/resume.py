"""Go on with a paused scan, or answer its prompt.

example:
  echolume resume
"""

from __future__ import annotations

import argparse

from echolume_daemon.commands.order import configure_order, send_order


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    configure_order(parser)


def run(args: argparse.Namespace) -> int:
    """Send the order to the conductor."""
    return send_order(args, "resume")
