"""The scan plan (TOML): passes of camera snaps, laser stripes and ultrasonic pings, expanded to numbered triggers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated, Literal

import msgspec

from echolume_messages.errors import ConfigError
from echolume_messages.files import read_text
from echolume_messages.topics import HYBRID_MAP

TRIGGER_LIMIT = 250_000
"""Triggers of one plan: many hours of scanning, and still a ledger that fits into one record."""
MAP_CELLS_LIMIT = HYBRID_MAP.limit_bytes // HYBRID_MAP.dtype.itemsize

Finite = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e6)]
Name = Annotated[str, msgspec.Meta(pattern=r"^[^/\x00-\x1f]+$", max_length=100)]
"""Ends up in file names."""
Pose6 = tuple[Finite, Finite, Finite, Finite, Finite, Finite]
"""x, y, z in mm; rx, ry, rz in degrees (plans are written by people)."""


class SnapPass(msgspec.Struct, tag="snap", tag_field="kind", forbid_unknown_fields=True):
    """Camera pairs without laser, e.g. of the calibration board."""

    name: Name
    exposure_ms: Positive = 8.0
    frames: Annotated[int, msgspec.Meta(ge=1, le=1000)] = 1
    prompt: str = ""
    """If not empty, the scan pauses before this pass and shows it; ``resume`` goes on."""


class OpticalPass(msgspec.Struct, tag="optical", tag_field="kind", forbid_unknown_fields=True):
    """Laser stripes along the guide, step and shoot."""

    name: Name
    start_mm: Finite
    stop_mm: Finite
    pitch_mm: Positive
    exposure_ms: Positive = 4.0
    mode: Literal["step"] = "step"
    prompt: str = ""


class UltrasonicPass(msgspec.Struct, tag="ultrasonic", tag_field="kind", forbid_unknown_fields=True):
    """A raster of robot poses (`x_mm`, `y_mm`, `pitch_mm`, `height_mm`), or a list of `poses`."""

    name: Name
    x_mm: tuple[Finite, Finite] | None = None
    y_mm: tuple[Finite, Finite] | None = None
    pitch_mm: Positive | None = None
    height_mm: Finite | None = None
    poses: list[Pose6] = msgspec.field(default_factory=list[Pose6])
    prompt: str = ""


Pass = SnapPass | OpticalPass | UltrasonicPass


class MapField(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Where the map lies, in the rig frame."""

    x_mm: tuple[Finite, Finite] = (-100.0, 100.0)
    y_mm: tuple[Finite, Finite] = (-100.0, 100.0)
    cell_mm: Positive = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """(rows along y, columns along x)."""
        return (
            round((self.y_mm[1] - self.y_mm[0]) / self.cell_mm),
            round((self.x_mm[1] - self.x_mm[0]) / self.cell_mm),
        )


class Plan(msgspec.Struct, forbid_unknown_fields=True):
    """A named list of passes; in the file: ``[[pass]]`` tables."""

    name: Name
    passes: list[Pass] = msgspec.field(name="pass")
    map: MapField = msgspec.field(default_factory=MapField)
    max_attempts: Annotated[int, msgspec.Meta(ge=1, le=100)] = 3
    """How often a missing position is acquired before it is given up and named."""


class Step(msgspec.Struct, frozen=True):
    """One trigger of a plan."""

    trigger: int
    pass_name: str
    kind: Literal["snap", "optical", "ultrasonic"]
    exposure_s: float = 0.0
    guide_x_mm: float | None = None
    pose: Pose6 | None = None
    """Robot target: mm and RADIANS."""
    prompt: str = ""
    """Non-empty on the first trigger of a pass that asks for the operator."""


def _count(start: float, stop: float, pitch: float, where: str) -> int:
    if not pitch > 0 or not math.isfinite(pitch):
        raise ConfigError(f"{where}: pitch_mm must be above 0, got {pitch}")
    if stop < start:
        raise ConfigError(f"{where}: ends at {stop} before it starts at {start}")
    count = math.floor((stop - start) / pitch + 1e-9) + 1
    if count > TRIGGER_LIMIT:
        raise ConfigError(f"{where}: {count} positions at a pitch of {pitch} mm, at most {TRIGGER_LIMIT} are taken")
    return count


