"""The emulated rig's control does what hands would do, and refuses nonsense with a reason."""

from __future__ import annotations

import json
import socket
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from echolume_drivers.cameras import open_camera
from echolume_drivers.emulated.board_image import board_poses
from echolume_drivers.emulated.control import Control, ControlServer
from echolume_drivers.emulated.rig import EmulatedRig
from echolume_drivers.emulated.scene import SCENES, Expectation, Material
from echolume_messages.errors import CommandRefusedError, DeviceSilentError, NoReplyError


@pytest.fixture(scope="module")
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[EmulatedRig]:
    with EmulatedRig(2, "demo", 100.0, "wideband", tmp_path_factory.mktemp("rig")) as found:
        yield found


@pytest.fixture
def control(rig: EmulatedRig) -> Iterator[Control]:
    with Control.beside(rig.rig_file) as found:
        yield found


def test_status_tells_what_the_rig_is_doing(control: Control) -> None:
    status = control.status()
    assert status["laser_on"] is False
    assert status["seed"] == 2
    assert len(status["robot_pose"]) == 6
    assert isinstance(status["guide_x_mm"], float)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_every_scene_can_be_placed_and_its_truth_written(control: Control, name: str, tmp_path: Path) -> None:
    control.place_scene(name)
    path = tmp_path / "truth.npz"
    assert control.truth(path) == {"path": str(path), "scene": name}
    expected = SCENES[name]()
    with np.load(path) as truth:
        assert np.array_equal(truth["front_mm"], expected.front_mm)
        assert np.array_equal(truth["optical_mm"], expected.optical_mm)
        assert np.array_equal(truth["material"], expected.material)
        assert (truth["x0_mm"], truth["y0_mm"], truth["cell_mm"]) == (-120.0, -120.0, 1.0)
        assert np.array_equal(truth["region"], expected.region_image)
        assert tuple(truth["regions"]) == expected.regions
        said = msgspec.json.decode(str(truth["expect"]), type=list[Expectation])
        assert tuple(said) == expected.expect


def test_a_scene_file_is_placed_and_a_wrong_one_refused(
    control: Control, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    text = 'name = "mine"\n[[piece]]\nkind = "box"\nx_mm = [0.0, 9.0]\ny_mm = [0.0, 9.0]\nz_mm = 7.0\n'
    Path("mine.toml").write_text(text)
    control.place_scene("mine.toml")
    assert control.status()["scene"] == "mine"
    Path("wrong.toml").write_text(text.replace("7.0", '"seven"'))
    with pytest.raises(CommandRefusedError, match=r"wrong\.toml: Expected `float`.*\$\.piece\[0\]\.z_mm"):
        control.place_scene("wrong.toml")
    assert control.status()["scene"] == "mine"


def test_the_demos_truth_has_glass_whose_top_light_does_not_see(control: Control, tmp_path: Path) -> None:
    control.place_scene("demo")
    control.truth(tmp_path / "truth.npz")
    with np.load(tmp_path / "truth.npz") as truth:
        glass = truth["material"] == Material.GLASS
        assert set(truth["front_mm"][glass]) == {30.0}
        assert set(truth["optical_mm"][glass]) == {0.0}


def test_the_board_takes_one_of_its_poses_or_any_and_goes_when_a_scene_comes(control: Control) -> None:
    control.place_board(3)
    assert np.allclose(control.status()["board"], board_poses(2)[3])
    pose = np.eye(4)
    pose[2, 3] = 12.0
    control.place_board(pose)
    assert control.status()["board"] == pose.tolist()
    control.place_scene("plate")
    assert control.status()["board"] is None


def test_a_camera_sees_what_was_placed(rig: EmulatedRig, control: Control) -> None:
    camera = open_camera(rig.rig.cameras.left, "left")
    camera.start()
    try:
        contrast = []
        for place in (lambda: control.place_scene("plate"), lambda: control.place_board(0)):
            place()
            rig.cameras["left"].fire(8e-3)
            contrast.append(camera.read(20.0).pixels.std())
        assert contrast[0] < 5
        assert contrast[1] > 30
    finally:
        camera.close()


def test_a_fault_reaches_its_device(rig: EmulatedRig, control: Control) -> None:
    camera = open_camera(rig.rig.cameras.right, "right")
    camera.start()
    try:
        control.fault("camera-right", "drop", count=1)
        for _ in range(2):
            rig.cameras["right"].fire(1e-3)
        assert camera.read(5.0).frame_id == 2
        with pytest.raises(DeviceSilentError):
            camera.read(0.05)
    finally:
        camera.close()


@pytest.mark.parametrize(
    ("op", "arguments", "complaint"),
    [
        ("dance", {}, r"unknown op 'dance'; known: place, truth, fault, status, quit"),
        ("place", {}, r"give scene"),
        ("place", {"scene": "moon"}, r"unknown scene 'moon'"),
        ("place", {"board": 12}, r"board pose 12 is not among 0..11"),
        ("place", {"board": True}, r"give scene"),
        ("place", {"board": [[1, 2], [3, 4]]}, r"no rigid 4x4 matrix"),
        ("place", {"board": [[2, 0, 0, 0], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]]}, r"no rigid 4x4 matrix"),
        ("truth", {}, r"path"),
        ("truth", {"path": "/nowhere/truth.npz"}, r"No such file"),
        ("fault", {"device": "coffee"}, r"unknown device 'coffee'; known: guide, robot"),
        ("fault", {"device": "guide", "fault": "explode"}, r"unknown fault 'explode'"),
        ("fault", {"device": "camera-left", "fault": "drop", "cups": 2}, r"cups"),
    ],
)
def test_nonsense_is_refused_with_a_reason(control: Control, op: str, arguments: dict, complaint: str) -> None:
    with pytest.raises(CommandRefusedError, match=complaint):
        control.request(op, **arguments)
    assert control.status()["seed"] == 2


@pytest.mark.parametrize("line", [b"{", b"[1, 2]", b"\xff\xfe", b"null", b'{"op": ["place"]}'])
def test_lines_that_are_no_request_are_answered_and_the_line_stays_open(rig: EmulatedRig, line: bytes) -> None:
    host, _, port = rig.control_address.rpartition(":")
    with socket.create_connection((host, int(port)), timeout=5) as raw, raw.makefile("rb") as answers:
        raw.sendall(line + b"\n")
        assert json.loads(answers.readline())["ok"] is False
        raw.sendall(b'{"op": "status"}\n')
        assert json.loads(answers.readline())["ok"] is True


def test_a_control_that_ended_is_no_reply() -> None:
    server = ControlServer({"status": lambda _: {}})
    server.start()
    with Control(server.address) as control:
        assert control.status() == {}
        server.close()
        with pytest.raises(NoReplyError, match=r"status"):
            control.status()
