"""G-code lines as Grbl 1.1 reads them: words, modal groups and the errors of a bad line; pure."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Final

LINE_LIMIT: Final = 80

_WORD = re.compile(r"([A-Z])([^A-Z]*)")
_NUMBER = re.compile(r"[+-]?(\d+\.?\d*|\.\d+)$")
_MODAL = {"G": {0: "motion", 1: "motion", 20: "units", 21: "units", 90: "distance", 91: "distance", 94: "feed",
                17: "plane", 54: "coordinates", 80: "motion", 4: "once", 10: "once", 53: "once", 92: "once"},
          "M": {3: "spindle", 4: "spindle", 5: "spindle", 7: "coolant", 8: "coolant", 9: "coolant",
                0: "stop", 2: "stop", 30: "stop"}}  # fmt: skip


class GrblError(Exception):
    """A line that Grbl answers with ``error:code``."""

    def __init__(self, code: int) -> None:
        super().__init__(f"error:{code}")
        self.code = code


@dataclass(frozen=True)
class Block:
    """One parsed line; None stands for 'not in this line'."""

    motion: int | None = None
    units: int | None = None
    distance: int | None = None
    spindle: int | None = None
    once: int | None = None
    stop: int | None = None
    x: float | None = None
    other_axes: bool = False
    feed: float | None = None
    power: float | None = None
    dwell_s: float | None = None
    l_value: float | None = None


def strip(line: str) -> str:
    """Upper case, without spaces and comments."""
    return re.sub(r"\(.*?\)|;.*|\s", "", line).upper()


def words(text: str) -> list[tuple[str, float]]:
    """Letter and value pairs of a stripped line."""
    out: list[tuple[str, float]] = []
    position = 0
    while position < len(text):
        found = _WORD.match(text, position)
        if found is None:
            raise GrblError(1)
        if not _NUMBER.match(found[2]):
            raise GrblError(2)
        out.append((found[1], float(found[2])))
        position = found.end()
    return out


def parse(line: str) -> Block:
    """Read one line of G-code.

    Raises
    ------
    GrblError
        With the code that Grbl answers.
    """
    fields: dict[str, float | int] = {}
    values: dict[str, float] = {}
    for letter, value in words(strip(line)):
        if letter in _MODAL:
            if value != int(value):
                raise GrblError(20 if letter == "G" else 23)
            group = _MODAL[letter].get(int(value))
            if group is None:
                raise GrblError(20)
            if group in fields:
                raise GrblError(21)
            fields[group] = int(value)
        elif letter in "XYZFSPLN":
            if letter in values:
                raise GrblError(25)
            if letter in "FSPN" and value < 0:
                raise GrblError(4)
            values[letter] = value
        else:
            raise GrblError(20)
    return _checked(fields, values)


def _checked(fields: dict[str, float | int], values: dict[str, float]) -> Block:
    once = _whole(fields.get("once"))
    motion = _whole(fields.get("motion"))
    axes = [letter for letter in "XYZ" if letter in values]
    if once == 4 and "P" not in values:
        raise GrblError(28)
    if once in (10, 92) and not axes:
        raise GrblError(26)
    if once in (4, 10, 92) and motion is not None and axes:
        raise GrblError(24)
    if "P" in values and once not in (4, 10):
        raise GrblError(36)
    return Block(
        motion=motion,
        units=_whole(fields.get("units")),
        distance=_whole(fields.get("distance")),
        spindle=_whole(fields.get("spindle")),
        once=once,
        stop=_whole(fields.get("stop")),
        x=values.get("X"),
        other_axes="Y" in values or "Z" in values,
        feed=values.get("F"),
        power=values.get("S"),
        dwell_s=values.get("P") if once == 4 else None,
        l_value=values.get("L"),
    )


def _whole(value: float | None) -> int | None:
    return None if value is None else int(value)
