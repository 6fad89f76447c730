"""The ultrasonic subscriber over a real router: echoes in, contact points out, calibration from the scan's start."""

from __future__ import annotations

import time
from collections.abc import Iterator
from pathlib import Path

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.scene import plate
from echolume_messages import archive, topics
from echolume_messages.bus import Bus, Message
from echolume_messages.calibration import ArrayCalibration, Calibration, CameraCalibration, LaserCalibration
from echolume_messages.errors import CalibrationMissingError, CalibrationRejectedError
from echolume_messages.header import Header, Source
from echolume_messages.rig import ArraySettings, Rig
from echolume_processing.ping import Ping, ping_from_record
from echolume_processing.subscribers import ultrasonic
from echolume_processing.subscribers.scans import read_start
from echolume_processing.ultrasonic import from_archive
from echolume_processing.ultrasonic.calibrate import calibrate_plate
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline
from echolume_processing.ultrasonic.poses import plate_poses
from loopback import lab_rig, running_subscriber

DEADLINE_S = 20.0
SETTINGS = ArraySettings(port="none")
TRUTH = array_truth(3, SETTINGS)


def echoes_at(pose: np.ndarray, seed: int) -> np.ndarray:
    return simulate_ping(plate(), TRUTH.rig_from_array(pose), SETTINGS, TRUTH, 22.0, np.random.default_rng(seed))


@pytest.fixture(scope="module")
def array() -> ArrayCalibration:
    pings = []
    for k, listed in enumerate(plate_poses()):
        pose = np.array([*listed[:3], *np.radians(listed[3:])])
        pings.append(Ping(k, echoes_at(pose, k), pose, 250e3, 0.0, 22.0))
    return calibrate_plate(pings, SETTINGS).calibration


def calibration(rig: str, array: ArrayCalibration) -> Calibration:
    camera = CameraCalibration(
        width_px=8, height_px=8, camera_matrix=np.eye(3).tolist(), distortion=[0.0] * 5,
        camera_from_rig=np.eye(4).tolist(), rms_px=0.0,
    )  # fmt: skip
    laser = LaserCalibration(normal=(1.0, 0.0, 0.0), offset_mm=0.0, guide_direction=(1.0, 0.0, 0.0), rms_mm=0.0)
    made = Calibration(rig=rig, left=camera, right=camera, stereo_rms_px=0.0, laser=laser, array=array)
    return msgspec.json.decode(msgspec.json.encode(made), type=Calibration)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return lab_rig()


@pytest.fixture(scope="module")
def stage(rig: Rig) -> Iterator[Bus]:
    """A router, the subscriber running on it, and the bus of the rig's side."""
    with running_subscriber("ultrasonic", rig, lambda stop: ultrasonic.main(rig=rig, stop=stop)) as bus:
        yield bus


def start_scan(bus: Bus, scan: str, found: Calibration | None) -> None:
    bus.publisher(topics.SCAN_START).put_json({"scan": scan, "calibration": msgspec.to_builtins(found)}, scan=scan)


def put_ping(bus: Bus, scan: str, trigger: int, echoes: np.ndarray, **changed: object) -> Source:
    source = Source(
        robot_pose=(0.0, 10.0 * trigger, 150.0, 0.0, 0.0, 0.0),
        sample_rate_hz=250e3,
        start_s=0.0,
        air_temperature_c=22.0,
    )
    source = msgspec.structs.replace(source, **changed)
    bus.publisher(topics.ECHOES).put(echoes, scan=scan, pass_name="sound", trigger=trigger, source=source)
    return source


def receive(points: object, scan: str, count: int) -> dict[int, Message]:
    found: dict[int, Message] = {}
    deadline_s = time.monotonic() + DEADLINE_S
    while len(found) < count:
        assert time.monotonic() < deadline_s, f"{len(found)} of {count} pings"
        message = points.get(0.5)
        if message is not None and message.header.scan == scan:
            found[message.header.trigger] = message
    return found