def raster(item: UltrasonicPass, where: str = "plan") -> list[Pose6]:
    """Boustrophedon raster of an ultrasonic pass, or its own list of poses (degrees)."""
    if item.poses:
        return list(item.poses)
    where = f"{where}: pass {item.name!r}"
    if item.x_mm is None or item.y_mm is None or item.pitch_mm is None or item.height_mm is None:
        raise ConfigError(f"{where}: give `poses`, or all of x_mm, y_mm, pitch_mm, height_mm")
    nx = _count(*item.x_mm, item.pitch_mm, f"{where}: x_mm")
    ny = _count(*item.y_mm, item.pitch_mm, f"{where}: y_mm")
    if nx * ny > TRIGGER_LIMIT:
        raise ConfigError(f"{where}: {nx} x {ny} positions, at most {TRIGGER_LIMIT} are taken")
    out: list[Pose6] = []
    for j in range(ny):
        y = item.y_mm[0] + j * item.pitch_mm
        columns = range(nx) if j % 2 == 0 else range(nx - 1, -1, -1)
        out.extend((item.x_mm[0] + i * item.pitch_mm, y, item.height_mm, 0.0, 0.0, 0.0) for i in columns)
    return out


def expand(plan: Plan, where: str = "plan") -> list[Step]:
    """All triggers of a plan, numbered from 0 in the order of acquisition; errors begin with `where` it is from."""
    steps: list[Step] = []
    for item in plan.passes:
        prompt = item.prompt
        if isinstance(item, OpticalPass):
            n = _count(item.start_mm, item.stop_mm, item.pitch_mm, f"{where}: pass {item.name!r}")
            for k in range(n):
                x = round(item.start_mm + k * item.pitch_mm, 6)
                steps.append(
                    Step(len(steps), item.name, "optical", item.exposure_ms * 1e-3, guide_x_mm=x, prompt=prompt)
                )
                prompt = ""
        elif isinstance(item, SnapPass):
            for _ in range(item.frames):
                steps.append(Step(len(steps), item.name, "snap", item.exposure_ms * 1e-3, prompt=prompt))
                prompt = ""
        else:
            for x, y, z, rx, ry, rz in raster(item, where):
                pose = (x, y, z, math.radians(rx), math.radians(ry), math.radians(rz))
                steps.append(Step(len(steps), item.name, "ultrasonic", pose=pose, prompt=prompt))
                prompt = ""
        if len(steps) > TRIGGER_LIMIT:
            raise ConfigError(f"{where}: {len(steps)} triggers, at most {TRIGGER_LIMIT} are taken")
    return steps


def parse(text: str, where: str = "plan") -> Plan:
    """Read a plan from TOML text; errors carry the path, e.g. ``plan.toml: ... $.pass[0].pitch_mm``."""
    try:
        plan = msgspec.toml.decode(text, type=Plan)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{where}: {error}") from error
    names = [p.name for p in plan.passes]
    twice = sorted({n for n in names if names.count(n) > 1})
    if not names or twice:
        raise ConfigError(f"{where}: {'pass names must differ: ' + ', '.join(twice) if twice else 'no passes'}")
    _check_map(plan.map, where)
    expand(plan, where)
    return plan


def _check_map(field: MapField, where: str) -> None:
    for name, (first, last) in (("x_mm", field.x_mm), ("y_mm", field.y_mm)):
        if not last - first >= field.cell_mm:
            raise ConfigError(
                f"{where}: from {first} to {last} is less than a cell of {field.cell_mm} mm - at `$.map.{name}`"
            )
    rows, columns = field.shape
    if rows * columns > MAP_CELLS_LIMIT:
        raise ConfigError(f"{where}: a map of {rows} x {columns} cells, at most {MAP_CELLS_LIMIT} - at `$.map`")


def load(path: Path) -> Plan:
    """Read a plan file."""
    return parse(read_text(path, "the plan"), str(path))
