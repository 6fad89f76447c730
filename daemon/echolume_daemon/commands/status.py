"""Show what the rig is doing: the run state, and each service with its devices.

example:
  echolume status --json
"""

from __future__ import annotations

import argparse
import json
import sys
from typing import cast

from echolume_daemon.body import Json
from echolume_daemon.commands.options import join
from echolume_messages.bus import Bus
from echolume_messages.errors import EcholumeError
from echolume_messages.rig_option import add_rig
from echolume_messages.topics import SERVICES


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    add_rig(parser)
    parser.add_argument("--json", action="store_true", help="print JSON")


def run(args: argparse.Namespace) -> int:
    """Ask every service; exit code 0 if all answer and no device is absent, else 5."""
    rig, bus = join(args.rig)
    with bus:
        services = {name: _ask(bus, name, alive=name in bus.alive()) for name in SERVICES}
    found: Json = {"rig": rig.name, "services": services}
    sys.stdout.write(json.dumps(found, indent=1) + "\n" if args.json else table(rig.name, services))
    return 0 if all(healthy(s) for s in services.values()) else 5


def _ask(bus: Bus, name: str, *, alive: bool) -> Json:
    if not alive:
        return {"alive": False, "error": "not running"}
    try:
        return {"alive": True, **bus.request(name, "scan.status" if name == "conductor" else "status", {}, 2.0)}
    except EcholumeError as error:
        return {"alive": True, "error": str(error)}


def healthy(status: Json) -> bool:
    """Whether a service answers and has its devices."""
    devices = cast("dict[str, Json]", status.get("devices", {}))
    return bool(status["alive"]) and not status.get("error") and all(d.get("state") == "ok" for d in devices.values())


def table(rig: str, services: dict[str, Json]) -> str:
    """The report as text, one line a service and one a device."""
    lines = [f"rig {rig}"]
    for name, status in services.items():
        lines.append(f"  {name:<10} {_word(status)}")
        for device, state in cast("dict[str, Json]", status.get("devices", {})).items():
            lines.append(f"    {device:<14} {state.get('state')}  {state.get('error', '')}".rstrip())
    return "\n".join(lines) + "\n"


def _word(status: Json) -> str:
    if not status["alive"]:
        return "not running"
    if "state" in status:
        where = f" {status.get('scan')} pass {status.get('pass')}" if status["state"] != "idle" else ""
        progress = f" {status.get('matched')}/{status.get('planned')} matched" if where else ""
        error = f" (last error: {status['error']})" if status.get("error") else ""
        return f"{status['state']}{where}{progress}{error}"
    return str(status.get("error") or "running")
