"""The images of sound alone of an emulated scan: from the archive to pictures, edges and a volume."""

from __future__ import annotations

import argparse
import json
import time
from pathlib import Path

import msgspec
import numpy as np
import pytest

from echolume_daemon.mcap_writer import ArchiveWriter
from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.scene import SceneBuilder
from echolume_messages import plan as plans
from echolume_messages import topics
from echolume_messages.bus import Message
from echolume_messages.calibration import Calibration
from echolume_messages.codec import json_array
from echolume_messages.errors import ArchiveError, CalibrationMissingError, ConfigError
from echolume_messages.header import Header, Source
from echolume_messages.rig import ArraySettings
from echolume_processing.commands import image as command
from echolume_processing.imaging import image_archive
from echolume_processing.sound_images import MapSettings, make_images
from echolume_processing.sound_scan import read_sound
from echolume_processing.sound_volume import VolumeSettings, clean_half_angle_rad, make_volume
from processing.hybrid_scan import TEMPERATURE_C, calibration_of

SETTINGS = ArraySettings(port="")
TOP_MM = 25.0
BLOCK = (-18.0, 22.0), (-22.0, 14.0)
PLAN = plans.parse(
    """
name = "block"
[map]
x_mm = [-40.0, 40.0]
y_mm = [-40.0, 40.0]
[[pass]]
name = "sound"
kind = "ultrasonic"
x_mm = [-40.0, 40.0]
y_mm = [-40.0, 40.0]
pitch_mm = 8.0
height_mm = 150.0
"""
)


def message(topic: topics.Topic, array: np.ndarray, trigger: int, source: Source) -> Message:
    header = Header(
        stream=topic.name, seq=trigger, t_ns=time.monotonic_ns(), t_wall_ns=1, boot="b", scan="s", trigger=trigger,
        pass_name="sound", source=source,
    )  # fmt: skip
    return Message(header, topic, array)


def write(path: Path, calibration: Calibration | None, pings: list[Message]) -> Path:
    start = {"scan": "s", "plan": msgspec.to_builtins(PLAN), "calibration": msgspec.to_builtins(calibration)}
    writer = ArchiveWriter(path)
    for record in (message(topics.SCAN_START, json_array(start), 0, Source()), *pings):
        writer.write(record)
    writer.close()
    return path


def pings_of(truth, poses: np.ndarray) -> list[Message]:
    """Emulated pings over a block 40 x 36 mm on the bench."""
    rng = np.random.default_rng(3)
    scene = SceneBuilder("block").box(*BLOCK, TOP_MM).build()
    out: list[Message] = []
    for k, pose in enumerate(poses):
        echoes = simulate_ping(scene, truth.rig_from_array(pose), SETTINGS, truth, TEMPERATURE_C, rng)
        source = Source(
            robot_pose=tuple(float(a) for a in pose), sample_rate_hz=SETTINGS.sample_rate_hz, start_s=0.0,
            air_temperature_c=TEMPERATURE_C,
        )  # fmt: skip
        out.append(message(topics.ECHOES, echoes, k, source))
    return out


@pytest.fixture(scope="module")
def calibration() -> Calibration:
    return calibration_of(SETTINGS, array_truth(1, SETTINGS), np.random.default_rng(1))


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory, calibration: Calibration) -> Path:
    poses = np.array(plans.raster(PLAN.passes[0]))
    pings = pings_of(array_truth(1, SETTINGS), poses)
    return write(tmp_path_factory.mktemp("imaging") / "raw.mcap", calibration, pings)


def test_the_volume_of_an_emulated_block_shows_its_top_where_it_is(archive: Path):
    scan = read_sound(archive)
    images = make_images(scan, MapSettings())
    volume = make_volume(scan, images, VolumeSettings(voxel_mm=2.0))
    assert volume.method == "fft"
    grid, level = volume.grid, volume.magnitude()
    x, y = np.meshgrid(grid.x_mm, grid.y_mm)
    inside = (x > -13) & (x < 17) & (y > -17) & (y < 9)
    outside = (x < -26) | (x > 30) | (y < -30) | (y > 22)
    top = np.median(level[:, inside], axis=1)
    bench = np.median(level[:, outside], axis=1)
    assert abs(grid.z_mm[np.argmax(top)] - TOP_MM) <= 2.0
    assert abs(grid.z_mm[np.argmax(bench)]) <= 2.0
    slice_at_top = level[np.argmax(top)]
    assert np.median(slice_at_top[inside]) > 4 * np.median(slice_at_top[outside])


