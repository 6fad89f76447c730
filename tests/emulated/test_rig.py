"""The emulated rig as a whole: its rig file, a scan step over all wires, and nothing left behind."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest

from echolume_drivers.array import ArrayDigitiser
from echolume_drivers.cameras import open_camera
from echolume_drivers.emulated.control import Control
from echolume_drivers.emulated.facets import build_facets
from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.rig import EmulatedRig, something_of_everything, toml_text
from echolume_drivers.emulated.scene import Material
from echolume_drivers.emulated.stripe_image import true_stripe
from echolume_drivers.grbl import GrblGuide
from echolume_drivers.trigger import TriggerUnit
from echolume_messages import rig as rig_file
from echolume_messages.errors import ConfigError, NoReplyError

SEED = 11


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedRig]:
    with EmulatedRig(SEED, "demo", 100.0, "wideband", tmp_path_factory.mktemp("rig")) as found:
        yield found


def open_terminals() -> int:
    """How many pseudo-terminals this process holds."""
    found = (fd for fd in Path("/proc/self/fd").iterdir() if fd.exists())
    return sum(str(fd.resolve()).startswith(("/dev/pts/ptmx", "/dev/ptmx", "/dev/pts/")) for fd in found)


def test_the_rig_file_reads_back_as_the_rig(rig: EmulatedRig) -> None:
    assert rig_file.load(rig.rig_file) == rig.rig
    assert rig_file.parse(toml_text(rig.rig)) == rig.rig
    assert rig.rig.name == f"emulated-{SEED}"


def test_everything_is_on_loopback_or_a_pty(rig: EmulatedRig) -> None:
    found = rig.rig
    assert found.bus.endpoint.startswith("tcp/127.0.0.1:")
    assert found.robot.host == "127.0.0.1"
    assert found.array.port.startswith("socket://127.0.0.1:")
    for camera in (found.cameras.left, found.cameras.right):
        assert camera.address.startswith("127.0.0.1:")
    for port in (found.guide.port, found.trigger.port):
        assert port.startswith("/dev/pts/")


def test_a_step_of_the_guide_fires_both_cameras_on_the_lit_stripe(rig: EmulatedRig) -> None:
    guide, trigger = GrblGuide(rig.rig.guide), TriggerUnit(rig.rig.trigger)
    left, right = open_camera(rig.rig.cameras.left, "left"), open_camera(rig.rig.cameras.right, "right")
    guide.open()
    trigger.open()
    try:
        guide.home()
        left.start()
        right.start()
        trigger.arm_external(4e-3)
        truth = optical_truth(SEED)
        for k, x_mm in enumerate((-40.0, 12.5)):
            assert guide.expose(x_mm, 4e-3) == pytest.approx(x_mm, abs=0.01)
            for side, camera in (("left", left), ("right", right)):
                frame = camera.read(5.0)
                assert frame.frame_id == k + 1
                assert frame.exposure_s == 4e-3
                expected = true_stripe(rig.stage.scene, truth, side, rig.stage.guide_x_mm()).rows(1024)
                rows = np.flatnonzero(np.isfinite(expected) & (frame.pixels.max(axis=1) > 60))
                assert len(rows) > 300
                assert np.median(np.abs(frame.pixels[rows].argmax(axis=1) - expected[rows])) < 1.0
        assert trigger.count() == 2
        assert not rig.stage.laser_on
    finally:
        for device in (left, right, trigger, guide):
            device.close()


def test_the_array_hears_the_bench(rig: EmulatedRig) -> None:
    array = ArrayDigitiser(rig.rig.array)
    array.open()
    try:
        array.configure()
        assert array.ping().block.shape == (8, 1024)
    finally:
        array.close()


def test_close_leaves_no_pty_port_thread_or_file_and_the_laser_off(tmp_path: Path) -> None:
    before, terminals = set(threading.enumerate()), open_terminals()
    rig = EmulatedRig(1, "plate", 50.0, "paper", tmp_path)
    rig.start()
    found, address = rig.rig, rig.control_address
    assert found.array.pulse == "paper"
    assert open_terminals() > terminals
    rig.stage.switch_laser(True)
    rig.close()
    rig.close()
    assert not rig.stage.laser_on
    assert set(threading.enumerate()) == before
    assert list(tmp_path.iterdir()) == []
    assert open_terminals() == terminals
    ports = [address, found.cameras.left.address, found.cameras.right.address, found.array.port, found.robot.port]
    for port in (int(str(p).rpartition(":")[2]) for p in ports):
        with pytest.raises(ConnectionRefusedError):
            socket.create_connection(("127.0.0.1", port), timeout=1).close()


def test_a_device_that_fails_to_start_takes_the_others_with_it(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = set(threading.enumerate())

    def refuse(_: object) -> None:
        raise OSError("no more ports")

    monkeypatch.setattr("echolume_drivers.emulated.rig.TriggerPeer.start", refuse)
    rig = EmulatedRig(1, directory=tmp_path)
    with pytest.raises(OSError, match=r"no more ports"):
        rig.start()
    assert set(threading.enumerate()) == before
    assert not rig.rig_file.exists()


def test_what_is_compiled_before_the_first_trigger_needs_every_forward_model() -> None:
    scene = something_of_everything()
    assert scene.bends_light
    assert scene.air.smoke_per_m > 0
    assert np.any(scene.lit_material == Material.MIRROR)
    assert len(build_facets(scene).tilted)


@pytest.mark.parametrize(
    ("arguments", "complaint"),
    [({"scene_name": "moon"}, r"unknown scene 'moon'; known: .*demo"), ({"speed": 0.0}, r"speed must be above 0")],
)
def test_wrong_arguments_are_refused(arguments: dict[str, object], complaint: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=complaint):
        EmulatedRig(1, directory=tmp_path, **arguments)


@pytest.mark.parametrize("way", ["SIGTERM", "quit"])
def test_the_command_ends_in_good_order(tmp_path: Path, way: str) -> None:
    path = tmp_path / "rig.toml"
    command = [sys.executable, "-m", "echolume", "emulate", "--out", str(tmp_path), "--speed", "50"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        ready = process.stdout.readline()
        assert ready.startswith("emulated rig emulated-1 is ready: ")
        assert str(path) in ready
        if way == "quit":
            with Control.beside(path) as control:
                control.quit()
        else:
            os.kill(process.pid, getattr(signal, way))
        _, errors = process.communicate(timeout=20)
        assert (process.returncode, errors) == (0, "")
    assert list(tmp_path.iterdir()) == []


def test_without_a_running_rig_the_control_says_so(tmp_path: Path) -> None:
    with pytest.raises(NoReplyError, match=r"is .* of a running emulated rig"):
        Control.beside(tmp_path / "rig.toml")
    with socket.create_server(("127.0.0.1", 0)) as probe:
        port = probe.getsockname()[1]
    begin_s = time.monotonic()
    with pytest.raises(NoReplyError, match=r"no control at"):
        Control(f"127.0.0.1:{port}")
    assert time.monotonic() - begin_s < 5
