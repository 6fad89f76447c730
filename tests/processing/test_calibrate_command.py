"""``echolume calibrate``: the published stereo pairs, an archive, and bad input."""

from __future__ import annotations

import argparse
import json
import os
from pathlib import Path

import cv2
import numpy as np
import pytest
from mcap.writer import Writer

from echolume_messages import calibration as calibration_file
from echolume_messages.archive_format import CHANNEL_BY_NAME, encode_message
from echolume_messages.errors import ArchiveError, CalibrationMissingError, CalibrationRejectedError, ConfigError
from echolume_processing.commands import calibrate
from processing.calibration_scan import calibration_records
from processing.test_optical_subscriber import calibration as some_calibration

ROOT = Path(__file__).resolve().parents[2]
DATA = Path(os.environ.get("ECHOLUME_DATA", "") or ROOT.parent / "shared" / "data")
PAIRS = DATA / "opencv-stereo"
needs_pairs = pytest.mark.skipif(not PAIRS.is_dir(), reason=f"no folder {PAIRS}; set ECHOLUME_DATA")


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    calibrate.configure(parser)
    return calibrate.run(parser.parse_args(arguments))


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("archive") / "calibrate.mcap"
    with path.open("wb") as stream:
        writer = Writer(stream)
        writer.start()
        numbers: dict[int, int] = {}
        for name, channel in CHANNEL_BY_NAME.items():
            numbers[channel.number] = writer.register_channel(topic=name, message_encoding="x", schema_id=0)
        for record in calibration_records(1):
            for number, data in encode_message(record):
                stamp = record.header.t_wall_ns
                writer.add_message(channel_id=numbers[number], log_time=stamp, publish_time=stamp, data=bytes(data))
        writer.finish()
    return path


@needs_pairs
def test_the_published_stereo_pairs_calibrate_below_a_fifth_of_a_pixel(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("cameras", str(PAIRS), "--pattern", "9x6", "--square", "25", "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["views"] == 13
    assert figures["rejected"] == {}
    assert figures["left_rms_px"] <= 0.17
    assert figures["right_rms_px"] <= 0.17
    assert figures["stereo_rms_px"] <= 0.18
    assert figures["leave_one_out_px"] <= 0.19
    assert figures["published_left_rms_px"] == pytest.approx(0.39259, abs=1e-5)
    assert figures["baseline_mm"] == pytest.approx(83.18, abs=0.1)
    assert figures["square_mean_mm"] == pytest.approx(25.0, abs=0.01)
    assert figures["square_sd_mm"] < 0.11


@needs_pairs
def test_the_table_shows_the_published_error_beside_ours(capsys: pytest.CaptureFixture[str]) -> None:
    assert run("cameras", str(PAIRS), "--pattern", "9x6", "--square", "25") == 0
    text = capsys.readouterr().out
    assert "13 of 13" in text
    assert "left RMS" in text
    assert "published with the images: 0.39259 px" in text


def test_the_laser_is_calibrated_from_an_archive(archive: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run("laser", str(archive), "--json") == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["plane_rms_mm"] < 0.06
    assert figures["stereo_rms_px"] < 0.06
    assert figures["laser"]["normal"][0] > 0.999
    assert run("laser", str(archive)) == 0
    assert "laser plane" in capsys.readouterr().out


def test_a_calibration_file_gets_new_optical_parts_and_keeps_its_array(archive: Path, tmp_path: Path) -> None:
    path = tmp_path / "calibration.json"
    before = some_calibration("test")
    calibration_file.save(before, path)
    assert run("laser", str(archive), "--into", str(path)) == 0
    after = calibration_file.load(path, "test")
    assert after.array == before.array
    assert after.laser != before.laser
    assert after.digest != before.digest


def test_a_missing_calibration_to_update_is_noticed_before_the_work(archive: Path, tmp_path: Path) -> None:
    with pytest.raises(CalibrationMissingError, match=r"none\.json"):
        run("laser", str(archive), "--into", str(tmp_path / "none.json"))


def test_a_file_that_is_no_archive_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "notes.mcap"
    path.write_text("not an archive")
    with pytest.raises(ArchiveError, match=r"notes\.mcap"):
        run("laser", str(path))


@pytest.mark.parametrize("pattern", ["9", "9x", "axb", "9x6x3"])
def test_a_pattern_that_cannot_be_read_is_refused(pattern: str, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"--pattern .*: expected inner corners along x and y, such as 9x6"):
        run("cameras", str(tmp_path), "--pattern", pattern)


def test_a_missing_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="nowhere: no such folder"):
        run("cameras", str(tmp_path / "nowhere"))


def test_an_empty_folder_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="no images named leftNN"):
        run("cameras", str(tmp_path))


def test_an_image_without_its_partner_is_named(tmp_path: Path) -> None:
    cv2.imwrite(str(tmp_path / "left01.png"), np.zeros((20, 20), np.uint8))
    with pytest.raises(ConfigError, match=r"right01\.png: missing"):
        run("cameras", str(tmp_path))


def test_a_broken_image_is_named(tmp_path: Path) -> None:
    for side in ("left", "right"):
        (tmp_path / f"{side}01.png").write_bytes(b"no image")
    with pytest.raises(ConfigError, match=r"left01\.png: not an image"):
        run("cameras", str(tmp_path))


def test_images_without_a_board_are_refused_by_name(tmp_path: Path) -> None:
    for number in range(4):
        for side in ("left", "right"):
            cv2.imwrite(str(tmp_path / f"{side}{number:02d}.png"), np.full((200, 300), 90, np.uint8))
    with pytest.raises(CalibrationRejectedError, match="00: no 9x6 corners in the left and right image"):
        run("cameras", str(tmp_path))


def test_images_of_different_sizes_are_refused(tmp_path: Path) -> None:
    for number in range(4):
        for side in ("left", "right"):
            cv2.imwrite(str(tmp_path / f"{side}{number:02d}.png"), np.full((200, 300 + number), 90, np.uint8))
    with pytest.raises(CalibrationRejectedError, match="different sizes"):
        run("cameras", str(tmp_path))
