"""Figures of sound's physics: Table I from one radius, the disk's equations, and paths against others' simulators."""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Mapping
from importlib import import_module
from pathlib import Path

import numpy as np
from scipy.optimize import least_squares

from echolume_processing.ultrasonic import acoustics
from echolume_processing.ultrasonic.cross_talk import CrossTalk
from echolume_processing.ultrasonic.plate_energy import fit_gaussian, plate_energy
from echolume_processing.ultrasonic.table_one import (
    ANGLES_RAD,
    TABLE_I,
    fit_table,
    fit_table_with_cross_talk,
    table_gaussians,
    table_lines,
)

TESTS = Path(__file__).resolve().parents[2] / "tests"
WAVENUMBER = 2 * np.pi / 8.58
RADIUS_MM = 6.2
C_DEG = np.array([row[4] for row in TABLE_I])

TARGETS: Mapping[str, tuple[str, str]] = {
    "table1_kR": ("4.41-4.71", ""),
    "table1_rms_c_deg": ("1", ""),
    "table1_rms_c_without_row1_deg": ("0.6", ""),
    "table1_row1_with_floor_deg": ("", "0.5"),
    "eq5_eq6_rel": ("1e-9", ""),
    "eq7_eq5_at_0p2m": ("0.005", ""),
    "path_vs_simus3_mm": ("0.005", ""),
    "time_vs_pyroom_us": ("0.01", ""),
}
"""What is asked at least, and the aim."""

Floor = Callable[[float, float, float], float]
FLOORS: Mapping[str, Floor] = {
    "the same share of each row's peak": lambda p, d, s: p,
    "noise: over the echo, path squared": lambda p, d, s: p * (d / 200) ** 2,
    "direct sound that never dies away": lambda p, d, s: p * (d / 200) ** 2 * (30 / s) ** 2,
    "through the holder, however far apart": lambda p, d, s: p * (d / 200) ** 2 * np.exp(-2 * (d - 200) / 54.6),
    "1/distance, dies with 159 us": lambda p, d, s: p * (d / 200) ** 2 * (30 / s) ** 2 * np.exp(-4 * (d - 200) / 54.6),
}
"""Other floors below the echo's energy, share of its peak, over the plate's distance and the separation in mm."""


def rms(values: np.ndarray) -> float:
    """Root of the mean square."""
    return float(np.sqrt(np.mean(values**2)))


def floor_widths(floor: Floor, kr: float, height: float) -> np.ndarray:
    """Widths c (deg) of the twelve rows with a floor below each."""
    out = np.empty(len(TABLE_I))
    for k, (distance_mm, separation_mm, *_) in enumerate(TABLE_I):
        energy = plate_energy(ANGLES_RAD, distance_mm, separation_mm, kr) + floor(height, distance_mm, separation_mm)
        out[k] = np.degrees(fit_gaussian(ANGLES_RAD, energy / energy.max()).c_rad)
    return out


def table_rows() -> dict[str, float]:
    """Table I from one radius, and what one more parameter can do to its first row."""
    plain, lifted = fit_table(), fit_table_with_cross_talk()
    print("\nTable I\n" + "\n".join(table_lines(plain, lifted)))
    print(
        f"k R {plain.wavenumber_radius:.3f} alone; {lifted.wavenumber_radius:.3f} with cross-talk of {lifted.level:.4f}"
    )
    off_a = f"{rms(plain.residuals_a):.3f} and {rms(lifted.residuals_a):.3f}"
    print(f"RMS of a: {off_a}; of b after one offset a distance: {rms(plain.residuals_b_deg):.2f} deg")
    print("RMS of c in deg: all rows, without row 1; row 1; what was fitted")
    print(f"{plain.rms_c_deg:6.2f}{plain.rms_c_without_row_1_deg:6.2f}{plain.residuals_c_deg[0]:+7.2f}   none")
    for name, floor in FLOORS.items():
        _show_floor(name, floor)
    for quality, cycles in ((0.1, 8), (10.0, 8), (20.0, 4), (20.0, 8), (20.0, 16), (40.0, 8)):
        found = fit_table_with_cross_talk(CrossTalk(0.02, quality, cycles))
        name = f"cross-talk, Q {quality:g}, {cycles} cycles: level {found.level:.4f}, k R {found.wavenumber_radius:.2f}"
        print(f"{found.rms_c_deg:6.2f}{found.rms_c_without_row_1_deg:6.2f}{found.residuals_c_deg[0]:+7.2f}   {name}")
    others = fit_table_with_cross_talk(rows=slice(1, None))
    print(
        f"the eleven other rows alone: level {others.level:.4f}, {others.rms_c_without_row_1_deg:.2f} deg; "
        f"they foretell row 1 with {others.residuals_c_deg[0]:+.2f} deg"
    )
    sideways = float(acoustics.directivity(np.array([lifted.wavenumber_radius]))[0]) ** 2
    by_piston = np.degrees(table_gaussians(lifted.wavenumber_radius, CrossTalk(sideways))[0].c_rad) - C_DEG[0]
    print(
        f"a baffled piston's own level at 90 deg, both ways: {sideways:.4f}, "
        f"{20 * np.log10(lifted.level / sideways):.1f} dB below; with it row 1 is off by {by_piston:+.2f} deg"
    )
    return {
        "table1_kR": plain.wavenumber_radius,
        "table1_rms_c_deg": plain.rms_c_deg,
        "table1_rms_c_without_row1_deg": plain.rms_c_without_row_1_deg,
        "table1_row1_with_floor_deg": abs(float(lifted.residuals_c_deg[0])),
    }


