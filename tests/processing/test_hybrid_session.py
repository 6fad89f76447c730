"""A scan live and from its archive: the same map, its files, and what happens when something is missing."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, cast

import msgspec
import numpy as np
import plyfile
import pytest
from rerun.chunk import RrdReader

from echolume_daemon.mcap_writer import ArchiveWriter
from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stripe_image import render_stripe
from echolume_messages import plan as plans
from echolume_messages import topics
from echolume_messages.bus import Bus, Message
from echolume_messages.calibration import Calibration
from echolume_messages.codec import json_array
from echolume_messages.errors import ArchiveError, CalibrationMissingError
from echolume_messages.header import Header, Source
from echolume_messages.rig import ArraySettings, Rig
from echolume_messages.types import Label, Structured
from echolume_processing.evidence import Evidence
from echolume_processing.session import gather, reprocess
from echolume_processing.subscribers import hybrid
from loopback import lab_rig, running_subscriber
from processing.hybrid_scan import TEMPERATURE_C, calibration_of
from processing.test_optical_pipeline import camera_of, laser_of

SEED = 1
DEADLINE_S = 60.0
SCAN = "s1"
PLAN = plans.parse(
    """
name = "small"
[map]
x_mm = [-3.0, 3.0]
y_mm = [-20.0, 20.0]
[[pass]]
name = "light"
kind = "optical"
start_mm = -3.0
stop_mm = 3.0
pitch_mm = 1.0
[[pass]]
name = "sound"
kind = "ultrasonic"
x_mm = [-10.0, 10.0]
y_mm = [-10.0, 10.0]
pitch_mm = 10.0
height_mm = 150.0
"""
)


@dataclass(frozen=True)
class Recorded:
    """A small scan of the bare bench: its records, and its archive."""

    records: list[Message]
    archive: Path
    calibration: Calibration


def message(topic: topics.Topic, array: np.ndarray, trigger: int, pass_name: str, source: Source, seq: int) -> Message:
    header = Header(
        stream=topic.name, seq=seq, t_ns=time.monotonic_ns(), t_wall_ns=1, boot="b", scan=SCAN, trigger=trigger,
        pass_name=pass_name, source=source,
    )  # fmt: skip
    return Message(header, topic, array)


def start(calibration: Calibration | None) -> Message:
    held = msgspec.to_builtins(calibration)
    body = {"scan": SCAN, "plan": msgspec.to_builtins(PLAN), "calibration": held, "rig": "test"}
    return message(topics.SCAN_START, json_array(body), -1, "", Source(), 0)


def archived(path: Path, records: list[Message]) -> Path:
    writer = ArchiveWriter(path)
    for record in records:
        writer.write(record)
    writer.close()
    return path


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Recorded:
    rng = np.random.default_rng(SEED)
    optics, settings = optical_truth(SEED), ArraySettings(port="")
    array = array_truth(SEED, settings)
    calibration = calibration_of(settings, array, rng)
    calibration = msgspec.structs.replace(
        calibration, left=camera_of(optics.left), right=camera_of(optics.right), laser=laser_of()
    )
    records = [start(calibration)]
    for step in plans.expand(PLAN):
        if step.guide_x_mm is not None:
            source = Source(x_mm=step.guide_x_mm, laser_on=True)
            for topic, side in ((topics.CAMERA_LEFT, "left"), (topics.CAMERA_RIGHT, "right")):
                frame = render_stripe(plate(), optics, side, step.guide_x_mm, rng, 4e-3, True)
                records.append(message(topic, frame, step.trigger, step.pass_name, source, len(records)))
        elif step.pose is not None:
            pose = np.array(step.pose)
            block = simulate_ping(plate(), array.rig_from_array(pose), settings, array, TEMPERATURE_C, rng)
            source = Source(
                robot_pose=step.pose, sample_rate_hz=settings.sample_rate_hz, start_s=0.0,
                air_temperature_c=TEMPERATURE_C,
            )  # fmt: skip
            records.append(message(topics.ECHOES, block, step.trigger, step.pass_name, source, len(records)))
    path = archived(tmp_path_factory.mktemp("archive") / "raw.mcap", records)
    return Recorded(records, path, calibration)


@pytest.fixture(scope="module")
def evidence(recorded: Recorded) -> Evidence:
    return gather(recorded.archive)


@pytest.fixture(scope="module")
def reprocessed(recorded: Recorded, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, dict[str, Any]]:
    out = tmp_path_factory.mktemp("out")
    told: list[str] = []
    results = reprocess(recorded.archive, out, lambda what, _done, _total: told.append(what))
    assert {"stripes", "pings", "fusing", "writing", "drawing", "done"} <= set(told)
    return out, cast("dict[str, Any]", results)


def test_an_archive_gives_a_map_and_every_file_that_it_names(reprocessed: tuple[Path, dict[str, Any]]) -> None:
    out, results = reprocessed
    assert results["scan"] == SCAN
    assert results["cells"]["matte"] > 200
    assert results["cells"]["transparent"] == 0
    assert min(results["points"].values()) > 0
    assert {"hybrid.rrd", "hybrid.ply", "map.npz", "figures/fig13_hybrid.png"} <= set(results["files"])
    for name in results["files"]:
        assert (out / name).stat().st_size > 0, name
    for picture in (out / "figures").iterdir():
        assert picture.read_bytes().startswith(b"\x89PNG"), picture
    with np.load(out / "map.npz") as maps:
        shape = PLAN.map.shape
        for name in ("front_mm", "behind_mm", "label", "provenance", "optical_mm", "ultrasonic_mm", "union_mm"):
            assert maps[name].shape == shape, name
        claimed = np.isfinite(maps["front_mm"])
        assert np.abs(maps["front_mm"][claimed]).max() < 0.5
        assert plyfile.PlyData.read(str(out / "hybrid.ply"))["vertex"].count == claimed.sum()


def test_the_recording_holds_points_map_and_notes(reprocessed: tuple[Path, dict[str, Any]], evidence: Evidence) -> None:
    reader = RrdReader(reprocessed[0] / "hybrid.rrd")
    assert [store.application_id for store in reader.recordings()] == ["echolume"]
    assert reader.blueprints()
    chunks = list(reader.stream())
    entities = {chunk.entity_path for chunk in chunks}
    wanted = {"st", "at_left", "at_right", "us", "hybrid"}
    assert {f"/rig/map/{name}" for name in wanted} <= entities
    assert {"/us/echoes", "/us/level", "/notes", "/map/labels", "/map/height"} <= entities
    stereo = [chunk for chunk in chunks if chunk.entity_path == "/rig/map/st"]
    assert sum(chunk.to_record_batch().num_rows for chunk in stereo) == len(evidence.optical)


def test_a_torn_archive_gives_what_is_before_the_tear(recorded: Recorded, tmp_path: Path) -> None:
    data = recorded.archive.read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(data[: int(0.7 * len(data))])
    found = gather(torn)
    assert 0 < len(found.optical) < 7
    assert not found.pings


def test_an_archive_without_a_scan_or_without_a_calibration_is_refused(recorded: Recorded, tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match="no archive of a scan"):
        gather(archived(tmp_path / "a.mcap", recorded.records[1:3]))
    with pytest.raises(CalibrationMissingError, match="echolume calibrate"):
        gather(archived(tmp_path / "b.mcap", [start(None), *recorded.records[1:3]]))


def test_of_a_trigger_acquired_twice_the_later_attempt_counts(evidence: Evidence) -> None:
    own = Evidence("s", PLAN, evidence.calibration)
    first, second = next(iter(evidence.optical.values()))[1][:5], next(iter(evidence.optical.values()))[1][5:7]
    own.add_optical(3, 1, second)
    own.add_optical(3, 0, first)
    np.testing.assert_array_equal(own.all_optical(), second)


@pytest.fixture
def rig() -> Rig:
    return lab_rig()


@pytest.fixture
def live(rig: Rig, tmp_path: Path) -> Iterator[Bus]:
    """A router, the hybrid subscriber on it writing to tmp_path, and the bus of everybody else."""
    with running_subscriber("hybrid", rig, lambda stop: hybrid.main(rig=rig, out=tmp_path, stop=stop)) as bus:
        yield bus


def put(bus: Bus, topic: topics.Topic, array: Structured, trigger: int, pass_name: str, source: Source) -> None:
    bus.publisher(topic).put(array, scan=SCAN, pass_name=pass_name, trigger=trigger, source=source)


def test_live_points_in_any_order_give_the_digest_of_the_archive(
    live: Bus,
    recorded: Recorded,
    evidence: Evidence,
    reprocessed: tuple[Path, dict[str, Any]],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(hybrid, "STALLED_S", 1.0)
    triggers = {"light": sorted(evidence.optical), "sound": [*sorted(evidence.pings), 999]}
    with live.subscribe([topics.HYBRID_DONE]) as done, live.subscribe([topics.HYBRID_MAP]) as maps:
        for trigger in reversed(triggers["light"]):
            put(live, topics.OPTICAL_POINTS, evidence.optical[trigger][1], trigger, "light", Source())
        live.publisher(topics.LEDGER).put_json({"scan": SCAN, "final": True, "triggers": triggers}, scan=SCAN)
        live.publisher(topics.SCAN_START).put(recorded.records[0].payload, scan=SCAN)
        for record in recorded.records:
            if record.topic == topics.ECHOES:
                header = record.header
                put(live, topics.ECHOES, record.payload, header.trigger, "sound", header.source)
                points = evidence.ultrasonic[header.trigger][1]
                put(live, topics.ULTRASONIC_POINTS, points, header.trigger, "sound", header.source)
        deadline_s = time.monotonic() + DEADLINE_S
        found = None
        while found is None:
            assert time.monotonic() < deadline_s, "no map"
            found = done.get(0.5)
        results = cast("dict[str, Any]", found.json())
        cells = maps.get(DEADLINE_S)
    assert results["digest"] == reprocessed[1]["digest"]
    assert results["points"] == reprocessed[1]["points"]
    assert results["missing"] == {"sound": [999]}
    assert results["lag_p99_ms"] > 0
    assert (tmp_path / "hybrid.ply").exists()
    assert cells is not None
    assert cells.header.calibration == recorded.calibration.digest
    assert (cells.payload["label"] != Label.TRANSPARENT).all()
