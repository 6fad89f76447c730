"""Seconds of each rule for a million optical and ten thousand contact points, beside a plain numpy union."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping

import numpy as np

from echolume_messages.calibration import Calibration
from echolume_messages.plan import MapField
from echolume_messages.types import OPTICAL_POINT, ULTRASONIC_POINT, OpticalSource, Structured
from echolume_processing.hybrid.rules.registry import fuse_by

OPTICAL, ULTRASONIC = 1_000_000, 10_000
HALF_MM = 150.0
FIELD = MapField(x_mm=(-HALF_MM, HALF_MM), y_mm=(-HALF_MM, HALF_MM), cell_mm=1.0)
ROUNDS = 5
TIMED = ("optical", "ultrasonic", "union", "inverse-variance", "constant-gate", "footprint-gate")
"""The rules that rest on points alone."""


def some_points() -> tuple[Structured, Structured]:
    """A stair of 10 mm steps with a dark square and a plate 30 mm above the ground."""
    rng = np.random.default_rng(0)
    light, sound = np.zeros(OPTICAL, dtype=OPTICAL_POINT), np.zeros(ULTRASONIC, dtype=ULTRASONIC_POINT)
    for points in (light, sound):
        points["x_mm"], points["y_mm"] = rng.uniform(-HALF_MM, HALF_MM, (2, points.size))
        points["z_mm"] = 10 * np.floor(np.clip((points["x_mm"] + 20) / 30, 0, 4)) + rng.normal(0, 0.1, points.size)
    dark = (np.abs(light["x_mm"] + 100) < 25) & (np.abs(light["y_mm"] - 100) < 25)
    light["z_mm"][dark] = np.nan
    over = (np.abs(sound["x_mm"] + 80) < 40) & (np.abs(sound["y_mm"] + 60) < 40)
    sound["z_mm"][over] += 30
    light["sigma_z_mm"], light["source"], sound["zz_mm2"] = 0.1, OpticalSource.STEREO, 0.01
    return light, sound


def plain_union(light: Structured, sound: Structured) -> np.ndarray:
    """The mean of all points of a cell, with nothing beside it."""
    side = round(2 * HALF_MM / FIELD.cell_mm)
    place, height_mm = [], []
    for points in (light, sound):
        good = np.isfinite(points["z_mm"])
        ix, iy = (((points[name][good] + HALF_MM) / FIELD.cell_mm).astype(np.int64) for name in ("x_mm", "y_mm"))
        place.append(np.clip(iy, 0, side - 1) * side + np.clip(ix, 0, side - 1))
        height_mm.append(points["z_mm"][good])
    cell, z_mm = np.concatenate(place), np.concatenate(height_mm)
    with np.errstate(invalid="ignore"):
        return np.bincount(cell, z_mm, side * side) / np.bincount(cell, minlength=side * side)


def fusion_speed_rows(calibration: Calibration) -> dict[str, float]:
    """Least seconds of each way, all taking turns: what else the machine does only adds."""
    light, sound = some_points()
    ways: Mapping[str, Callable[[], object]] = {
        "plain numpy union": lambda: plain_union(light, sound),
        **{rule: lambda rule=rule: fuse_by(rule, light, sound, (), calibration, FIELD) for rule in TIMED},
    }
    spent: dict[str, list[float]] = {name: [] for name in ways}
    for _ in range(ROUNDS):
        for name, work in ways.items():
            began_s = time.perf_counter()
            work()
            spent[name].append(time.perf_counter() - began_s)
    least = {name: min(each) for name, each in spent.items()}
    print(f"\n{OPTICAL:.0e} + {ULTRASONIC:.0e} points{'s':>16}{'times numpy':>13}")
    for name, each in least.items():
        print(f"{name:24}{each:14.3f}{each / least['plain numpy union']:13.1f}")
    return {
        "fuse_s": least["footprint-gate"],
        "fuse_x_numpy_union": least["footprint-gate"] / least["plain numpy union"],
    }
