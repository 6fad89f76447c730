"""The optical subscriber over a real router: pairs in, points out, calibration from the scan's start."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stripe_image import render_stripe
from echolume_messages import topics
from echolume_messages.bus import Bus, Message
from echolume_messages.calibration import ArrayCalibration, Calibration
from echolume_messages.errors import CalibrationMissingError
from echolume_messages.header import Header, Source
from echolume_messages.rig import Rig
from echolume_processing.optical.pipeline import OpticalPipeline
from echolume_processing.subscribers import optical
from echolume_processing.subscribers.scans import read_start
from loopback import lab_rig, running_subscriber
from processing.test_optical_pipeline import camera_of, laser_of

TRUTH = optical_truth(1)
DEADLINE_S = 20.0
PLAN = {"name": "p", "pass": [{"name": "light", "kind": "optical"}, {"name": "sound", "kind": "ultrasonic"}]}


def calibration(rig: str) -> Calibration:
    array = ArrayCalibration(
        emitter_mm=(0, 0, 0), receivers_mm=[], radius_mm=6, low_hz=3e4, high_hz=6e4, delays_s=[], gains=[],
        templates=[], template_origin=0, sample_rate_hz=25e4, reference_mm=150, speed_of_sound_mps=344,
        temperature_c=22, flange_from_array=np.eye(4).tolist(), rig_from_robot=np.eye(4).tolist(), path_rms_mm=0,
    )  # fmt: skip
    made = Calibration(
        rig=rig,
        left=camera_of(TRUTH.left),
        right=camera_of(TRUTH.right),
        stereo_rms_px=0,
        laser=laser_of(),
        array=array,
    )
    return msgspec.json.decode(msgspec.json.encode(made), type=Calibration)


@pytest.fixture(scope="module")
def rig() -> Rig:
    return lab_rig()


@pytest.fixture(scope="module")
def stage(rig: Rig) -> Iterator[Bus]:
    """A router, the subscriber running on it, and the bus of the rig's side."""
    with running_subscriber("optical", rig, lambda stop: optical.main(rig=rig, stop=stop)) as bus:
        yield bus


def pair(x_mm: float) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(round(x_mm + 200))
    return (
        render_stripe(plate(), TRUTH, "left", x_mm, rng, 4e-3, True),
        render_stripe(plate(), TRUTH, "right", x_mm, rng, 4e-3, True),
    )


def start_scan(bus: Bus, scan: str, found: Calibration | None) -> None:
    bus.publisher(topics.SCAN_START).put_json(
        {"scan": scan, "plan": PLAN, "calibration": msgspec.to_builtins(found), "rig": "test", "array": {}}, scan=scan
    )


def put_pair(bus: Bus, scan: str, trigger: int, x_mm: float | None, pass_name: str = "light") -> None:
    for topic, frame in zip((topics.CAMERA_LEFT, topics.CAMERA_RIGHT), pair(x_mm or 0.0), strict=True):
        bus.publisher(topic).put(
            frame,
            scan=scan, pass_name=pass_name, trigger=trigger, source=Source(x_mm=x_mm, laser_on=True, frame_id=trigger),
        )  # fmt: skip


def collect(bus: Bus, scan: str, act: Callable[[], None], count: int) -> dict[int, Message]:
    """Points by trigger, of `count` stripes of a scan, published after `act()`."""
    found: dict[int, Message] = {}
    with bus.subscribe([topics.OPTICAL_POINTS]) as points:
        act()
        deadline_s = time.monotonic() + DEADLINE_S
        while len(found) < count:
            assert time.monotonic() < deadline_s, f"{len(found)} of {count} stripes"
            message = points.get(0.5)
            if message is not None and message.header.scan == scan:
                found[message.header.trigger] = message
    return found


