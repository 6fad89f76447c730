"""A report as two columns."""

from __future__ import annotations

import sys
from collections.abc import Mapping, Sequence


def write_table(rows: Sequence[tuple[str, str]], left_out: Mapping[str, str]) -> None:
    """Write names and values, then each view left out with its reason."""
    width = max(len(name) for name, _ in rows)
    lines = [f"{name:<{width}}  {value}" for name, value in rows]
    lines += [f"left out: view {name}: {why}" for name, why in left_out.items()]
    sys.stdout.write("\n".join(lines) + "\n")


def say(line: str) -> None:
    """A line of a live session on stdout, at once."""
    sys.stdout.write(line + "\n")
    sys.stdout.flush()


def say_aside(line: str) -> None:
    """A line of a live session whose result goes to stdout."""
    sys.stderr.write(line + "\n")
