"""Guided calibration: what it tells the operator, when it ends, and the same over a bus."""

from __future__ import annotations

import argparse
import json
import threading
import time
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest

from echolume_drivers.emulated.optics import optical_truth
from echolume_messages import calibration as calibration_file
from echolume_messages import geometry, topics
from echolume_messages.bus import Message, connect
from echolume_messages.bus.router import open_router
from echolume_messages.calibration import ArrayCalibration, Calibration, CameraCalibration, LaserCalibration
from echolume_messages.errors import CalibrationMissingError, CalibrationRejectedError
from echolume_messages.header import Header, Source
from echolume_messages.rig_option import load_rig
from echolume_processing.calibrate_live import IDLE_TURNS, LedgerEnd, gather_optics, gather_views, watch_alignment
from echolume_processing.commands import calibrate
from echolume_processing.commands.image_pairs import read_pairs, write_pair
from echolume_processing.optical.board import Pattern
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.coverage import Coverage
from echolume_processing.optical.pair_solver import BoardView
from loopback import free_endpoint
from processing import board_render as render
from processing.calibration_scan import calibration_records

BOARD = Pattern(9, 6, 20.0)
PRINT = render.chess_print()
MIDDLE = np.array([80.0, 50.0, 0.0])


class Given:
    """Pairs that are there already; then the session is stopped."""

    def __init__(self, pairs: Iterable[tuple[Message, Message] | None], stop: threading.Event | None = None) -> None:
        self._pairs = iter(pairs)
        self._stop = stop

    def get(self, timeout_s: float) -> tuple[Message, Message] | None:
        try:
            return next(self._pairs)
        except StopIteration:
            if self._stop is not None:
                self._stop.set()
            return None


def message(topic: topics.Topic, frame: np.ndarray, trigger: int, pass_name: str = "board-00", **source) -> Message:
    header = Header(
        stream=topic.name, seq=trigger, t_ns=0, t_wall_ns=0, boot="test", scan="s", pass_name=pass_name,
        trigger=trigger, source=Source(**source),
    )  # fmt: skip
    return Message(header, topic, frame)


def frames(left: np.ndarray, right: np.ndarray, trigger: int, **source) -> tuple[Message, Message]:
    return message(topics.CAMERA_LEFT, left, trigger, **source), message(topics.CAMERA_RIGHT, right, trigger, **source)


def view(rx_deg: float, ry_deg: float, centre=(30.0, 0.0, 420.0)) -> BoardView:
    """Corners of a board in both drawn cameras: positive rx tips its top away, positive ry its left side towards us."""
    rotation = geometry.rotation_from_euler(*np.radians([rx_deg, ry_deg, 0.0])) @ np.diag([1.0, -1.0, -1.0])
    pose = geometry.transform(rotation, np.array(centre) - rotation @ MIDDLE)
    points = geometry.apply(pose, BOARD.corners_mm)
    return BoardView("v", render.LEFT.project(points), render.RIGHT.project(points))


@pytest.mark.parametrize(
    ("rx_deg", "ry_deg", "goes_away"),
    [(20, 0, "bottom"), (-20, 0, "top"), (0, 20, "left side"), (0, -20, "right side")],
)
def test_a_tilt_is_recognised_by_what_goes_away(rx_deg: float, ry_deg: float, goes_away: str) -> None:
    coverage = Coverage(BOARD, render.SIZE_PX)
    coverage.add(view(rx_deg, ry_deg))
    rotation = geometry.rotation_from_euler(*np.radians([rx_deg, ry_deg, 0.0])) @ np.diag([1.0, -1.0, -1.0])
    ends = {"left side": [0, 50, 0], "right side": [160, 50, 0], "top": [80, 100, 0], "bottom": [80, 0, 0]}
    depth = {name: (rotation @ (np.array(end) - MIDDLE))[2] for name, end in ends.items()}
    assert max(depth, key=depth.__getitem__) == goes_away
    assert f"board tilted so that its {goes_away} goes away" not in coverage.missing
    assert sum("goes away" in line for line in coverage.missing) == 3


def test_an_empty_session_lacks_everything_and_a_board_in_the_middle_its_rim() -> None:
    coverage = Coverage(BOARD, render.SIZE_PX)
    assert len(coverage.missing) == 7
    coverage.add(view(0, 0, (0, 0, 900)))
    assert coverage.missing[0].startswith("left image: board at top left")
    assert "middle centre" not in coverage.missing[0]
    assert coverage.missing[-1] == "9 more views"


def test_a_board_that_has_not_moved_is_no_new_view() -> None:
    coverage = Coverage(BOARD, render.SIZE_PX)
    assert coverage.add(view(10, 0))
    assert not coverage.add(view(10.1, 0))
    assert coverage.add(view(-10, 0))


