"""The router service: what all the others connect to."""

from __future__ import annotations

import threading

from echolume_daemon.body import Json
from echolume_daemon.service import Service, run_service
from echolume_messages.bus import Bus
from echolume_messages.bus.router import open_router
from echolume_messages.rig import Rig
from echolume_messages.rig_option import load_rig


class RouterPart:
    """The router needs no part: its presence is its token."""

    def __init__(self, service: Service) -> None:
        service.serve({"status": self._status})

    def health(self) -> Json:
        """Nothing beyond being there."""
        return {}

    def close(self) -> None:
        """The router is closed by `main`, after its token."""

    def _status(self, _body: Json) -> Json:
        return {"devices": {}}


def main(
    bus: Bus | None = None,
    rig: Rig | None = None,
    device: None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run the router until it is told to stop; returns the exit code."""
    rig = rig or load_rig()
    with open_router(rig.bus.endpoint, shared_memory=rig.bus.shared_memory):
        return run_service("router", RouterPart, bus, rig, stop)
