"""The front door: quick help, clear refusals, exit codes."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest

from echolume.main import SUMMARIES, commands, main
from echolume_messages.topics_page import page

HEAVY = ("numpy", "scipy", "cv2", "numba", "rerun", "zenoh")


def test_help_lists_every_registered_command(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["--help"]) == 0
    text = capsys.readouterr().out
    assert all(f"  {name} " in text for name in commands())
    assert set(commands()) == set(SUMMARIES)


def test_help_imports_nothing_heavy() -> None:
    code = (
        "import sys; from echolume.main import main; main(['--help']);"
        f"sys.exit(any(m in sys.modules for m in {HEAVY!r}))"
    )
    assert subprocess.run([sys.executable, "-c", code], stdout=subprocess.DEVNULL, check=False).returncode == 0


def test_unknown_command_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["scann"]) == 2
    assert "no command 'scann'" in capsys.readouterr().err


@pytest.mark.parametrize("name", sorted(SUMMARIES))
def test_each_command_has_help_with_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit) as stop:
        main([name, "--help"])
    assert stop.value.code == 0
    assert "example" in capsys.readouterr().out.lower()


def test_topics_page_is_up_to_date() -> None:
    there = Path(__file__).parents[2] / "docs" / "topics.md"
    assert there.read_text(encoding="utf-8") == page(), "run: python -m echolume_messages.topics_page > docs/topics.md"
