"""Narrow band: whole waves of contact points, and of the gates' plates, come from where the echoes begin."""

from __future__ import annotations

from dataclasses import replace

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated.scene import Material, SceneBuilder
from echolume_messages.types import ULTRASONIC_POINT, Label, Structured
from echolume_processing.hybrid.rules.band import narrow, slips, wavelength_mm
from echolume_processing.hybrid.rules.onsets import by_onset
from echolume_processing.hybrid.rules.registry import fuse_by
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline
from processing.hybrid_scan import FIELD, SmallScan, small_scan

TOP_MM = 30.0
HALF_MM, INNER_MM = 36, 24
LOW_HZ, HIGH_HZ = 36.1e3, 43.9e3
"""What a calibration finds of the paper's pulse."""


@pytest.fixture(scope="module")
def scan() -> SmallScan:
    """A plate of glass in the middle, heard by the paper's array."""
    scene = SceneBuilder("plate").box((-HALF_MM, HALF_MM), (-HALF_MM, HALF_MM), TOP_MM, Material.GLASS)
    made = small_scan(scene.build(), pitch_mm=10.0, pulse="paper")
    array = msgspec.structs.replace(made.calibration.array, low_hz=LOW_HZ, high_hz=HIGH_HZ)
    return replace(made, calibration=msgspec.structs.replace(made.calibration, array=array))


@pytest.fixture(scope="module")
def heard(scan: SmallScan) -> Structured:
    pipeline = UltrasonicPipeline(scan.calibration)
    return np.concatenate([pipeline.process(p) for p in scan.pings])


def well_over_plate(points: Structured) -> Structured:
    return points[(np.abs(points["x_mm"]) < INNER_MM) & (np.abs(points["y_mm"]) < INNER_MM)]


def test_over_a_plate_the_onsets_find_the_wave_that_the_peaks_miss(scan: SmallScan, heard: Structured) -> None:
    assert narrow(scan.calibration.array)
    right, chosen = (
        np.mean(np.abs(well_over_plate(points)["z_mm"] - TOP_MM) < 1)
        for points in (heard, by_onset(scan.pings, scan.calibration)[0])
    )
    assert chosen > 0.85
    assert chosen > right + 0.1


def test_heights_move_by_whole_half_waves_and_nothing_else_changes(scan: SmallScan, heard: Structured) -> None:
    found, _ = by_onset(scan.pings, scan.calibration)
    waves = (found["z_mm"] - heard["z_mm"]) / (0.5 * wavelength_mm(scan.calibration.array))
    assert (np.round(waves) != 0).any()
    np.testing.assert_allclose(waves, np.round(waves), atol=1e-4)
    for name in ULTRASONIC_POINT.names or ():
        if name != "z_mm":
            np.testing.assert_array_equal(found[name], heard[name])


def test_any_order_of_pings_gives_the_same_points(scan: SmallScan) -> None:
    one, two = (by_onset(pings, scan.calibration)[0] for pings in (scan.pings, scan.pings[::-1]))
    assert sorted(point.tobytes() for point in one) == sorted(point.tobytes() for point in two)


def test_without_pings_there_are_no_points(scan: SmallScan) -> None:
    assert by_onset((), scan.calibration)[0].size == 0


def test_a_gate_with_pings_puts_the_plate_where_it_is(scan: SmallScan, heard: Structured) -> None:
    middle = slice(48 - INNER_MM, 48 + INNER_MM)
    right = {}
    for pings in ((), tuple(scan.pings)):
        found = fuse_by("footprint-gate", scan.optical, heard, pings, scan.calibration, FIELD)
        assert (found.image("label")[middle, middle] == Label.TRANSPARENT).mean() > 0.8
        assert found.notes[1:] == slips(scan.calibration.array, bool(pings))
        right[bool(pings)] = np.mean(np.abs(found.image("front_mm")[middle, middle] - TOP_MM) < 1)
    assert right[True] > 0.75
    assert right[True] > right[False] + 0.1
