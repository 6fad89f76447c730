"""Runs the demo: emulated rig, services, calibration, scan, map, score."""

from __future__ import annotations

import time
from collections.abc import Generator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import msgspec

from echolume.demo.operator import Operator
from echolume.demo.plans import plan_text
from echolume.demo.timing import Passes
from echolume.processes import ProcessEndedError, ProcessTree
from echolume.progress import Progress
from echolume.report import Report, write
from echolume.results import judge_map, scan_report, score_maps
from echolume_daemon.client import ScanClient
from echolume_drivers.emulated.control import Control
from echolume_drivers.emulated.rig import FASTEST
from echolume_drivers.emulated.scene import named
from echolume_messages import calibration as calibration_file
from echolume_messages import plan as plans
from echolume_messages import rig as rig_file
from echolume_messages import topics
from echolume_messages.bus import Bus, connect
from echolume_messages.calibration import Calibration
from echolume_messages.errors import ConfigError, IncompleteScanError
from echolume_messages.files import make_folder, read_text
from echolume_messages.plan import Plan
from echolume_messages.rig import Rig

START_TIMEOUT_S = 300.0
"""The first start of an installation compiles all kernels, on a small machine for minutes."""
MAP_TIMEOUT_S = 240.0

Json = dict[str, Any]


@dataclass(frozen=True)
class DemoSettings:
    """What the user chose."""

    out: Path
    seed: int = 1
    speed: float = 50.0
    scene: str = "demo"
    pulse: str = "wideband"
    plan: Path | None = None


@dataclass(frozen=True)
class RunningRig:
    """The emulated rig and its services, up and connected."""

    rig: Rig
    rig_path: Path
    control: Control
    bus: Bus
    tree: ProcessTree


def run_demo(settings: DemoSettings, progress: Progress) -> Report:
    """Calibrate the emulated rig, scan its scene, and score the hybrid map.

    Raises
    ------
    EcholumeError
        A process ended, the calibration was rejected, or the scan is incomplete.
    """
    text = read_text(settings.plan, "the plan") if settings.plan else plan_text("demo")
    plan = plans.parse(text, str(settings.plan or "demo.toml"))
    _check(settings, plan)
    out = make_folder(settings.out).resolve()
    progress.say(
        "starting the emulated rig, the rig's services and the lab's subscribers (the first time, kernels compile)"
    )
    with ProcessTree(out / "logs") as tree, running_rig(settings, out, tree) as rig:
        started_s = time.monotonic()
        calibration = _calibrate(rig, out, progress)
        rig.control.place_scene(settings.scene)
        passes = Passes()
        done = _scan(rig, text, calibration, out, progress, passes)
        truth = out / "truth.npz"
        rig.control.truth(truth)
        total_s = time.monotonic() - started_s
        progress.say("scoring the maps against the truth")
        report: Report = {
            **scan_report(out / "raw.mcap", done),
            "seed": settings.seed,
            "maps": score_maps(out / "map.npz", truth, plan.map),
            "expectations": judge_map(out / "map.npz", truth, plan.map),
            "timing": {
                "total_s": total_s,
                "optical_pass_s": passes.seconds["optical"],
                "ultrasonic_pass_s": passes.seconds["ultrasonic"],
                "processing_lag_p99_ms": done["lag_p99_ms"],
            },
            "resources": {"peak_pss_mib": tree.peak_pss_mib},
            "unprocessed": done["missing"],
        }
    write(report, out)
    return report


def _check(settings: DemoSettings, plan: Plan) -> None:
    """Refuse at once what would fail after the calibration only."""
    try:
        named(settings.scene)
    except ConfigError as error:
        raise ConfigError(f"--scene {settings.scene}: {error}") from error
    if not 0 < settings.speed <= FASTEST:
        raise ConfigError(f"--speed {settings.speed:g}: must be above 0 and at most {FASTEST:g}")
    if settings.seed < 0:
        raise ConfigError(f"--seed {settings.seed}: must not be below 0")
    kinds = {step.kind for step in plans.expand(plan)}
    if not {"optical", "ultrasonic"} <= kinds:
        raise ConfigError(
            f"{settings.plan}: the demo compares light with sound; its plan needs an optical and an ultrasonic pass"
        )
    for item in plan.passes:
        if item.prompt:
            Operator(_Nobody()).answer(item.prompt)


