"""The command `echolume figures`: pictures that show something, and Table I as text and as JSON."""

from __future__ import annotations

import argparse
import json
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from echolume_messages.errors import ArchiveError, ConfigError
from echolume_processing.commands import figures as command
from echolume_processing.ultrasonic.table_one import TABLE_I
from processing.test_hybrid_session import Recorded, recorded

__all__ = ["recorded"]

OF_SOUND = ["fig02_axis.png", "fig03_beam.png", "fig05_contacts.png", "fig06_energy.png", "table1.png"]


def run(*arguments: str | Path) -> int:
    parser = argparse.ArgumentParser()
    command.configure(parser)
    return command.run(parser.parse_args([str(a) for a in arguments]))


def test_the_papers_pictures_of_sound_are_drawn_and_table_1_is_printed(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run("--out", tmp_path / "new") == 0
    assert sorted(path.name for path in (tmp_path / "new").iterdir()) == OF_SOUND
    for name in OF_SOUND:
        picture = imread(tmp_path / "new" / name)
        assert min(picture.shape[:2]) > 400
        assert 0.01 < np.mean(picture[:, :, :3].min(axis=2) < 0.8) < 0.9, name  # neither blank nor a blot
    text = capsys.readouterr().out
    assert "k R alone         4.556: c off by 0.95 deg RMS, 0.58 without row 1" in text
    assert text.count("(+") + text.count("(-") == 2 * len(TABLE_I)


@pytest.mark.timeout(300)  # where kernels were never compiled, this is the first to need the fusion's
def test_json_holds_the_table_and_an_archive_adds_its_scans_pictures(
    recorded: Recorded, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert run(recorded.archive, "--out", tmp_path, "--json") == 0
    report = json.loads(capsys.readouterr().out)
    assert {Path(name).name for name in report["files"]} == {path.name for path in tmp_path.iterdir()}
    assert "fig13_hybrid.png" in {path.name for path in tmp_path.iterdir()}
    assert len(report["table"]) == len(TABLE_I)
    first = report["table"][0]
    assert first["paper"] == {"a": 1.0, "b_deg": 0.56, "c_deg": 21.2}
    assert first["with_cross_talk"]["c_deg"] == pytest.approx(21.2, abs=0.5)
    assert report["kR"] == pytest.approx(4.56, abs=0.15)


def test_an_archive_that_is_not_there_is_named_and_nothing_is_drawn(tmp_path: Path) -> None:
    with pytest.raises(ArchiveError, match=r"nothing\.mcap: cannot read the archive"):
        run(tmp_path / "nothing.mcap", "--out", tmp_path / "out")
    assert list((tmp_path / "out").iterdir()) == []


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="--out"):
        run("--out", tmp_path / "file" / "below")