def test_points_of_each_pair_carry_the_raw_header_and_the_digest(stage: Bus) -> None:
    def act() -> None:
        start_scan(stage, "one", calibration("test"))
        for trigger, x_mm in enumerate((-30.0, 0.0, 30.0)):
            put_pair(stage, "one", trigger, x_mm)

    found = collect(stage, "one", act, 3)
    assert sorted(found) == [0, 1, 2]
    for trigger, x_mm in enumerate((-30.0, 0.0, 30.0)):
        header, points = found[trigger].header, found[trigger].payload
        assert (header.scan, header.source.x_mm, header.source.frame_id) == ("one", x_mm, trigger)
        assert header.calibration == calibration("test").digest
        expected = OpticalPipeline(calibration("test")).process(*pair(x_mm), x_mm)
        assert points.tobytes() == expected.tobytes()


def test_frames_that_come_before_the_scans_start_are_processed_once_it_is_known(stage: Bus) -> None:
    def act() -> None:
        put_pair(stage, "late", 7, 10.0)
        start_scan(stage, "late", calibration("test"))

    assert list(collect(stage, "late", act, 1)) == [7]


def test_only_optical_passes_of_calibrated_scans_with_a_guide_position_are_processed(stage: Bus) -> None:
    def act() -> None:
        start_scan(stage, "raw", None)
        put_pair(stage, "raw", 20, 0.0)
        start_scan(stage, "good", calibration("test"))
        put_pair(stage, "good", 21, 0.0, pass_name="board-00")
        put_pair(stage, "good", 22, None)
        put_pair(stage, "good", 23, 0.0)

    assert list(collect(stage, "good", act, 1)) == [23]


def test_a_pair_of_another_size_than_calibrated_is_skipped(stage: Bus) -> None:
    def act() -> None:
        start_scan(stage, "sizes", calibration("test"))
        for topic in (topics.CAMERA_LEFT, topics.CAMERA_RIGHT):
            source = Source(x_mm=0.0, laser_on=True, frame_id=31)
            stage.publisher(topic).put(
                np.zeros((8, 8), dtype=np.uint8), scan="sizes", pass_name="light", trigger=31, source=source
            )
        put_pair(stage, "sizes", 32, 0.0)

    assert list(collect(stage, "sizes", act, 1)) == [32]


def start_message(text: bytes) -> Message:
    header = Header(stream="conductor/start", seq=3, t_ns=0, t_wall_ns=0, boot="b")
    return Message(header, topics.SCAN_START, np.frombuffer(text, dtype=np.uint8))


def test_a_calibration_of_another_rig_is_refused() -> None:
    body = {"scan": "s", "plan": PLAN, "calibration": msgspec.to_builtins(calibration("other"))}
    with pytest.raises(CalibrationMissingError, match="of rig 'other', this is 'test'"):
        read_start(start_message(msgspec.json.encode(body)), "test", OpticalPipeline)


def test_a_start_that_cannot_be_read_is_named() -> None:
    with pytest.raises(CalibrationMissingError, match="conductor/start seq 3"):
        read_start(start_message(b'{"scan": 5}'), "test", OpticalPipeline)


def test_health_tells_the_cameras_agreement_the_labels_and_the_alarm_of_a_plane_that_is_off(stage: Bus) -> None:
    off_mm = 0.05

    def act() -> None:
        start_scan(stage, "off", calibration("test"))
        for trigger, x_mm in enumerate((-40.0, -20.0, 0.0, 20.0)):
            for topic, frame in zip((topics.CAMERA_LEFT, topics.CAMERA_RIGHT), pair(x_mm), strict=True):
                source = Source(x_mm=x_mm + off_mm, laser_on=True, frame_id=trigger)
                stage.publisher(topic).put(frame, scan="off", pass_name="light", trigger=trigger, source=source)

    with stage.subscribe([topics.health("optical")]) as reports:
        collect(stage, "off", act, 4)
        deadline_s = time.monotonic() + DEADLINE_S
        report: dict[str, object] = {}
        while report.get("scan") != "off" or report.get("stripes") != 4:
            assert time.monotonic() < deadline_s, report
            message = reports.get(0.5)
            if message is not None:
                whole = message.json()
                report = whole["agreement"]
    assert report["alarm"] is True
    assert report["plane_mm"] == pytest.approx(off_mm, abs=0.01)
    assert report["median_mm"] > 2 * report["noise_mm"]
    assert whole["candidates"]["both"] > 3000
    assert {"left", "right", "outside", "secondary", "contradicted", "odd", "weak", "short"} < set(whole["candidates"])
