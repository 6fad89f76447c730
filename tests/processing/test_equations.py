"""The paper's nine equations, each against an answer worked out by hand, and the triangulation of its figure 5."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from echolume_processing.optical import triangulate
from echolume_processing.ultrasonic import acoustics, contact, envelope, plate_energy
from echolume_processing.ultrasonic.table_one import TABLE_I

Triangulation = Callable[..., np.ndarray]

LEFT = np.array([[2.0, 0.0, 0.0, 10.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]])
"""A camera of focal length 2 whose image of (X, Y, Z) is ((2 X + 10) / (Z + 4), 2 Y / (Z + 4))."""
RIGHT = np.array([[2.0, 0.0, 0.0, -10.0], [0.0, 2.0, 0.0, 0.0], [0.0, 0.0, 1.0, 4.0]])
POINT = np.array([[3.0, 2.0, 4.0]])
LEFT_PX, RIGHT_PX = np.array([[2.0, 0.5]]), np.array([[-0.5, 0.5]])
"""Images of the point: (16 / 8, 4 / 8) and (-4 / 8, 4 / 8)."""

WAVENUMBER = 2 * np.pi / 8.0
RADIUS_MM = 10.0
ANGLE_RAD = np.radians(np.linspace(-45, 45, 91))


def test_equation_1_has_two_rows_a_camera_and_the_point_in_its_kernel() -> None:
    a = triangulate.stereo_system(LEFT, RIGHT, LEFT_PX, RIGHT_PX)[0]
    by_hand = [[-2.0, 0.0, 2.0, -2.0], [0.0, -2.0, 0.5, 2.0], [-2.0, 0.0, -0.5, 8.0], [0.0, -2.0, 0.5, 2.0]]
    assert a.tolist() == by_hand
    assert (a @ [3.0, 2.0, 4.0, 1.0]).tolist() == [0.0, 0.0, 0.0, 0.0]


@pytest.mark.parametrize("triangulated", [triangulate.stereo_eigen, triangulate.stereo])
def test_equation_2_divides_the_least_eigenvector_by_its_fourth_component(triangulated: Triangulation) -> None:
    found = triangulated(LEFT, RIGHT, LEFT_PX, RIGHT_PX)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, POINT, atol=1e-9)


def test_equations_3_and_4_give_the_point_where_the_ray_meets_the_plane_x_equals_d() -> None:
    np.testing.assert_allclose(triangulate.active_x_plane(LEFT, LEFT_PX, 3.0), POINT, atol=1e-12)
    np.testing.assert_allclose(triangulate.active_x_plane(RIGHT, RIGHT_PX, 3.0), POINT, atol=1e-12)


def test_equation_4_solves_the_system_of_equation_3() -> None:
    """-m12 y - m13 z + u alpha = m11 d + m14, and so on, with alpha = m3 . (d, y, z, 1)."""
    d, (y, z), (u, v) = 3.0, (2.0, 4.0), (2.0, 0.5)
    a = np.array([[-0.0, -0.0, u], [-2.0, -0.0, v], [-0.0, -1.0, 1.0]])
    b = np.array([[2.0, 10.0], [0.0, 0.0], [0.0, 4.0]])
    np.testing.assert_allclose(np.linalg.solve(a, b @ [d, 1.0]), [y, z, z + 4.0], atol=1e-12)
    np.testing.assert_allclose(triangulate.active_x_plane(LEFT, np.array([[u, v]]), d), [[d, y, z]], atol=1e-12)


def test_equation_5_far_away_is_the_wave_of_a_point_source_of_the_disks_area() -> None:
    far_mm = 1e5
    p = acoustics.rayleigh_pressure(np.array([[0.0, 0.0, far_mm]]), WAVENUMBER, RADIUS_MM)
    point = 1j * WAVENUMBER / (2 * np.pi) * np.pi * RADIUS_MM**2 * np.exp(-1j * WAVENUMBER * far_mm) / far_mm
    assert p.dtype == np.complex128
    assert p[0] == pytest.approx(point, rel=1e-3)


def test_equation_5_before_the_disks_centre_is_the_wave_of_the_centre_less_that_of_the_edge() -> None:
    """On the axis the integral is exp(-j k z) - exp(-j k sqrt(z^2 + R^2))."""
    z_mm = 7.5  # sqrt(7.5^2 + 10^2) = 12.5
    expected = np.exp(-1j * WAVENUMBER * z_mm) - np.exp(-1j * WAVENUMBER * 12.5)
    assert acoustics.rayleigh_pressure(np.array([[0.0, 0.0, z_mm]]), WAVENUMBER, RADIUS_MM)[0] == pytest.approx(
        expected
    )


def test_equation_6_is_two_at_the_last_maximum_and_falls_with_the_distance_beyond() -> None:
    last_mm = acoustics.near_field_mm(WAVENUMBER, RADIUS_MM)
    assert last_mm == pytest.approx(100.0 / 8.0 - 8.0 / 4.0)
    far_mm = 1e5
    found = acoustics.axial_pressure(np.array([last_mm, far_mm]), WAVENUMBER, RADIUS_MM)
    np.testing.assert_allclose(found, [2.0, WAVENUMBER * RADIUS_MM**2 / (2 * far_mm)], rtol=1e-6)


def test_equation_7_is_twice_the_tabulated_j1_over_its_argument() -> None:
    tabulated = np.array([0.4400505857, 0.5767248078, -0.3275791376])  # J1 at 1, 2 and 5
    found = acoustics.directivity(np.array([0.0, 1.0, 2.0, 5.0, -5.0]))
    np.testing.assert_allclose(found, [1.0, *(2 * tabulated / [1, 2, 5]), 2 * tabulated[2] / 5], atol=1e-10)


def test_equation_8_of_a_dying_exponential_is_half_its_time_constant() -> None:
    rate_hz, tau_s = 1e6, 1e-3
    dying = np.exp(-(np.arange(20_000) + 0.5) / rate_hz / tau_s)
    found = envelope.energy(np.stack([dying, 2 * dying]).astype(np.float32), rate_hz)
    assert found.dtype == np.float64
    np.testing.assert_allclose(found, [tau_s / 2, 2 * tau_s], rtol=1e-5)


@pytest.mark.parametrize("row", TABLE_I)
def test_equation_9_is_recovered_from_its_own_curve_for_every_row_of_table_1(row: tuple[float, ...]) -> None:
    _, _, a, b_deg, c_deg = row
    b_rad, c_rad = np.radians(b_deg), np.radians(c_deg)
    fit = plate_energy.fit_gaussian(ANGLE_RAD, a * np.exp(-((ANGLE_RAD - b_rad) ** 2) / c_rad**2))
    assert (fit.a, fit.b_rad, fit.c_rad) == pytest.approx((a, b_rad, c_rad), abs=1e-6)


def test_in_figure_5_two_receivers_beside_an_emitter_find_the_contact_points_of_a_turned_plate() -> None:
    """The plate passes 200 mm in front of the emitter and turns from -45 to 45 degrees."""
    receivers = np.array([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    for angle_rad in ANGLE_RAD:
        normal = np.array([np.sin(angle_rad), 0.0, np.cos(angle_rad)])
        distance_mm = 200.0 * np.cos(angle_rad)
        paths = np.linalg.norm(receivers - 2 * distance_mm * normal, axis=1)
        plane = contact.fit_plane(receivers, paths, np.array([True, True]))
        assert plane is not None
        points = contact.plane_contacts(plane, receivers)
        np.testing.assert_allclose(points @ normal, distance_mm, atol=1e-9)
        ways = np.linalg.norm(points, axis=1) + np.linalg.norm(points - receivers, axis=1)
        np.testing.assert_allclose(ways, paths, atol=1e-9)
