"""The option --rule of `echolume reprocess`."""

from __future__ import annotations

from pathlib import Path

import pytest

from echolume.main import main
from echolume_processing.hybrid.rules.names import DESCRIPTIONS


def test_the_rules_are_listed_with_what_they_do(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main(["reprocess", "--list-rules"])
    assert stop.value.code == 0
    said = capsys.readouterr().out.splitlines()
    assert [line.split()[0] for line in said] == list(DESCRIPTIONS)
    assert all(text in line for text, line in zip(DESCRIPTIONS.values(), said, strict=True))


def test_an_unknown_rule_is_refused_with_the_known_ones(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    code = main(["reprocess", str(tmp_path / "raw.mcap"), "--out", str(tmp_path / "out"), "--rule", "best"])
    said = capsys.readouterr().err
    assert code == 2
    assert "unknown fusion rule 'best'" in said
    assert all(name in said for name in DESCRIPTIONS)
    assert not (tmp_path / "out").exists()
