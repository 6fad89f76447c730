"""A scan live and from its archive: the same map, its files, and what happens when something is missing."""

from __future__ import annotations

import time
from collections.abc import Iterator
from dataclasses import dataclass
from importlib.metadata import version
from pathlib import Path
from typing import Any, cast

import cv2
import msgspec
import numpy as np
import plyfile
import pyarrow as pa
import pytest
from rerun.chunk import RrdReader

from echolume_daemon.mcap_writer import ArchiveWriter
from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stripe_image import render_stripe
from echolume_messages import geometry, topics
from echolume_messages import plan as plans
from echolume_messages.bus import Bus, Message
from echolume_messages.calibration import Calibration
from echolume_messages.codec import json_array
from echolume_messages.errors import ArchiveError, CalibrationMissingError
from echolume_messages.header import Header, Source
from echolume_messages.rig import ArraySettings, Rig
from echolume_messages.types import Label, OpticalSource, Structured
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


def report(topic: topics.Topic, body: dict[str, Any], seq: int) -> Message:
    return message(topic, json_array(body), -1, "", Source(), seq)


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
    counts = {"planned": 7, "fired": 7, "matched": 7}
    ledger = {"final": True, "outcome": "complete", "passes": {"light": counts}, "archive": "/somewhere/raw.mcap"}
    records.insert(1, report(topics.RUN_STATE, {"state": "running", "pass": "light", "fired": 1}, 0))
    records.insert(2, report(topics.RUN_STATE, {"state": "running", "pass": "light", "fired": 2}, 1))
    records.append(report(topics.LEDGER, ledger, 0))
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
        kinds = {p.name: p.__struct_config__.tag for p in PLAN.passes}
        steps = {s.trigger: kinds[s.pass_name] for s in plans.expand(PLAN)}
        assert {steps[t] for t in maps["stripe_ids"].tolist()} == {"optical"}
        assert {steps[t] for t in maps["ping_ids"].tolist()} == {"ultrasonic"}
        assert plyfile.PlyData.read(str(out / "hybrid.ply"))["vertex"].count == claimed.sum()


def test_the_rule_is_named_and_another_one_gives_another_map(
    recorded: Recorded, reprocessed: tuple[Path, dict[str, Any]], tmp_path: Path
) -> None:
    alone = reprocess(recorded.archive, tmp_path, rule="optical")
    assert (reprocessed[1]["rule"], alone["rule"]) == ("synthesis", "optical")
    assert alone["digest"] != reprocessed[1]["digest"]
    with np.load(tmp_path / "map.npz") as maps:
        np.testing.assert_array_equal(maps["front_mm"], maps["optical_mm"])


def test_the_recording_holds_points_map_and_notes(reprocessed: tuple[Path, dict[str, Any]], evidence: Evidence) -> None:
    reader = RrdReader(reprocessed[0] / "hybrid.rrd")
    assert [store.application_id for store in reader.recordings()] == ["echolume"]
    assert reader.blueprints()
    chunks = list(reader.stream())
    entities = {chunk.entity_path for chunk in chunks}
    wanted = {"st", "at_left", "at_right", "us", "hybrid"}
    assert {f"/rig/map/{name}" for name in wanted} <= entities
    assert {"/us/echoes", "/us/level", "/notes", "/map/labels", "/map/height", "/map/probability"} <= entities
    stereo = [chunk for chunk in chunks if chunk.entity_path == "/rig/map/st"]
    assert sum(chunk.to_record_batch().num_rows for chunk in stereo) == len(evidence.optical)


def values(column: pa.Array) -> list[Any]:
    """Values of a column; times in ns."""
    return (column.cast("int64") if pa.types.is_temporal(column.type) else column).to_pylist()


def rows(path: Path, entity: str, *columns: str) -> list[tuple[Any, ...]]:
    """Rows of an entity of a recording, in order of the steps."""
    found: list[tuple[Any, ...]] = []
    for chunk in RrdReader(path).stream().filter(content=entity):
        batch = chunk.to_record_batch()
        if set(columns) <= set(batch.schema.names):
            found.extend(zip(*(values(batch.column(name)) for name in columns), strict=True))
    return sorted(found, key=lambda row: str(row[0]).zfill(9))


