"""``echolume calibrate laser FOLDER``: images and guide positions from a folder give what the archive gives."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest

from echolume_messages.errors import CalibrationRejectedError, ConfigError
from echolume_processing.commands import calibrate
from echolume_processing.commands.stripe_folder import LIST, StripeFolder, read_shots
from echolume_processing.optical.calibrate_rig import calibrate_optics
from processing.calibration_scan import calibration_records


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("stripes")
    keeper = StripeFolder(out)
    records = calibration_records(1)
    for k in range(0, len(records), 2):
        keeper.keep(records[k], records[k + 1])
    return out


def run(*arguments: str) -> int:
    parser = argparse.ArgumentParser()
    calibrate.configure(parser)
    return calibrate.run(parser.parse_args(["laser", *arguments]))


def test_a_folder_gives_the_same_calibration_as_the_records(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert run(str(folder), "--json") == 0
    laser = json.loads(capsys.readouterr().out)["laser"]
    expected = calibrate_optics(calibration_records(1)).laser
    assert laser["normal"] == list(expected.normal)
    assert laser["offset_mm"] == expected.offset_mm


def test_each_pair_is_listed_with_its_guide_position(folder: Path) -> None:
    lines = (folder / LIST).read_text(encoding="utf-8").splitlines()
    assert lines[0] == "pass,x_mm,left,right"
    assert lines[1] == "board-00,,board-00-0000-0-left.png,board-00-0000-0-right.png"
    assert lines[2].startswith("laser-00,-40.0,laser-00-0001-0-left.png")


def test_a_folder_that_holds_a_list_is_not_written_over(folder: Path) -> None:
    with pytest.raises(ConfigError, match="there is one already"):
        StripeFolder(folder)


@pytest.mark.parametrize(
    ("text", "says"),
    [
        ("", "line 1: expected the columns pass,x_mm,left,right"),
        ("a,b,c,d\n", "line 1: expected the columns"),
        ("pass,x_mm,left,right\nlaser-00,ten,l.png,r.png\n", "line 2: expected the guide's position in mm, got 'ten'"),
        ("pass,x_mm,left,right\nlaser-00,nan,l.png,r.png\n", "line 2: expected the guide's position"),
        ("pass,x_mm,left,right\nlaser-00,,l.png,r.png\n", "line 2: expected the guide's position in mm, got ''"),
        ("pass,x_mm,left,right\nboard-00,,l.png\n", "line 2: expected a pass board-NN or laser-NN"),
        ("pass,x_mm,left,right\nplate,,l.png,r.png\n", "line 2: expected a pass"),
        ("pass,x_mm,left,right\nboard-00,,gone.png,r.png\n", "gone.png: not an image"),
        ("pass,x_mm,left,right\nboard-00,,l.png,small.png\n", "line 2: the images differ in size"),
    ],
)
def test_a_list_that_makes_no_sense_is_refused_by_its_line(tmp_path: Path, text: str, says: str) -> None:
    import cv2

    for name, size in (("l.png", (20, 30)), ("r.png", (20, 30)), ("small.png", (10, 30))):
        cv2.imwrite(str(tmp_path / name), np.zeros(size, np.uint8))
    (tmp_path / LIST).write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=says):
        read_shots(tmp_path)


def test_bytes_that_are_no_text_are_refused(tmp_path: Path) -> None:
    (tmp_path / LIST).write_bytes(b"\xff\xfe\x00pass")
    with pytest.raises(ConfigError, match="not a list"):
        read_shots(tmp_path)


def test_a_folder_without_list_says_what_the_laser_needs(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="needs the guide's position at each image"):
        run(str(tmp_path))


def test_a_list_without_pairs_is_no_calibration(tmp_path: Path) -> None:
    (tmp_path / LIST).write_text("pass,x_mm,left,right\n", encoding="utf-8")
    with pytest.raises(CalibrationRejectedError, match="found 0 passes"):
        run(str(tmp_path))