class _Nobody:
    """Places nothing: to ask whether a prompt is understood."""

    def place_scene(self, name: str, /) -> None: ...

    def place_board(self, pose: int, /) -> None: ...


@contextmanager
def running_rig(settings: DemoSettings, out: Path, tree: ProcessTree) -> Generator[RunningRig]:
    """The emulated rig, its services and the subscribers, each in a process of its own."""
    folder = out / "rig"
    rig_path = folder / "rig.toml"
    rig_path.unlink(missing_ok=True)
    emulate = ["--seed", str(settings.seed), "--speed", str(settings.speed), "--pulse", settings.pulse]
    tree.start("emulated-rig", ["emulate", "--out", str(folder), *emulate])
    tree.wait_until(rig_path.exists, "the emulated rig", START_TIMEOUT_S)
    rig = rig_file.load(rig_path)
    for name in topics.SERVICES:
        tree.start(name, ["serve", name, "--rig", str(rig_path)], wave=1 if name == "router" else 2)
    for name in topics.SUBSCRIBERS:
        tree.start(name, ["process", name, "--rig", str(rig_path), "--out", str(out)], wave=3)
    wanted = {*topics.SERVICES[1:], *topics.SUBSCRIBERS}
    with (
        connect(rig.bus.endpoint, rig.name, timeout_s=START_TIMEOUT_S) as bus,
        Control.beside(rig_path) as control,
    ):
        tree.wait_until(lambda: wanted <= bus.alive(), f"services {', '.join(sorted(wanted))}", START_TIMEOUT_S)
        yield RunningRig(rig, rig_path, control, bus, tree)


def _follow(rig: RunningRig, progress: Progress, passes: Passes | None, state: Json) -> None:
    rig.tree.check()
    if passes is not None:
        passes.follow(str(state.get("kind", "")))
    if state.get("state") == "running":
        progress.count(str(state.get("pass", "")), int(state.get("matched", 0)), int(state.get("planned", 0)))


def _run_plan(
    rig: RunningRig,
    text: str,
    archive: Path,
    calibration: Calibration | None,
    progress: Progress,
    passes: Passes | None = None,
) -> Json:
    """Run a plan to its final ledger, with the demo's operator at hand."""
    archive.unlink(missing_ok=True)
    client = ScanClient(rig.bus, "demo")
    operator = Operator(rig.control)
    as_json = None if calibration is None else cast("Json", msgspec.to_builtins(calibration))
    client.start(text, archive=str(archive), calibration=as_json)
    ledger = cast("Json", client.wait(lambda state: _follow(rig, progress, passes, state), operator.answer))
    if ledger["outcome"] != "complete":
        missing = {name: row["missing_triggers"] for name, row in ledger["passes"].items() if row["missing"]}
        raise IncompleteScanError(f"scan {ledger['scan']}: {ledger['outcome']}; missing triggers: {missing or 'none'}")
    return ledger


def _calibrate(rig: RunningRig, out: Path, progress: Progress) -> Calibration:
    progress.say("calibrating: boards, stripes on boards, tilted poses over the plate, the block")
    archive = out / "calibration.mcap"
    _run_plan(rig, plan_text("calibrate"), archive, None, progress)
    from echolume_processing.calibrate_rig import calibrate_rig

    progress.say("working out the calibration")
    calibration, _ = calibrate_rig(archive, rig.rig.name, rig.rig.array)
    calibration_file.save(calibration, out / "calibration.json")
    return calibration


def _scan(rig: RunningRig, text: str, calibration: Calibration, out: Path, progress: Progress, passes: Passes) -> Json:
    progress.say("scanning: light, then sound")
    with rig.bus.subscribe([topics.HYBRID_DONE], depth=8) as done:
        ledger = _run_plan(rig, text, out / "raw.mcap", calibration, progress, passes)
        progress.say("fusing light and sound")
        deadline_s = time.monotonic() + MAP_TIMEOUT_S
        while time.monotonic() < deadline_s:
            rig.tree.check()
            message = done.get(0.5)
            if message is not None and (found := cast("Json", message.json()))["scan"] == ledger["scan"]:
                return found
    raise ProcessEndedError(f"hybrid: no map after {MAP_TIMEOUT_S:.0f} s; see {out / 'logs' / 'hybrid.log'}")