def test_views_are_taken_until_stopped_and_each_is_answered(tmp_path: Path) -> None:
    left, right = render.pairs(PRINT, render.poses(3, PRINT))
    blank = np.full_like(left[0], 90)
    lit = frames(left[2], right[2], 4, laser_on=True)
    given = [frames(left[0], right[0], 0), frames(blank, right[1], 1), frames(left[0], right[0], 2),
             frames(left[1], right[1], 3), lit]  # fmt: skip
    said: list[str] = []
    kept: list[int] = []
    stop = threading.Event()
    coverage = gather_views(Given(given, stop), BOARD, said.append, stop, lambda number, *_: kept.append(number))
    assert coverage is not None
    assert [v.name for v in coverage.views] == ["01", "02"]
    assert kept == [1, 2]
    assert said[0].startswith("view 1 taken; missing: left image: board at")
    assert said[1] == "not taken: no 9x6 corners in the left image"
    assert "has not moved" in said[2]
    assert len(said) == 4


def test_the_session_ends_by_itself_when_all_is_covered(monkeypatch: pytest.MonkeyPatch) -> None:
    left, right = render.pairs(PRINT, render.poses(2, PRINT))
    monkeypatch.setattr(Coverage, "missing", property(lambda self: [] if len(self.views) == 2 else ["one"]))
    said: list[str] = []
    found = gather_views(Given([frames(left[k], right[k], k) for k in (0, 1)]), BOARD, said.append, threading.Event())
    assert found is not None
    assert said[-1] == "view 2 taken; all is covered"


def scan_pairs() -> list[tuple[Message, Message]]:
    records = calibration_records(1)
    return [(records[k], records[k + 1]) for k in range(0, len(records), 2)]


def test_the_laser_is_calibrated_while_the_scan_runs() -> None:
    said: list[str] = []
    found = gather_optics(
        Given(scan_pairs()[:15]), BOARD, said.append, threading.Event(), ended=lambda scan: scan == "calibration"
    )
    assert len(found.report.views) == 5
    assert said == ["scan calibration", *(f"board-0{k}: taken" for k in range(5))]
    assert found.report.parallel_deg < 1.0


def test_in_a_pause_the_operator_is_told_what_a_calibration_would_lack() -> None:
    pause = [None] * IDLE_TURNS
    given = Given([*scan_pairs()[:3], *pause, *pause, *scan_pairs()[3:12], *pause])
    said: list[str] = []
    stop = threading.Event()
    gather_optics(given, BOARD, said.append, stop, ended=lambda _: said[-1].startswith("board-03: would do"))
    assert said[:3] == ["scan calibration", "board-00: taken", "board-00: taken; 3 more boards for a first trial"]
    assert said[3:6] == [f"board-0{k}: taken" for k in (1, 2, 3)]
    assert said[6].startswith("board-03: would do: stereo 0.0")


def test_a_session_stopped_too_early_says_what_it_lacks() -> None:
    stop = threading.Event()
    with pytest.raises(CalibrationRejectedError, match="3 usable views of the board, needs 4"):
        gather_optics(Given(scan_pairs()[:9], stop), BOARD, lambda _: None, stop)


def rig_file(folder: Path) -> Path:
    """A rig without devices whose bus is on a free port."""
    path = folder / "rig.toml"
    path.write_text(
        f"""
        name = "test"
        bus.endpoint = "{free_endpoint()}"
        guide.port = "none"
        trigger.port = "none"
        cameras.left.address = "none"
        cameras.right.address = "none"
        array.port = "none"
        recorder.directory = "/none"
        [robot]
        """
    )
    return path


def calibration_of(rig_name: str) -> Calibration:
    """The emulated rig's cameras; of laser and array only what a file must hold."""
    truth = optical_truth(1)
    array = ArrayCalibration(
        emitter_mm=(0, 0, 0), receivers_mm=[(15, 0, 0)] * 8, radius_mm=6.2, low_hz=3e4, high_hz=6e4,
        delays_s=[0] * 8, gains=[1] * 8, templates=[[1.0]] * 8, template_origin=0, sample_rate_hz=2.5e5,
        reference_mm=150, speed_of_sound_mps=343, temperature_c=20, flange_from_array=np.eye(4).tolist(),
        rig_from_robot=np.eye(4).tolist(), path_rms_mm=0.1,
    )  # fmt: skip
    laser = LaserCalibration(normal=(1, 0, 0), offset_mm=0, guide_direction=(1, 0, 0), rms_mm=0)
    sides = camera_of(truth.left), camera_of(truth.right)
    return Calibration(rig=rig_name, left=sides[0], right=sides[1], stereo_rms_px=0.1, laser=laser, array=array)


