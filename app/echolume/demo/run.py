"""Runs the demo: emulated rig, services, calibration, scan, map, score."""

from __future__ import annotations

import os
import socket
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from importlib.metadata import version
from pathlib import Path
from typing import Any

import msgspec

from echolume.demo.operator import Operator
from echolume.demo.plans import plan_text
from echolume.demo.report import Report
from echolume.demo.truth import score_maps
from echolume.processes import ProcessTree
from echolume.progress import Progress
from echolume_daemon.client import ScanClient
from echolume_drivers.emulated.control import Control
from echolume_messages import calibration as calibration_file
from echolume_messages import plan as plans
from echolume_messages import rig as rig_file
from echolume_messages import topics
from echolume_messages.archive import summary
from echolume_messages.bus import Bus, Subscription, connect
from echolume_messages.errors import IncompleteScanError
from echolume_messages.rig_text import rig_toml

START_TIMEOUT_S = 60.0
MAP_TIMEOUT_S = 180.0


@dataclass(frozen=True)
class DemoSettings:
    """What the user chose."""

    out: Path
    seed: int = 1
    speed: float = 50.0
    scene: str = "demo"
    pulse: str = "wideband"
    plan: Path | None = None


@dataclass
class Timing:
    """When things happened, seconds on the monotonic clock."""

    started_s: float = field(default_factory=time.monotonic)
    passes_s: dict[str, float] = field(default_factory=dict[str, float])
    _at: tuple[str, float] = ("", 0.0)

    def follow(self, kind: str) -> None:
        """Charge the time since the last call to the kind of pass that was running."""
        now_s = time.monotonic()
        last, since_s = self._at
        if last:
            self.passes_s[last] = self.passes_s.get(last, 0.0) + now_s - since_s
        self._at = (kind, now_s)


def free_port() -> int:
    """A TCP port on 127.0.0.1 that was free a moment ago."""
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def run_demo(settings: DemoSettings, progress: Progress) -> Report:
    """Scan the emulated rig into a hybrid map.

    Raises
    ------
    EcholumeError
        A process ended, the calibration was rejected, or the scan is incomplete.
    """
    out = settings.out.resolve()
    out.mkdir(parents=True, exist_ok=True)
    plan = plans.load(settings.plan) if settings.plan else plans.parse(plan_text("demo"), "demo.toml")
    plan_toml = settings.plan.read_text(encoding="utf-8") if settings.plan else plan_text("demo")
    with ProcessTree(out / "logs") as tree:
        progress.say("starting the emulated rig and its services")
        rig, rig_path, control = _start_rig(settings, out, tree)
        with connect(rig.bus.endpoint, rig.name, timeout_s=START_TIMEOUT_S) as bus:
            _start_services(rig_path, out, bus, tree)
            timing = Timing()
            calibration = _calibrate(rig, out, bus, control, tree, progress)
            control.place_scene(settings.scene)
            _scan(plan_toml, calibration, rig, out, bus, tree, progress, timing)
            raise NotImplementedError