def _show_floor(name: str, floor: Floor) -> None:
    def residuals(p: np.ndarray) -> np.ndarray:
        return floor_widths(floor, float(p[0]), float(p[1]) ** 2) - C_DEG

    starts = (np.array([4.6, 0.05]), np.array([4.6, 0.3]))
    left = min((least_squares(residuals, at, diff_step=1e-4) for at in starts), key=lambda s: s.cost).fun
    print(f"{rms(left):6.2f}{rms(left[1:]):6.2f}{left[0]:+7.2f}   {name}")


def disk_rows() -> dict[str, float]:
    """Equation 5 against 6 on the axis and against 7 at 0.2 m, and against its plain sum over the disk in time."""
    z = np.geomspace(0.1, 1e4, 400)
    on_axis = acoustics.rayleigh_pressure(np.column_stack([np.zeros((400, 2)), z]), WAVENUMBER, RADIUS_MM)
    exact = acoustics.axial_pressure(z, WAVENUMBER, RADIUS_MM)
    angle = np.radians(np.linspace(0, 89, 357))
    around = 200 * np.column_stack([np.sin(angle), np.zeros(angle.shape), np.cos(angle)])
    pressure = np.abs(acoustics.rayleigh_pressure(around, WAVENUMBER, RADIUS_MM))
    beam = np.abs(acoustics.directivity(WAVENUMBER * RADIUS_MM * np.sin(angle)))
    spent: dict[str, list[float]] = {"along the edge": [], "sum over the disk": []}
    for _ in range(5):
        for name, way in (("along the edge", acoustics.rayleigh_pressure), ("sum over the disk", disk_sum)):
            began_s = time.perf_counter()
            way(around, WAVENUMBER, RADIUS_MM)
            spent[name].append(time.perf_counter() - began_s)
    edge_us, sum_us = (1e6 * float(np.median(s)) / len(around) for s in spent.values())
    off = np.abs(disk_sum(around, WAVENUMBER, RADIUS_MM) - acoustics.rayleigh_pressure(around, WAVENUMBER, RADIUS_MM))
    print(
        f"\nEquation 5 at a point: {edge_us:.1f} us; as a sum of 96 x 192 pieces {sum_us / edge_us:.0f} times as long"
    )
    print(f"they differ by {off.max():.1e} rho c U0 at 0.2 m")
    return {
        "eq5_eq6_rel": float(np.max(np.abs(np.abs(on_axis) - exact) / exact)),
        "eq7_eq5_at_0p2m": float(np.max(np.abs(pressure / pressure[0] - beam))),
    }


def disk_sum(points_mm: np.ndarray, wavenumber: float, radius_mm: float) -> np.ndarray:
    """Equation 5 as printed, over Gauss-Legendre rings and even spokes."""
    nodes, weights = np.polynomial.legendre.leggauss(96)
    radius = radius_mm * np.sqrt(0.5 * (nodes + 1))[:, None]
    around = 2 * np.pi * (np.arange(192) + 0.5) / 192
    x, y = radius * np.cos(around), radius * np.sin(around)
    area = 0.25 * radius_mm**2 * weights * (2 * np.pi / 192)
    out = np.empty(len(points_mm), dtype=np.complex128)
    for k, (px, py, pz) in enumerate(points_mm):
        away = np.sqrt((px - x) ** 2 + (py - y) ** 2 + pz**2)
        out[k] = np.sum(area @ (np.exp(-1j * wavenumber * away) / away))
    return 1j * wavenumber / (2 * np.pi) * out


def other_tools_rows() -> dict[str, float]:
    """Our paths and times against PyMUST and pyroomacoustics, as the tests hear them."""
    if str(TESTS) not in sys.path:
        sys.path.append(str(TESTS))
    tools = import_module("processing.other_tools")
    paths_mm, times_us = tools.point_path_errors_mm(), tools.wall_time_errors_us()
    print(f"\nsimus3: {len(paths_mm)} points, largest of each in um: {1e3 * np.abs(paths_mm).max(axis=1)}")
    print(f"pyroomacoustics: {len(times_us)} walls, largest of each in ns: {1e3 * np.abs(times_us).max(axis=1)}")
    return {
        "path_vs_simus3_mm": float(np.abs(paths_mm).max()),
        "time_vs_pyroom_us": float(np.abs(times_us).max()),
    }


def physics_rows() -> dict[str, float]:
    """All figures of the physics, printed beside what is asked."""
    figures = table_rows() | disk_rows() | other_tools_rows()
    print(f"\n{'physics':32}{'measured':>12}{'at least':>12}{'aim':>8}")
    for key, (bar, aim) in TARGETS.items():
        print(f"{key:32}{figures[key]:12.3g}{bar:>12}{aim:>8}")
    return figures


if __name__ == "__main__":
    physics_rows()
