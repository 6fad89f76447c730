"""Lines and the errors that Grbl 1.1 answers."""

from __future__ import annotations

import pytest

from echolume_drivers.emulated.grbl_parser import GrblError, parse


@pytest.mark.parametrize(
    ("line", "code"),
    [
        ("1X10", 1),  # no letter
        ("GX10", 2),  # no number
        ("X1.2.3", 2),
        ("F-100", 4),
        ("G5", 20),  # not in Grbl
        ("G38.2 Z-1", 20),  # no probe on this board
        ("T1", 20),
        ("G0 G1 X1", 21),
        ("M3 M5", 21),
        ("M3.5", 23),
        ("G1 X1 G4 P1", 24),
        ("X1 X2", 25),
        ("G92", 26),
        ("G4", 28),
        ("X1 P2", 36),
    ],
)
def test_a_bad_line_gets_its_code(line: str, code: int) -> None:
    with pytest.raises(GrblError) as caught:
        parse(line)
    assert caught.value.code == code


def test_spaces_case_and_comments_do_not_matter() -> None:
    assert parse("g53 g1 x-10.5 f6000 (go)") == parse("G53G1X-10.5F6000;go")


def test_an_empty_line_is_an_empty_block() -> None:
    block = parse("")
    assert block.x is None
    assert block.motion is None
