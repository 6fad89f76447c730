"""The page of the paper's equations names only what exists, and leaves out none of the paper's numbers."""

from __future__ import annotations

import re
from functools import reduce
from importlib import import_module
from pathlib import Path

import pytest

HERE = Path(__file__).parent
ROOT = HERE.parent.parent
PAGE = (ROOT / "docs" / "equations.md").read_text(encoding="utf-8")
ROWS = [[cell.strip() for cell in line.strip("|").split("|")] for line in PAGE.splitlines() if line.startswith("| ")][
    1:
]
PAPER = [*(f"Eq. {n}" for n in range(1, 10)), *(f"Fig. {n}" for n in range(1, 14)), "Table I"]


def named(column: int) -> list[str]:
    return sorted({name for row in ROWS for name in re.findall(r"`([^`]+)`", row[column])})


def test_every_equation_figure_and_table_of_the_paper_has_one_row() -> None:
    assert sorted(row[0] for row in ROWS) == sorted(PAPER)


def test_every_row_names_a_function_a_test_and_a_picture_or_says_none() -> None:
    for row in ROWS:
        assert len(row) == 5
        assert all(("`" in cell) != (cell == "none") for cell in row[2:]), row[0]


def test_every_equation_has_a_function_and_a_test() -> None:
    assert all("none" not in row[2:4] for row in ROWS if row[0].startswith("Eq."))


@pytest.mark.parametrize("name", sorted({*named(2), *re.findall(r"`([a-z_.]+:\w+)`", PAGE)}))
def test_the_function_exists(name: str) -> None:
    module, _, attributes = name.partition(":")
    found = reduce(getattr, attributes.split("."), import_module(f"echolume_processing.{module}"))
    assert callable(found) or attributes.isupper()


@pytest.mark.parametrize("name", named(3))
def test_the_test_exists(name: str) -> None:
    file, _, function = name.partition("::")
    assert re.search(rf"^def {function}\(", (HERE / file).read_text(encoding="utf-8"), re.MULTILINE)


def test_the_pictures_are_drawn() -> None:
    drawing = "".join(path.read_text(encoding="utf-8") for path in (ROOT / "processing").rglob("figures*.py"))
    assert [name for name in named(4) if f'"{name}"' not in drawing] == []
