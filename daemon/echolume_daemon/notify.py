"""Tell systemd how the service is: READY, STATUS, WATCHDOG, STOPPING over ``$NOTIFY_SOCKET``."""

from __future__ import annotations

import os
import socket


def notify(*fields: str) -> bool:
    """Send fields such as ``READY=1`` to the service manager.

    Returns
    -------
    bool
        False where there is no manager that listens (started by hand, or by the demo).
    """
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return False
    if address.startswith("@"):
        address = "\0" + address[1:]
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as channel:
        channel.sendto("\n".join(fields).encode(), address)
    return True


def watchdog_period_s() -> float | None:
    """Half of the watchdog's time for this process, or None where systemd set none."""
    text, owner = os.environ.get("WATCHDOG_USEC", ""), os.environ.get("WATCHDOG_PID", "")
    if not text or (owner and int(owner) != os.getpid()):
        return None
    return int(text) * 0.5e-6
