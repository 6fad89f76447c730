"""The paper's transducer: equations 5 to 7, near and far field, and the beam's angles."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_processing.ultrasonic import acoustics

WAVENUMBER = 2 * np.pi / 8.58
RADIUS_MM = 6.2
KR = WAVENUMBER * RADIUS_MM


def summed_over_the_disk(point_mm: np.ndarray, rings: int = 400, spokes: int = 800) -> complex:
    """Equation 5 as printed: Gauss-Legendre along the radius' square, evenly spaced around."""
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    radius = RADIUS_MM * np.sqrt(0.5 * (nodes + 1))[:, None]
    around = 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    away = np.sqrt(
        (point_mm[0] - radius * np.cos(around)) ** 2 + (point_mm[1] - radius * np.sin(around)) ** 2 + point_mm[2] ** 2
    )
    area = 0.25 * RADIUS_MM**2 * weights * (2 * np.pi / spokes)
    return complex(1j * WAVENUMBER / (2 * np.pi) * np.sum(area @ (np.exp(-1j * WAVENUMBER * away) / away)))


@pytest.mark.parametrize(
    ("point_mm", "within"),
    [
        ((3.0, 1.0, 2.0), 1e-12),
        ((6.2, 0.0, 1.0), 1e-12),  # above the edge
        ((6.2001, 0.0, 5.0), 1e-12),
        ((10.0, 0.0, 0.5), 1e-12),
        ((300.0, 0.0, 1.0), 1e-12),  # in the baffle's plane
        ((6.0, 0.0, 0.3), 1e-6),  # the sum itself is no better so near
    ],
)
def test_the_pressure_is_the_sum_of_equation_5_over_the_disk(point_mm: tuple[float, ...], within: float) -> None:
    found = acoustics.rayleigh_pressure(np.array([point_mm]), WAVENUMBER, RADIUS_MM)
    assert abs(found[0] - summed_over_the_disk(np.array(point_mm))) < within


def test_the_rayleigh_integral_equals_the_axial_pressure_on_the_axis() -> None:
    z = np.geomspace(0.01, 1e5, 200)
    on_axis = np.column_stack([np.zeros((200, 2)), z])
    pressure = np.abs(acoustics.rayleigh_pressure(on_axis, WAVENUMBER, RADIUS_MM))
    np.testing.assert_allclose(pressure, acoustics.axial_pressure(z, WAVENUMBER, RADIUS_MM), rtol=1e-9)


@pytest.mark.parametrize("radius_mm", [1.0, 6.2, 60.0])
def test_narrow_and_wide_disks_agree_with_equation_6_too(radius_mm: float) -> None:
    z = np.linspace(1.0, 900.0, 97)
    on_axis = np.column_stack([np.zeros((97, 2)), z])
    pressure = np.abs(acoustics.rayleigh_pressure(on_axis, WAVENUMBER, radius_mm))
    np.testing.assert_allclose(pressure, acoustics.axial_pressure(z, WAVENUMBER, radius_mm), rtol=1e-9, atol=1e-12)


def test_the_directivity_is_the_rayleigh_integral_at_0p2_m_within_0p005() -> None:
    angle = np.radians(np.arange(0, 86))
    points = 200 * np.column_stack([np.sin(angle), np.zeros(86), np.cos(angle)])
    pressure = np.abs(acoustics.rayleigh_pressure(points, WAVENUMBER, RADIUS_MM))
    expected = np.abs(acoustics.directivity(KR * np.sin(angle)))
    assert np.max(np.abs(pressure / pressure[0] - expected)) < 0.005


def test_the_pressure_on_the_disks_own_face_is_finite() -> None:
    """At a disk's centre it is 1 - exp(-j k R)."""
    found = acoustics.rayleigh_pressure(np.zeros((1, 3)), WAVENUMBER, RADIUS_MM)
    assert found[0] == pytest.approx(1 - np.exp(-1j * KR), abs=1e-12)


def test_a_point_behind_the_baffle_is_refused() -> None:
    with pytest.raises(ValueError, match="behind the baffle"):
        acoustics.rayleigh_pressure(np.array([[0.0, 0.0, -1.0]]), WAVENUMBER, RADIUS_MM)


def test_a_point_on_the_edge_is_refused() -> None:
    with pytest.raises(ValueError, match=r"too close to the edge of the disk of 6\.2 mm"):
        acoustics.rayleigh_pressure(np.array([[RADIUS_MM, 0.0, 0.0]]), WAVENUMBER, RADIUS_MM)


def test_the_directivity_is_one_ahead_and_zero_at_the_first_root_of_j1() -> None:
    np.testing.assert_allclose(acoustics.directivity(np.array([0.0, 3.8317059702])), [1.0, 0.0], atol=1e-9)


def test_no_maximum_lies_beyond_the_near_field() -> None:
    near_mm = acoustics.near_field_mm(WAVENUMBER, 40.0)
    z = np.linspace(near_mm, 100 * near_mm, 4000)
    pressure = acoustics.axial_pressure(z, WAVENUMBER, 40.0)
    assert pressure[0] == pytest.approx(2.0)
    assert np.all(np.diff(pressure) < 0)


def test_a_disk_of_less_than_half_a_wavelength_has_no_near_field() -> None:
    assert acoustics.near_field_mm(WAVENUMBER, 4.28) == 0.0
    z = np.linspace(0.01, 100.0, 4000)
    assert np.all(np.diff(acoustics.axial_pressure(z, WAVENUMBER, 4.28)) < 0)


@pytest.mark.parametrize("radius_mm", [3.0, 6.2, 60.0])
def test_the_far_law_holds_within_one_percent_from_the_far_field_on(radius_mm: float) -> None:
    far_mm = acoustics.far_field_mm(WAVENUMBER, radius_mm)
    z = np.array([0.9, 1.0, 1.1, 10.0]) * far_mm
    lack = 1 - acoustics.axial_pressure(z, WAVENUMBER, radius_mm) * 2 * z / (WAVENUMBER * radius_mm**2)
    assert lack[1] == pytest.approx(0.01, abs=1e-9)
    assert lack[0] > 0.01 > lack[2] > lack[3] > 0


def test_the_beam_of_the_papers_transducer_is_29_degrees_to_a_half_and_57_to_its_zero() -> None:
    half_rad, zero_rad = acoustics.half_angle_rad(4.56), acoustics.first_zero_rad(4.56)
    assert np.degrees([half_rad, zero_rad]) == pytest.approx([29.06, 57.17], abs=0.01)
    at = acoustics.directivity(4.56 * np.sin(np.array([half_rad, zero_rad])))
    np.testing.assert_allclose(at, [0.5, 0.0], atol=1e-9)


def test_a_disk_too_small_for_a_zero_fills_the_half_space() -> None:
    assert acoustics.first_zero_rad(3.8) == pytest.approx(np.pi / 2)
    assert acoustics.half_angle_rad(2.2) == pytest.approx(np.pi / 2)
