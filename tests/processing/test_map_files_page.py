"""docs/map-files.md tells the truth: its lines read every file without this project."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import numpy as np

from echolume_processing.export import formats
from processing.some_map import FIELD, some_map

PAGE = Path(__file__).resolve().parents[2] / "docs" / "map-files.md"


def test_the_documented_lines_read_each_file_without_this_project(tmp_path: Path) -> None:
    kept = some_map()
    for known in formats.FORMATS:
        known.write(kept, tmp_path / f"map{known.ending}")
    found = re.search(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    assert found is not None
    assert "echolume" not in found.group(1)
    run = subprocess.run(
        [sys.executable, "-W", "ignore::ResourceWarning", "-c", found.group(1)],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=True,
    )
    cells = kept.found.cells[np.isfinite(kept.found.cells["front_mm"])]
    assert run.stdout.splitlines() == [
        f"{cells.size} [1, 1, 1]",
        kept.scan,
        f"""{cells.size} {cells["provenance"][:3].tolist()} ,0],UNIT["metre",1]]""",
        f"{cells.size} {float(cells['front_mm'][0]) / 1e3:.3f}",
        f"{FIELD.shape} 2",
    ]


def test_every_ending_is_documented() -> None:
    text = PAGE.read_text(encoding="utf-8")
    assert all(f"| `{known.ending}` |" in text for known in formats.FORMATS)
