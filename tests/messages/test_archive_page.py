"""docs/archive.md tells the truth: its ten lines read an archive with mcap and numpy alone."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

from daemon.test_recorder_writer import scan_records, written

PAGE = Path(__file__).resolve().parents[2] / "docs" / "archive.md"


def test_the_documented_lines_read_an_archive_without_this_project(tmp_path: Path) -> None:
    written(tmp_path / "raw.mcap", scan_records(2))
    found = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    program = found.group(1)
    assert "echolume" not in re.sub(r'"echolume\.Header"', "", program)
    run = subprocess.run(
        [sys.executable, "-W", "ignore::ResourceWarning", "-c", program],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    assert run.stdout.splitlines() == [
        line
        for k in range(2)
        for line in (
            f"/cameras/left {k} (12, 16)",
            f"/cameras/right {k} (12, 16)",
            f"/array/echoes {k} (8, 32)",
            f"/conductor/state {k} (7,)",
        )
    ]
