"""The safe-state script as systemd runs it: ``python3 -I -S safe.py DEVICE ...``, against the emulated rig's wires."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

import echolume_daemon
from echolume_drivers.emulated.array_peer import ArrayPeer
from echolume_drivers.emulated.cia402 import State
from echolume_drivers.emulated.grbl_peer import GrblPeer
from echolume_drivers.emulated.robot_peer import RobotPeer
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stage import Stage
from echolume_drivers.emulated.trigger_peer import TriggerPeer
from echolume_drivers.grbl import GrblGuide
from echolume_drivers.robot import Cia402Robot
from echolume_drivers.trigger import TriggerUnit
from echolume_messages.errors import DeviceFaultError
from echolume_messages.rig import GuideSettings, RobotSettings, TriggerSettings

SCRIPT = Path(echolume_daemon.__file__).with_name("safe.py")


def safe(*arguments: str) -> tuple[int, str]:
    begin_s = time.monotonic()
    run = subprocess.run(
        [sys.executable, "-I", "-S", str(SCRIPT), *arguments], capture_output=True, text=True, timeout=20, check=False
    )
    assert time.monotonic() - begin_s < 8
    return run.returncode, run.stdout + run.stderr


@pytest.fixture
def stage() -> Stage:
    return Stage(seed=1, scene=plate(), speed=1.0)


@pytest.fixture
def board(stage: Stage) -> Iterator[GrblPeer]:
    """A board without dead-man, whose laser has been left burning by a host that died."""
    peer = GrblPeer(stage, bare=True, start_x_mm=149.0)
    peer.start()
    lit = threading.Event()
    stage.watch_laser(lambda on: lit.set() if on else None)
    guide = GrblGuide(GuideSettings(port=peer.url))
    guide.open()
    guide.home()
    guide._link.send(b"G1 F6000\nM3 S500\n")
    assert lit.wait(3.0)
    guide._link.close()
    yield peer
    peer.close()


def test_it_needs_nothing_but_the_standard_library() -> None:
    code = f"import runpy, sys; runpy.run_path({str(SCRIPT)!r}); print(*sys.modules)"
    run = subprocess.run([sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, check=True)
    assert not {"serial", "can", "canopen", "numpy", "msgspec", "zenoh"} & set(run.stdout.split())


def test_guide_switches_a_burning_laser_off(stage: Stage, board: GrblPeer) -> None:
    assert stage.laser_on
    assert safe("guide", board.url) == (0, "safe guide: laser off: the controller confirmed a reset\n")
    assert not stage.laser_on


def test_guide_held_by_another_program_is_reset_but_not_confirmed(stage: Stage, board: GrblPeer) -> None:
    guide = GrblGuide(GuideSettings(port=board.url))
    guide.open()
    try:
        code, said = safe("guide", board.url)
        assert code == 1
        assert "NOT CONFIRMED" in said
        assert "held by another program" in said
        assert not stage.laser_on
    finally:
        guide.close()


def test_guide_that_hangs_is_not_called_safe(board: GrblPeer) -> None:
    board._resets_on_open = False
    board.inject("hang")
    code, said = safe("guide", board.url)
    assert code == 1
    assert "use the emergency stop" in said


@pytest.mark.parametrize("device", ["guide", "trigger", "array"])
def test_an_absent_device_is_nothing_to_make_safe(device: str) -> None:
    code, said = safe(device, "/dev/echolume-none")
    assert code == 0
    assert said == f"safe {device}: absent, nothing to make safe: /dev/echolume-none: No such file or directory\n"


def test_a_file_that_is_no_port_is_said_to_be_none(tmp_path: Path) -> None:
    path = tmp_path / "port"
    path.write_bytes(b"")
    code, said = safe("guide", str(path))
    assert code == 0
    assert "not a serial port" in said


@pytest.mark.parametrize("arguments", [[], ["laser"], ["guide"], ["guide", "--rig"], ["camera", "/dev/null"]])
def test_wrong_use_is_refused(arguments: list[str]) -> None:
    code, said = safe(*arguments)
    assert code == 2
    assert "usage" in said


def test_trigger_is_disarmed(stage: Stage, tmp_path: Path) -> None:
    peer = TriggerPeer(stage, [])
    peer.start()
    try:
        unit = TriggerUnit(TriggerSettings(port=peer.url))
        unit.open()
        unit.arm_external(0.02)
        unit.close()
        rig = tmp_path / "rig.toml"
        rig.write_text(f'[trigger]\nport = "{peer.url}"\n')
        assert safe("cameras", "--rig", str(rig)) == (0, "safe trigger: trigger unit disarmed\n")
        unit.open()
        before = unit.count()
        stage.switch_laser(True)
        stage.switch_laser(False)
        assert unit.count() == before
        unit.close()
    finally:
        peer.close()


def test_array_is_aborted() -> None:
    with socket.create_server(("127.0.0.1", 0)) as door:
        seen: list[bytes] = []

        def instrument() -> None:
            wire, _ = door.accept()
            with wire:
                data = b""
                while b"*OPC?" not in data:
                    data += wire.recv(1024)
                seen.append(data)
                wire.sendall(b"1\n")

        thread = threading.Thread(target=instrument)
        thread.start()
        assert safe("array", f"socket://127.0.0.1:{door.getsockname()[1]}") == (
            0,
            "safe array: array digitiser aborted\n",
        )
        thread.join(5.0)
        assert b"ABOR\n" in seen[0]


def test_robot_is_stopped_in_the_air(stage: Stage, tmp_path: Path) -> None:
    peer = RobotPeer(stage)
    peer.start()
    host, port = peer.address
    robot = Cia402Robot(RobotSettings(host=host, port=port))

    def travel() -> None:
        with pytest.raises(DeviceFaultError, match="stopped on the way"):
            robot.move([300.0, 0, 250, 0, 0, 0])

    mover = threading.Thread(target=travel)
    try:
        robot.open()
        robot.enable()
        mover.start()
        deadline_s = time.monotonic() + 3
        while stage.robot_pose()[0] < 20:
            assert time.monotonic() < deadline_s
        rig = tmp_path / "rig.toml"
        rig.write_text(f'[robot]\nhost = "{host}"\nport = {port}\n')
        assert safe("robot", "--rig", str(rig)) == (0, "safe robot: 6 axes stopped\n")
        assert all(axis.state is not State.OPERATION_ENABLED for axis in peer.axes)
        assert stage.robot_pose()[0] < 290
    finally:
        mover.join(5.0)
        robot.close()
        peer.close()


def test_robot_with_a_dead_axis_is_not_called_safe(stage: Stage) -> None:
    peer = RobotPeer(stage)
    peer.axes[1].dead = True
    peer.start()
    try:
        code, said = safe("robot", f"{peer.url}/can0")
        assert code == 1
        assert "nodes without answer [2]" in said
    finally:
        peer.close()


def test_robot_without_a_bus_is_absent() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    code, said = safe("robot", f"127.0.0.1:{port}/can0")
    assert code == 0
    assert "absent" in said


def test_a_rig_file_that_cannot_be_read_is_an_error(tmp_path: Path) -> None:
    assert safe("guide", "--rig", str(tmp_path / "none.toml"))[0] == 2
    broken = tmp_path / "rig.toml"
    broken.write_text("[guide]\nprot = 1\n")
    assert safe("guide", "--rig", str(broken))[0] == 2
    assert os.access(SCRIPT, os.R_OK)


def test_the_array_peer_understands_the_safe_state(stage: Stage) -> None:
    from echolume_drivers.emulated.array_truth import array_truth
    from echolume_messages.rig import ArraySettings

    settings = ArraySettings(port="")
    peer = ArrayPeer(stage, settings, array_truth(1, settings))
    peer.start()
    try:
        assert safe("array", peer.url)[0] == 0
    finally:
        peer.close()
