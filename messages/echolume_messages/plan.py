"""The scan plan (TOML): passes of camera snaps, laser stripes and ultrasonic pings, expanded to numbered triggers."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Literal

import msgspec

from echolume_messages.errors import ConfigError

Pose6 = tuple[float, float, float, float, float, float]
"""x, y, z in mm; rx, ry, rz in degrees (plans are written by people)."""


class SnapPass(msgspec.Struct, tag="snap", tag_field="kind", forbid_unknown_fields=True):
    """Camera pairs without laser, e.g. of the calibration board."""

    name: str
    exposure_ms: float = 8.0
    frames: int = 1
    prompt: str = ""
    """If not empty, the scan pauses before this pass and shows it; ``resume`` goes on."""


class OpticalPass(msgspec.Struct, tag="optical", tag_field="kind", forbid_unknown_fields=True):
    """Laser stripes along the guide, step and shoot."""

    name: str
    start_mm: float
    stop_mm: float
    pitch_mm: float
    exposure_ms: float = 4.0
    mode: Literal["step"] = "step"
    prompt: str = ""


class UltrasonicPass(msgspec.Struct, tag="ultrasonic", tag_field="kind", forbid_unknown_fields=True):
    """A raster of robot poses (`x_mm`, `y_mm`, `pitch_mm`, `height_mm`), or a list of `poses`."""

    name: str
    x_mm: tuple[float, float] | None = None
    y_mm: tuple[float, float] | None = None
    pitch_mm: float | None = None
    height_mm: float | None = None
    poses: list[Pose6] = msgspec.field(default_factory=list[Pose6])
    prompt: str = ""


Pass = SnapPass | OpticalPass | UltrasonicPass


class MapField(msgspec.Struct, forbid_unknown_fields=True, frozen=True):
    """Where the map lies, in the rig frame."""

    x_mm: tuple[float, float] = (-100.0, 100.0)
    y_mm: tuple[float, float] = (-100.0, 100.0)
    cell_mm: float = 1.0

    @property
    def shape(self) -> tuple[int, int]:
        """(rows along y, columns along x)."""
        return (
            round((self.y_mm[1] - self.y_mm[0]) / self.cell_mm),
            round((self.x_mm[1] - self.x_mm[0]) / self.cell_mm),
        )


class Plan(msgspec.Struct, forbid_unknown_fields=True):
    """A named list of passes; in the file: ``[[pass]]`` tables."""

    name: str
    passes: list[Pass] = msgspec.field(name="pass")
    map: MapField = msgspec.field(default_factory=MapField)
    max_attempts: int = 3
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
        raise ConfigError(f"plan: {where}: pitch_mm must be above 0, got {pitch}")
    if stop < start:
        raise ConfigError(f"plan: {where}: ends at {stop} before it starts at {start}")
    return math.floor((stop - start) / pitch + 1e-9) + 1


def raster(item: UltrasonicPass) -> list[Pose6]:
    """Boustrophedon raster of an ultrasonic pass, or its own list of poses (degrees)."""
    if item.poses:
        return list(item.poses)
    if item.x_mm is None or item.y_mm is None or item.pitch_mm is None or item.height_mm is None:
        raise ConfigError(f"plan: pass {item.name!r}: give `poses`, or all of x_mm, y_mm, pitch_mm, height_mm")
    nx = _count(*item.x_mm, item.pitch_mm, f"pass {item.name!r}")
    ny = _count(*item.y_mm, item.pitch_mm, f"pass {item.name!r}")
    out: list[Pose6] = []
    for j in range(ny):
        y = item.y_mm[0] + j * item.pitch_mm
        columns = range(nx) if j % 2 == 0 else range(nx - 1, -1, -1)
        out.extend((item.x_mm[0] + i * item.pitch_mm, y, item.height_mm, 0.0, 0.0, 0.0) for i in columns)
    return out


def expand(plan: Plan) -> list[Step]:
    """All triggers of a plan, numbered from 0 in the order of acquisition."""
    steps: list[Step] = []
    for item in plan.passes:
        prompt = item.prompt
        if isinstance(item, OpticalPass):
            n = _count(item.start_mm, item.stop_mm, item.pitch_mm, f"pass {item.name!r}")
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
            for x, y, z, rx, ry, rz in raster(item):
                pose = (x, y, z, math.radians(rx), math.radians(ry), math.radians(rz))
                steps.append(Step(len(steps), item.name, "ultrasonic", pose=pose, prompt=prompt))
                prompt = ""
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
    expand(plan)
    return plan


def load(path: Path) -> Plan:
    """Read a plan file."""
    try:
        return parse(path.read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the plan: {error.strerror}") from error