def pictures(path: Path, side: str) -> list[tuple[Any, ...]]:
    return rows(path, f"/rig/cam_{side}/image", "scan_step", "rig_time", "EncodedImage:blob")


def test_the_recording_shows_every_fourth_raw_frame_and_the_peaks_on_it(
    recorded: Recorded, reprocessed: tuple[Path, dict[str, Any]], evidence: Evidence
) -> None:
    path = reprocessed[0] / "hybrid.rrd"
    frames = {r.header.trigger: r for r in recorded.records if r.topic == topics.CAMERA_LEFT}
    for step, rig_time, blob in pictures(path, "left"):
        frame = frames[step]
        shown = cv2.imdecode(np.frombuffer(bytes(blob[0]), dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
        assert np.abs(shown.astype(int) - frame.payload).mean() < 2.0
        assert rig_time == frame.header.t_ns
    assert [row[0] for row in pictures(path, "left")] == [row[0] for row in pictures(path, "right")] == [0, 4]
    for step, peaks_px in rows(path, "/rig/cam_left/stripe", "scan_step", "Points2D:positions"):
        own = evidence.optical[step][1]
        own = own[own["source"] == OpticalSource.ACTIVE_LEFT]
        peaks = np.array(peaks_px)
        np.testing.assert_allclose(peaks[:, 1], own["row"], atol=0.05)
        brightest = frames[step].payload[own["row"]].argmax(axis=1)
        assert np.median(np.abs(peaks[:, 0] - brightest)) < 2.0


def test_the_recording_places_cameras_array_and_laser_in_one_rig(
    recorded: Recorded, reprocessed: tuple[Path, dict[str, Any]], evidence: Evidence
) -> None:
    path, calibration = reprocessed[0] / "hybrid.rrd", recorded.calibration
    ((child, parent, centre_mm),) = rows(
        path, "/tf/cam_left", "Transform3D:child_frame", "Transform3D:parent_frame", "Transform3D:translation"
    )
    assert (child, parent) == (["cam_left"], ["rig"])
    np.testing.assert_allclose(centre_mm[0], geometry.invert(calibration.left.pose)[:3, 3], rtol=1e-6)
    ((frame, resolution),) = rows(path, "/rig/cam_left", "CoordinateFrame:frame", "Pinhole:resolution")
    assert (frame, resolution) == (["cam_left_img"], [[1280.0, 1024.0]])
    places = rows(path, "/tf/us_array", "scan_step", "Transform3D:translation")
    assert [step for step, _ in places] == sorted(evidence.pings)
    assert np.ptp([place[0][2] for _, place in places]) < 2.0
    laser, planes = calibration.laser, rows(path, "/rig/laser_plane", "scan_step", "Mesh3D:vertex_positions")
    for (_, corners), step in zip(planes, plans.expand(PLAN)[:7], strict=True):
        distance_mm = laser.offset_mm + (step.guide_x_mm or 0.0) * np.dot(laser.normal, laser.guide_direction)
        np.testing.assert_allclose(np.array(corners) @ laser.normal, distance_mm, atol=1e-3)
    assert rows(path, "/rig/laser_plane", "scan_step", "Clear:is_recursive") == [(min(evidence.pings), [False])]


def test_a_strong_echo_stands_at_the_plates_path(reprocessed: tuple[Path, dict[str, Any]], evidence: Evidence) -> None:
    path = reprocessed[0] / "hybrid.rrd"
    found = rows(path, "/us/envelope", "scan_step", "BarChart:abscissa", "BarChart:values")
    assert [row[0] for row in found] == sorted(evidence.ultrasonic)
    for _, abscissa, values in found:
        path_mm, strength = (np.array(v[0]["buffer"]) for v in (abscissa, values))
        assert abs(path_mm[strength.argmax()] - 300.0) < 5.0
        assert 0.7 < strength.max() < 1.3


def test_every_step_stands_on_three_timelines(recorded: Recorded, reprocessed: tuple[Path, dict[str, Any]]) -> None:
    path, start = reprocessed[0] / "hybrid.rrd", recorded.records[0].header
    times = {r.header.trigger: r.header.t_ns for r in recorded.records if r.topic != topics.CAMERA_RIGHT}
    for entity in ("/rig/map/st", "/rig/map/us", "/us/level"):
        for step, rig_time, utc in rows(path, entity, "scan_step", "rig_time", "utc"):
            assert rig_time == times[step]
            assert utc == rig_time + start.t_wall_ns - start.t_ns


def test_the_recording_says_what_determined_it(reprocessed: tuple[Path, dict[str, Any]], recorded: Recorded) -> None:
    path = reprocessed[0] / "hybrid.rrd"
    names = "calibration_digest", "map_digest", "archive", "outcome", "echolume_version"
    ((calibration, found, archive, outcome, code),) = rows(path, "/__properties/scan", *names)
    assert calibration == [recorded.calibration.digest]
    assert found == [reprocessed[1]["digest"]]
    assert (archive, outcome) == (["raw.mcap"], ["complete"])
    assert code == [version("echolume")]
    said = [text[0] for _, text in rows(path, "/log", "scan_step", "TextLog:text")]
    assert said == ["running; pass light", "ledger, complete: matched light 7 of 7"]


def test_a_torn_archive_gives_what_is_before_the_tear(recorded: Recorded, tmp_path: Path) -> None:
    data = recorded.archive.read_bytes()
    torn = tmp_path / "torn.mcap"
    torn.write_bytes(data[: int(0.7 * len(data))])
    found = gather(torn)
    assert 0 < len(found.optical) < 7
    assert not found.pings


def test_an_archive_without_a_scan_or_without_a_calibration_is_refused(recorded: Recorded, tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match="no archive of a scan"):
        gather(archived(tmp_path / "a.mcap", recorded.records[3:5]))
    with pytest.raises(CalibrationMissingError, match="echolume calibrate"):
        gather(archived(tmp_path / "b.mcap", [start(None), *recorded.records[3:5]]))


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


def put(
    bus: Bus,
    topic: topics.Topic,
    array: Structured,
    trigger: int,
    pass_name: str,
    source: Source,
    t_ns: int | None = None,
) -> None:
    bus.publisher(topic).put(array, scan=SCAN, pass_name=pass_name, trigger=trigger, source=source, t_ns=t_ns)


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
            header = record.header
            if record.topic in (topics.CAMERA_LEFT, topics.CAMERA_RIGHT):
                put(live, record.topic, record.payload, header.trigger, "light", header.source, header.t_ns)
                put(live, record.topic, record.payload[:9], header.trigger, "light", header.source)  # a stranger's
            elif record.topic == topics.ECHOES:
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
    for side in ("left", "right"):
        assert pictures(tmp_path / "hybrid.rrd", side) == pictures(reprocessed[0] / "hybrid.rrd", side)
    assert cells is not None
    assert cells.header.calibration == recorded.calibration.digest
    assert (cells.payload["label"] != Label.TRANSPARENT).all()


def test_while_a_scan_runs_its_map_grows(
    live: Bus, recorded: Recorded, evidence: Evidence, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hybrid, "SHOWN_EVERY_S", 0.0)
    claimed = list[int]()
    with live.subscribe([topics.HYBRID_GROWING], depth=64) as growing:
        live.publisher(topics.SCAN_START).put(recorded.records[0].payload, scan=SCAN)
        for trigger in sorted(evidence.optical)[:3]:
            put(live, topics.OPTICAL_POINTS, evidence.optical[trigger][1], trigger, "light", Source())
            found = growing.get(DEADLINE_S)
            assert found is not None, "the map does not grow"
            assert found.header.scan == SCAN
            claimed.append(int(np.isfinite(found.payload["front_mm"]).sum()))
    # The first stripe fills one column, and cells without neighbours count as noise.
    assert claimed[0] < claimed[1] < claimed[2]