@pytest.mark.parametrize("late_start", [False, True])
def test_points_carry_the_raw_header_and_equal_the_pipeline(
    stage: Bus, rig: Rig, array: ArrayCalibration, late_start: bool
):
    scan, made = f"late-{late_start}", calibration(rig.name, array)
    poses = [np.array([0.0, 10.0 * k, 150.0, 0.0, 0.0, 0.0]) for k in range(3)]
    echoes = [echoes_at(pose, k) for k, pose in enumerate(poses)]
    with stage.subscribe([topics.ULTRASONIC_POINTS]) as points:
        if not late_start:
            start_scan(stage, scan, made)
        sources = [put_ping(stage, scan, k, block) for k, block in enumerate(echoes)]
        if late_start:
            start_scan(stage, scan, made)
        found = receive(points, scan, 3)
    for k, block in enumerate(echoes):
        message = found[k]
        assert (message.header.pass_name, message.header.calibration) == ("sound", made.digest)
        assert message.header.source == sources[k]
        alone = UltrasonicPipeline(made).process(Ping(k, block, poses[k], 250e3, 0.0, 22.0))
        assert message.payload.tobytes() == alone.tobytes()
        assert np.abs(message.payload["z_mm"]).max() < 0.5


def test_a_scan_without_calibration_and_a_ping_without_pose_are_skipped(stage: Bus, rig: Rig, array: ArrayCalibration):
    block = echoes_at(np.array([0.0, 0.0, 150.0, 0.0, 0.0, 0.0]), 1)
    with stage.subscribe([topics.ULTRASONIC_POINTS]) as points:
        start_scan(stage, "bare", None)
        put_ping(stage, "bare", 0, block)
        start_scan(stage, "good", calibration(rig.name, array))
        put_ping(stage, "good", 0, block, robot_pose=None)
        put_ping(stage, "good", 1, block)
        found = receive(points, "good", 1)
    assert list(found) == [1]


def record(content: object) -> Message:
    payload = np.frombuffer(msgspec.json.encode(content), dtype=np.uint8)
    return Message(Header("conductor/start", 0, 0, 0, "b"), topics.SCAN_START, payload)


def test_a_calibration_of_another_rig_or_without_templates_is_refused(array: ArrayCalibration):
    content = {"scan": "s", "calibration": msgspec.to_builtins(calibration("other", array))}
    with pytest.raises(CalibrationMissingError, match="of rig 'other'"):
        read_start(record(content), "test", UltrasonicPipeline)
    empty = msgspec.structs.replace(array, templates=[])
    content = {"scan": "s", "calibration": msgspec.to_builtins(calibration("test", empty))}
    with pytest.raises(CalibrationMissingError, match="unusable"):
        read_start(record(content), "test", UltrasonicPipeline)


def test_a_record_without_a_pose_names_its_trigger():
    header = Header("array/echoes", 1, 0, 0, "b", trigger=17)
    with pytest.raises(ValueError, match="trigger 17"):
        ping_from_record(header, np.zeros((8, 16), dtype=np.int16))


def test_the_last_attempt_of_each_ping_of_a_pass_is_read_from_an_archive(monkeypatch: pytest.MonkeyPatch):
    source = Source(robot_pose=(0.0,) * 6, sample_rate_hz=250e3, start_s=0.0, air_temperature_c=22.0)

    def message(pass_name: str, trigger: int, attempt: int) -> Message:
        header = Header("array/echoes", 0, 0, 0, "b", pass_name=pass_name, trigger=trigger, attempt=attempt)
        block = np.full((8, 4), 10 * trigger + attempt, dtype=np.int16)
        return Message(msgspec.structs.replace(header, source=source), topics.ECHOES, block)

    records = [message("plate", 4, 1), message("plate", 4, 0), message("plate", 2, 0), message("block-sound", 9, 0)]
    monkeypatch.setattr(archive, "read", lambda path, names: iter(records))
    pings = from_archive.read_pings(Path("scan.mcap"), "plate")
    assert [(p.trigger, int(p.echoes[0, 0])) for p in pings] == [(2, 20), (4, 41)]
    with pytest.raises(CalibrationRejectedError, match=r"scan\.mcap: no pings of a pass 'none'"):
        from_archive.read_pings(Path("scan.mcap"), "none")