def test_both_ways_give_the_same_volume_of_a_real_scans_poses(archive: Path):
    scan = read_sound(archive)
    images = make_images(scan, MapSettings())
    ways = [make_volume(scan, images, VolumeSettings(m, 4.0)).values.ravel() for m in ("fft", "gather")]
    alike = abs(np.vdot(*ways)) / np.prod([np.linalg.norm(w) for w in ways])
    assert alike > 0.999


def test_edges_of_the_block_come_back_within_the_beams_reach(archive: Path):
    images = make_images(read_sound(archive), MapSettings())
    assert len(images.edges) >= 2  # the beam rounds the corners of a block of five pitches
    for edge in images.edges:
        x, y, z = edge.ends_mm.T
        assert edge.ends_mm.shape == (2, 3)
        assert np.all(np.abs(z - TOP_MM) < 1.5)
        assert np.all((x > -30) & (x < 34) & (y > -34) & (y < 26))
        assert np.all(np.linalg.eigvalsh(edge.covariance_mm2) > 0)


def test_the_command_writes_pictures_volume_and_report(archive: Path, tmp_path: Path, capsys):
    parser = argparse.ArgumentParser()
    command.configure(parser)
    out = tmp_path / "images"
    args = parser.parse_args(
        [str(archive), "--out", str(out), "--volume", "--voxel", "4", "--levels", "0.25", "--json"]
    )
    assert command.run(args) == 0
    report = json.loads(capsys.readouterr().out)
    assert report["pings"] == 121
    assert report["level_mm"] == pytest.approx(0.25)
    assert report["volume"]["method"] == "fft"
    assert all((out / name).stat().st_size > 1000 for name in report["files"])
    with np.load(out / "volume.npz") as volume:
        assert volume["values"].shape == tuple(len(volume[f"{a}_mm"]) for a in "zyx")
        assert volume["coherence"].shape == volume["values"].shape
    args = parser.parse_args([str(archive), "--out", str(out), "--interpolate", "nearest"])
    assert command.run(args) == 0
    text = capsys.readouterr().out
    assert "map     nearest, pixel 1 mm" in text
    assert "volume" not in text


def test_what_cannot_be_imaged_is_refused_with_what_to_do(archive: Path, calibration: Calibration, tmp_path: Path):
    with pytest.raises(ConfigError, match=r"--levels: heights of .* take 0\.1"):
        image_archive(archive, tmp_path, MapSettings(level_mm=0.01))
    with pytest.raises(ConfigError, match="take larger ones"):
        image_archive(archive, tmp_path, MapSettings(), VolumeSettings(voxel_mm=0.05))
    bare = write(tmp_path / "bare.mcap", calibration, [])
    with pytest.raises(ArchiveError, match="holds no pings of an ultrasonic pass"):
        image_archive(bare, tmp_path, MapSettings())
    loose = write(tmp_path / "loose.mcap", None, [])
    with pytest.raises(CalibrationMissingError, match="made without a calibration"):
        image_archive(loose, tmp_path, MapSettings())
    poses = np.array(plans.raster(PLAN.passes[0]))[:11]
    row = write(tmp_path / "row.mcap", calibration, pings_of(array_truth(1, SETTINGS), poses))
    with pytest.raises(ArchiveError, match="lie in one row"):
        image_archive(row, tmp_path, MapSettings())


def test_scattered_poses_are_gathered_with_a_note_and_refused_by_fft(calibration: Calibration, tmp_path: Path):
    poses = np.array(plans.raster(PLAN.passes[0]))[::3]
    poses[:, :2] += np.random.default_rng(4).uniform(-3, 3, (len(poses), 2))
    path = write(tmp_path / "raw.mcap", calibration, pings_of(array_truth(1, SETTINGS), poses))
    with pytest.raises(ConfigError, match="--method fft"):
        image_archive(path, tmp_path, MapSettings(), VolumeSettings("fft", 4.0))
    found = image_archive(path, tmp_path, MapSettings(), VolumeSettings(voxel_mm=4.0))
    assert found["volume"] is not None
    assert found["volume"]["method"] == "gather"
    assert any("use the gather" in note for note in found["notes"])


def test_the_half_angle_follows_from_pitch_and_wavelength():
    assert clean_half_angle_rad(10.0, 7.66) == pytest.approx(np.arcsin(0.383))
    assert clean_half_angle_rad(4.0, 8.58) == pytest.approx(np.radians(45))
