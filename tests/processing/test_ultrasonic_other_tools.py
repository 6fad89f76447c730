"""Paths, points and planes against echoes by somebody else's code: PyMUST's simus3 and pyroomacoustics."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.signal import fftconvolve

from echolume_processing.ultrasonic import baseband, contact, flight, matched_filter
from processing import other_tools
from processing.other_tools import (
    POINT_RATE_HZ,
    POINTS_MM,
    RECEIVERS_MM,
    REFERENCE_MM,
    ROOM_RATE_HZ,
    SAMPLES,
    SPEED_MPS,
    WALLS,
    point_echoes,
    point_paths_mm,
    wall,
    wall_paths_mm,
)

ALL = np.ones(8, dtype=np.bool_)
BAND_HZ = (30e3, 50e3)


def test_paths_by_way_of_a_point_are_those_of_simus3_within_5_um() -> None:
    assert np.abs(other_tools.point_path_errors_mm()).max() < 0.005


def test_times_by_way_of_a_wall_are_those_of_pyroomacoustics_within_10_ns() -> None:
    assert np.abs(other_tools.wall_time_errors_us()).max() < 0.01


@pytest.mark.parametrize("point_mm", POINTS_MM)
def test_our_model_of_a_point_predicts_the_paths_that_were_compared(point_mm: np.ndarray) -> None:
    found = contact.fit_point(RECEIVERS_MM, point_paths_mm(point_mm), ALL)
    assert found is not None
    np.testing.assert_allclose(found[0], point_mm, atol=1e-6)
    np.testing.assert_allclose(found[1], point_paths_mm(point_mm), atol=1e-9)


@pytest.mark.parametrize(("distance_mm", "turn_deg"), WALLS)
def test_our_model_of_a_plane_predicts_the_paths_that_were_compared(
    distance_mm: float, turn_deg: tuple[float, float, float]
) -> None:
    there = wall(distance_mm, turn_deg)
    found = contact.fit_plane(RECEIVERS_MM, wall_paths_mm(there), ALL)
    assert found is not None
    np.testing.assert_allclose(found.normal, there.normal, atol=1e-9)
    np.testing.assert_allclose(found.paths_mm, wall_paths_mm(there), atol=1e-9)


def measured_paths_mm(
    echoes: np.ndarray, reference: np.ndarray, reference_mm: np.ndarray, rate_hz: float
) -> np.ndarray:
    """Paths (8,) by the matched filter, whose templates are cut from a reference of known paths (8,)."""
    origin = 1e-3 * float(reference_mm.mean()) / SPEED_MPS * rate_hz
    first = int(origin) - 160
    templates = np.ascontiguousarray(reference[:, first : first + 400]).astype(np.float32)
    bank = matched_filter.matched_filter(templates, origin - first, rate_hz, BAND_HZ, SAMPLES)
    compressed = baseband.baseband(bank, np.asarray(echoes, dtype=np.float32))
    threshold = np.full(compressed.magnitude.shape[1], 1e-3, dtype=np.float32)
    gate_s = (200 / rate_hz, (SAMPLES - 200) / rate_hz)
    heard = flight.first_arrivals(compressed, gate_s, threshold, strongest=True)
    assert heard.found.all()
    # A template's own arrival differs from the mean by its path less the mean path.
    return 1e3 * SPEED_MPS * heard.time_s + reference_mm - reference_mm.mean()


@pytest.mark.parametrize("point_mm", POINTS_MM)
def test_a_point_is_found_in_the_echoes_of_simus3_within_1_um(point_mm: np.ndarray) -> None:
    paths_mm = measured_paths_mm(
        point_echoes(point_mm), point_echoes(REFERENCE_MM), point_paths_mm(REFERENCE_MM), POINT_RATE_HZ
    )
    found = contact.contact(RECEIVERS_MM, paths_mm, np.full(8, 0.02), max_tilt_rad=0.6)
    assert found.kind == contact.EchoKind.POINT
    np.testing.assert_allclose(found.points_mm[0], point_mm, atol=0.001)


def burst(rate_hz: float) -> np.ndarray:
    time_s = np.arange(100) / rate_hz
    return np.hanning(100) * np.sin(2 * np.pi * 40e3 * time_s)


@pytest.mark.parametrize(("distance_mm", "turn_deg"), WALLS)
def test_a_wall_is_found_in_the_echoes_of_pyroomacoustics_within_1_um_and_a_thousandth_of_a_degree(
    distance_mm: float, turn_deg: tuple[float, float, float]
) -> None:
    there, before = wall(distance_mm, turn_deg), wall(300.0, (0.0, 0.0, 0.0))
    heard, reference = (
        fftconvolve(w.responses, burst(ROOM_RATE_HZ)[None], axes=1)[:, :SAMPLES] for w in (there, before)
    )
    paths_mm = measured_paths_mm(heard, reference, wall_paths_mm(before), ROOM_RATE_HZ)
    found = contact.fit_plane(RECEIVERS_MM, paths_mm, ALL)
    assert found is not None
    assert found.distance_mm == pytest.approx(distance_mm, abs=0.001)
    assert np.degrees(np.linalg.norm(np.cross(found.normal, there.normal))) < 0.001
