"""Scans over the true wires: every service a process, the devices those of the emulated rig."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.fake_rig import wait_until
from echolume_daemon.client import ScanClient
from echolume_daemon.ledger import Ledger
from echolume_drivers.emulated.control import Control
from echolume_messages import archive
from echolume_messages import rig as rig_file
from echolume_messages.bus import Bus, connect
from echolume_messages.topics import SERVICES

PLAN = """
name = "small"
[[pass]]
name = "light"
kind = "optical"
start_mm = -4.0
stop_mm = 4.0
pitch_mm = 2.0
[[pass]]
name = "sound"
kind = "ultrasonic"
x_mm = [-10.0, 10.0]
y_mm = [0.0, 10.0]
pitch_mm = 10.0
height_mm = 150.0
"""
LONG = PLAN.replace("4.0\npitch_mm = 2.0", "60.0\npitch_mm = 2.0")
ENDLESS = PLAN.replace("-4.0", "-100.0").replace("4.0\npitch_mm = 2.0", "100.0\npitch_mm = 0.1")


class Floor:
    """The emulated rig and its services, each a process."""

    def __init__(self, folder: Path) -> None:
        self.folder, self.children = folder, dict[str, subprocess.Popen[bytes]]()

    def run(self, name: str, *arguments: str) -> None:
        """Start ``echolume ARGUMENTS``."""
        log = (self.folder / f"{name}.log").open("ab")
        with log:
            command = [sys.executable, "-m", "echolume", *arguments]
            self.children[name] = subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log)

    def serve(self, *names: str) -> None:
        """Start services."""
        for name in names:
            self.run(name, "serve", name, "--rig", str(self.rig_path))

    def kill(self, *names: str) -> None:
        """End processes without asking."""
        for name in names:
            child = self.children.pop(name)
            child.kill()
            child.wait()

    @property
    def rig_path(self) -> Path:
        return self.folder / "rig" / "rig.toml"

    def close(self) -> dict[str, int]:
        """SIGTERM to all; their exit codes."""
        for child in self.children.values():
            child.terminate()
        codes = {}
        for name, child in self.children.items():
            try:
                codes[name] = child.wait(10.0)
            except subprocess.TimeoutExpired:
                child.kill()
                codes[name] = child.wait()
        return codes


@pytest.fixture(scope="module")
def floor(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Floor]:
    made = Floor(tmp_path_factory.mktemp("floor"))
    try:
        made.run("emulated-rig", "emulate", "--seed", "5", "--speed", "8", "--out", str(made.folder / "rig"))
        wait_until(made.rig_path.exists, "the emulated rig", 60.0)
        made.serve(*SERVICES)
        yield made
    finally:
        codes = made.close()
    assert set(codes.values()) == {0}, codes


@pytest.fixture(scope="module")
def bus(floor: Floor) -> Iterator[Bus]:
    rig = rig_file.load(floor.rig_path)
    with connect(rig.bus.endpoint, rig.name, timeout_s=20.0) as made:
        wait_until(lambda: set(SERVICES) <= made.alive(), "all services alive")
        yield made


@pytest.fixture
def control(floor: Floor) -> Iterator[Control]:
    with Control.beside(floor.rig_path) as made:
        yield made


def test_a_scan_over_the_true_wires_closes_its_ledger(bus: Bus, control: Control, tmp_path: Path) -> None:
    path = tmp_path / "raw.mcap"
    client = ScanClient(bus, "ann@lab")
    scan = client.start(PLAN, archive=str(path))
    ledger = client.wait()
    assert ledger["outcome"] == "complete", ledger
    for entry in ledger["passes"].values():
        assert entry["planned"] == entry["fired"] == entry["matched"]
        assert (entry["missing"], entry["duplicate"], entry["extra"]) == (0, 0, 0)
    found = archive.summary(path)
    raw = sum(found.records[name] for name in ("cameras/left", "cameras/right", "array/echoes"))
    assert raw == ledger["acknowledged"] == 5 * 2 + 6
    assert not found.torn
    assert found.records["conductor/start"] == 1
    finals = [m.json() for m in archive.read(path, {"conductor/ledger"})]
    assert {key: finals[-1][key] for key in ("final", "outcome")} == {"final": True, "outcome": "complete"}
    for message in archive.read(path, {"cameras/left", "array/echoes"}):
        source = message.header.source
        if message.topic.name == "cameras/left":
            assert source.x_mm == pytest.approx(-4.0 + 2.0 * message.header.trigger)
            assert source.laser_on
            assert message.payload.max() > 100
        else:
            assert source.robot_pose is not None
            assert source.robot_pose[2] == pytest.approx(150.0, abs=0.1)
    assert control.status()["laser_on"] is False
    rebuilt, start = Ledger.from_archive(path)
    assert start.scan == scan
    assert rebuilt.report(scan, "complete", final=True)["passes"] == ledger["passes"]


def test_dropped_and_doubled_frames_are_told_apart(bus: Bus, control: Control, tmp_path: Path) -> None:
    client = ScanClient(bus, "ann@lab")
    control.fault("camera-left", "drop")
    client.start(PLAN, archive=str(tmp_path / "raw.mcap"))
    ledger = client.wait()
    light = ledger["passes"]["light"]
    assert ledger["outcome"] == "complete"
    assert (light["matched"], light["fired"], light["records"]["missing"]) == (5, 6, 1)
    control.fault("camera-right", "duplicate")
    client.start(PLAN, archive=str(tmp_path / "again.mcap"))
    light = client.wait()["passes"]["light"]
    assert (light["matched"], light["duplicate"], light["extra"]) == (5, 1, 0)


def test_a_lost_ping_is_acquired_again(bus: Bus, control: Control, tmp_path: Path) -> None:
    control.fault("array", "truncated_block")
    client = ScanClient(bus, "ann@lab")
    client.start(PLAN, archive=str(tmp_path / "raw.mcap"))
    ledger = client.wait()
    assert (ledger["outcome"], ledger["passes"]["sound"]["fired"]) == ("complete", 7)


def test_halt_stops_the_wires(bus: Bus, control: Control, tmp_path: Path) -> None:
    client = ScanClient(bus, "ann@lab")
    client.start(ENDLESS, archive=str(tmp_path / "raw.mcap"))
    wait_until(lambda: client.status()["matched"] > 2, "some triggers matched")
    client.command("halt")
    assert control.status()["laser_on"] is False
    ledger = client.wait()
    assert ledger["outcome"] == "aborted"
    assert ledger["passes"]["light"]["matched"] < 2001


def test_after_a_crash_a_scan_goes_on_where_it_stood(floor: Floor, bus: Bus, tmp_path: Path) -> None:
    path = tmp_path / "raw.mcap"
    client = ScanClient(bus, "ann@lab")
    scan = client.start(LONG, archive=str(path))
    wait_until(lambda: client.status()["matched"] > 5, "some triggers matched")
    floor.kill("conductor", "recorder")
    wait_until(lambda: not {"conductor", "recorder"} & bus.alive(), "their tokens are gone")
    assert archive.summary(path).torn
    before = Ledger.from_archive(path)[0].count()[2]
    assert before > 5
    floor.serve("recorder", "conductor")
    wait_until(lambda: {"conductor", "recorder"} <= bus.alive(), "both are back")
    assert client.start(LONG, archive=str(path)) == scan
    ledger = client.wait()
    assert ledger["outcome"] == "complete"
    assert ledger["passes"]["light"]["matched"] == 33
    assert ledger["passes"]["light"]["fired"] <= 33 + 5
    assert not archive.summary(path).torn


def test_the_scan_command_shows_the_ledger(floor: Floor, bus: Bus, tmp_path: Path) -> None:
    plan = tmp_path / "plan.toml"
    plan.write_text(PLAN, encoding="utf-8")
    command = [sys.executable, "-m", "echolume"]
    rig = ["--rig", str(floor.rig_path)]
    done = subprocess.run(
        [*command, "scan", str(plan), *rig, "--out", str(tmp_path / "out"), "--json", "--holder", "ann@lab"],
        capture_output=True,
        text=True,
        timeout=60,
    )
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["outcome"] == "complete"
    assert (tmp_path / "out" / "raw.mcap").exists()
    assert "light" in done.stderr
    status = subprocess.run([*command, "status", *rig], capture_output=True, text=True, timeout=30)
    assert status.returncode == 0
    assert "conductor  idle" in status.stdout
    assert "camera-left    ok" in status.stdout
    refused = subprocess.run([*command, "resume", *rig], capture_output=True, text=True, timeout=30)
    assert refused.returncode == 4
    assert "cannot resume while idle" in refused.stderr or "commands the rig" in refused.stderr