def test_frames_of_a_scan_before_are_forgotten() -> None:
    blank = np.zeros((1024, 1280), np.uint8)
    before = [frames(blank, blank, k) for k in range(6)]
    stop = threading.Event()
    said: list[str] = []
    with pytest.raises(CalibrationRejectedError, match=r"1 passes `board-NN` and 0 passes `laser-NN`"):
        gather_optics(Given([*before, *scan_pairs()[:1]], stop), BOARD, said.append, stop)
    assert [line for line in said if line.startswith("scan")] == ["scan s", "scan calibration"]


def test_a_scan_has_ended_when_its_final_ledger_came(tmp_path: Path) -> None:
    rig = load_rig(rig_file(tmp_path))
    with open_router(rig.bus.endpoint), connect(rig.bus.endpoint, rig.name) as bus:
        ended = LedgerEnd(bus)
        ledgers = bus.publisher(topics.LEDGER)
        ledgers.put_json({"scan": "a", "final": False}, scan="a")
        ledgers.put_json({"scan": "b", "final": True}, scan="b")
        deadline_s = time.monotonic() + 10
        while not ended("b"):
            assert time.monotonic() < deadline_s
            time.sleep(0.01)
        assert not ended("a")


def camera_of(truth) -> CameraCalibration:
    return CameraCalibration(
        width_px=1280, height_px=1024, camera_matrix=truth.matrix.tolist(), distortion=truth.distortion.tolist(),
        camera_from_rig=truth.camera_from_rig.tolist(), rms_px=0.1,
    )  # fmt: skip


def test_the_alignment_of_each_lit_stripe_is_told() -> None:
    truth = optical_truth(1)
    cameras = Camera.of(camera_of(truth.left)), Camera.of(camera_of(truth.right))
    lit = [pair for pair in scan_pairs() if pair[0].header.source.laser_on][:2]
    dark = [pair for pair in scan_pairs() if not pair[0].header.source.laser_on][:1]
    blank = frames(np.zeros((1024, 1280), np.uint8), np.zeros((1024, 1280), np.uint8), 99, laser_on=True)
    said: list[str] = []
    stop = threading.Event()
    last = watch_alignment(Given([*dark, blank, *lit], stop), cameras, said.append, stop)
    assert said[0].startswith("trigger 99: align: 0 points")
    assert len(said) == 3
    slope = -truth.laser_normal[1] / truth.laser_normal[0]
    assert last is not None
    assert last.about_z_deg == pytest.approx(np.degrees(np.arctan(-slope)), abs=0.1)


def test_align_on_a_bus_prints_a_line_a_stripe(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    rig_path = rig_file(tmp_path)
    rig = load_rig(rig_path)
    path = tmp_path / "calibration.json"
    calibration_file.save(calibration_of(rig.name), path)
    lit = next(pair for pair in scan_pairs() if pair[0].header.source.laser_on)
    parser = argparse.ArgumentParser()
    calibrate.configure(parser)
    args = parser.parse_args(["align", "--rig", str(rig_path), "--calibration", str(path), "--stripes", "1"])
    with open_router(rig.bus.endpoint), connect(rig.bus.endpoint, rig.name) as bus:
        publishers = [bus.publisher(record.topic) for record in lit]
        for publisher, record in zip(publishers, lit, strict=True):
            publisher.put(record.payload, scan="s", trigger=7, source=Source(laser_on=True, x_mm=0.0))
        assert calibrate.run(args) == 0
    assert capsys.readouterr().out.startswith("trigger 7: ")


def test_align_without_a_calibration_is_refused(tmp_path: Path) -> None:
    rig_path = rig_file(tmp_path)
    parser = argparse.ArgumentParser()
    calibrate.configure(parser)
    with pytest.raises(CalibrationMissingError, match="names no calibration; give one with --calibration"):
        calibrate.run(parser.parse_args(["align", "--rig", str(rig_path)]))


def test_images_of_a_live_session_are_kept_as_a_folder_that_calibrates_again(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    left, right = render.pairs(PRINT, render.poses(8, PRINT))
    parser = argparse.ArgumentParser()
    calibrate.configure(parser)
    stop = threading.Event()
    said: list[str] = []
    folder = tmp_path / "boards"
    folder.mkdir()
    gather_views(
        Given([frames(left[k], right[k], k) for k in range(8)], stop), BOARD, said.append, stop,
        lambda number, a, b: write_pair(folder, number, a, b),
    )  # fmt: skip
    names, again, _ = read_pairs(folder)
    assert names == [f"{k:02d}" for k in range(1, 9)]
    assert np.array_equal(again[0], left[0])
    assert calibrate.run(parser.parse_args(["cameras", str(folder), "--json"])) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["stereo_rms_px"] < 0.05
    assert figures["leave_one_out_px"] < 0.05
    assert figures["sigmas"]["left fx_px"] < 0.5
    assert cv2.imread(str(folder / "right08.png"), cv2.IMREAD_GRAYSCALE).shape == (480, 640)
