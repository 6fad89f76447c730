"""What every camera driver does, whatever is behind it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from echolume_drivers.cameras import Camera, make_camera, open_camera
from echolume_drivers.emulated.camera_peer import CameraPeer
from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stage import Stage
from echolume_messages.errors import ConfigError, DeviceAbsentError, DeviceError, DeviceFaultError, DeviceSilentError
from echolume_messages.rig import CameraSettings

IMAGES = 5


@dataclass
class Bench:
    """A camera's settings, and what stands for pulses on its trigger line."""

    settings: CameraSettings
    trigger: Callable[[Camera], None]


def emulated(folder: Path) -> Iterator[Bench]:
    peer = CameraPeer(Stage(1, plate(), laser_on=True), "left", optical_truth(1))
    peer.start()
    yield Bench(CameraSettings(address=peer.address), lambda camera: peer.fire(4e-3))
    peer.close()


def files(folder: Path) -> Iterator[Bench]:
    for k in range(IMAGES):
        cv2.imwrite(str(folder / f"image-{k}.png"), np.full((1024, 1280), 10 * k + 5, dtype=np.uint8))
    (folder / "notes.txt").write_text("no image")

    yield Bench(CameraSettings(driver="files", address=str(folder)), lambda camera: camera.trigger())


@pytest.fixture(params=[emulated, files], ids=["emulated", "files"])
def bench(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Bench]:
    yield from request.param(tmp_path)


@pytest.fixture
def camera(bench: Bench) -> Iterator[Camera]:
    found = open_camera(bench.settings, "left")
    yield found
    found.close()


def test_each_trigger_gives_one_frame_with_the_next_id(bench: Bench, camera: Camera) -> None:
    camera.start()
    times_ns = []
    for k in range(3):
        bench.trigger(camera)
        frame = camera.read(5.0)
        assert frame.frame_id == k + 1
        assert frame.pixels.shape == (1024, 1280)
        assert frame.pixels.dtype == np.uint8
        assert frame.pixels.max() > 0 or k == 0
        times_ns.append(frame.device_t_ns)
    assert times_ns == sorted(set(times_ns))


def test_a_frame_knows_its_exposure_or_says_that_it_does_not(bench: Bench, camera: Camera) -> None:
    camera.start()
    bench.trigger(camera)
    assert camera.read(5.0).exposure_s in (4e-3, None)


def test_without_a_trigger_the_camera_is_silent_and_says_so_in_time(bench: Bench, camera: Camera) -> None:
    camera.start()
    begin_s = time.monotonic()
    with pytest.raises(DeviceSilentError, match=r"camera left"):
        camera.read(0.1)
    assert time.monotonic() - begin_s < 0.5


def test_after_stop_and_start_the_ids_begin_anew(bench: Bench, camera: Camera) -> None:
    camera.start()
    for _ in range(2):
        bench.trigger(camera)
        camera.read(5.0)
    camera.stop()
    camera.start()
    bench.trigger(camera)
    assert camera.read(5.0).frame_id == 1


def test_frames_not_read_before_stop_are_forgotten(bench: Bench, camera: Camera) -> None:
    camera.start()
    bench.trigger(camera)
    bench.trigger(camera)
    camera.stop()
    camera.start()
    bench.trigger(camera)
    assert camera.read(5.0).frame_id == 1


def test_a_camera_without_a_wire_says_so(bench: Bench, camera: Camera) -> None:
    assert camera.software_trigger == (bench.settings.driver == "files")


def test_calls_out_of_order_are_refused(bench: Bench) -> None:
    camera = make_camera(bench.settings, "left")
    with pytest.raises(DeviceFaultError, match=r"start.. before open"):
        camera.start()
    camera.open()
    with pytest.raises(DeviceFaultError, match=r"read.. before start"):
        camera.read(0.1)
    with pytest.raises(DeviceFaultError, match=r"trigger.. before start"):
        camera.trigger()
    camera.close()
    with pytest.raises(DeviceFaultError, match=r"read.. before start"):
        camera.read(0.1)


def test_opening_twice_and_closing_twice_change_nothing(bench: Bench) -> None:
    camera = open_camera(bench.settings, "left")
    camera.open()
    camera.start()
    bench.trigger(camera)
    assert camera.read(5.0).frame_id == 1
    camera.close()
    camera.close()


def test_a_closed_camera_can_be_opened_again(bench: Bench, camera: Camera) -> None:
    camera.start()
    camera.close()
    camera.open()
    camera.start()
    bench.trigger(camera)
    assert camera.read(5.0).frame_id == 1


def test_an_absent_camera_is_named_with_its_address(bench: Bench, tmp_path: Path) -> None:
    address = "127.0.0.1:9" if bench.settings.driver == "emulated" else str(tmp_path / "nowhere")
    with pytest.raises(DeviceAbsentError, match=f"camera right .*{address}"):
        open_camera(msgspec.structs.replace(bench.settings, address=address), "right")


def test_frames_of_another_size_than_the_rig_file_says_are_refused(bench: Bench) -> None:
    camera = make_camera(msgspec.structs.replace(bench.settings, width_px=640), "left")
    with pytest.raises(DeviceError, match=r"640[\s\S]*rig file|rig file[\s\S]*640|640.*width_px"):
        camera.open()
        camera.start()
        bench.trigger(camera)
        camera.read(1.0)
    camera.close()


def test_an_unknown_driver_is_a_mistake_in_the_rig_file() -> None:
    with pytest.raises(ConfigError, match=r"\$\.cameras\.left\.driver: 'pinhole' is not installed"):
        open_camera(CameraSettings(driver="pinhole", address=""), "left")


def test_files_come_in_the_order_of_their_names_and_in_grey(tmp_path: Path) -> None:
    for name, level in (("b.png", 20), ("a.png", 10), ("c.jpg", 30)):
        cv2.imwrite(str(tmp_path / name), np.full((8, 8, 3), level, dtype=np.uint8))
    camera = open_camera(CameraSettings(driver="files", address=str(tmp_path), width_px=8, height_px=8), "left")
    camera.start()
    for level in (10, 20, 30):
        camera.trigger()
        assert camera.read(1.0).pixels[0, 0] == level
    camera.trigger()
    with pytest.raises(DeviceSilentError, match=r"no frame 4: only 3 images"):
        camera.read(1.0)
    camera.close()


def test_a_file_that_is_no_image_is_named(tmp_path: Path) -> None:
    (tmp_path / "broken.png").write_bytes(b"\x89PNG of nothing")
    camera = open_camera(CameraSettings(driver="files", address=str(tmp_path)), "left")
    camera.start()
    camera.trigger()
    with pytest.raises(DeviceError, match=r"broken.png"):
        camera.read(1.0)
    camera.close()


def test_an_empty_folder_is_an_absent_camera(tmp_path: Path) -> None:
    with pytest.raises(DeviceAbsentError, match=r"no images"):
        open_camera(CameraSettings(driver="files", address=str(tmp_path)), "left")
