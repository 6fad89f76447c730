"""The paper's transducer: equations 5 to 9, figure 6 and Table I."""

import numpy as np
import pytest

from echolume_processing.ultrasonic import acoustics

WAVENUMBER = 2 * np.pi / 8.58
RADIUS_MM = 6.2


def test_the_rayleigh_integral_equals_the_axial_pressure_on_the_axis():
    z = np.array([3.0, 10.0, 40.0, 200.0, 1000.0])
    on_axis = np.column_stack([np.zeros((5, 2)), z])
    pressure = np.abs(acoustics.rayleigh_pressure(on_axis, WAVENUMBER, RADIUS_MM))
    np.testing.assert_allclose(pressure, acoustics.axial_pressure(z, WAVENUMBER, RADIUS_MM), atol=1e-9)


def test_the_directivity_is_the_rayleigh_integral_at_0p2_m_within_0p005():
    angle = np.radians(np.arange(0, 86))
    points = 200 * np.column_stack([np.sin(angle), np.zeros(86), np.cos(angle)])
    pressure = np.abs(acoustics.rayleigh_pressure(points, WAVENUMBER, RADIUS_MM))
    expected = np.abs(acoustics.directivity(WAVENUMBER * RADIUS_MM * np.sin(angle)))
    assert np.max(np.abs(pressure / pressure[0] - expected)) < 0.005


def test_the_directivity_is_one_ahead_and_zero_at_the_first_root_of_j1():
    np.testing.assert_allclose(acoustics.directivity(np.array([0.0, 3.8317059702])), [1.0, 0.0], atol=1e-9)


def test_a_known_gaussian_is_recovered():
    angle = np.radians(np.linspace(-45, 45, 91))
    fit = acoustics.fit_gaussian(angle, 0.97 * np.exp(-((angle - 0.03) ** 2) / 0.31**2))
    assert (fit.a, fit.b_rad, fit.c_rad) == pytest.approx((0.97, 0.03, 0.31), abs=1e-6)


def test_the_angle_comes_back_from_the_energy():
    fit = acoustics.GaussianFit(1.0, 0.0, 0.32)
    assert acoustics.angle_from_energy(float(np.exp(-((0.2 / 0.32) ** 2))), fit) == pytest.approx(0.2)


def test_one_physical_radius_reproduces_table_1():
    wavenumber_radius, rms_deg = acoustics.fit_table()
    assert wavenumber_radius == pytest.approx(4.56, abs=0.02)
    assert rms_deg == pytest.approx(0.95, abs=0.02)


def test_the_energy_of_a_perpendicular_plate_is_largest_and_symmetric():
    angle = np.radians(np.linspace(-45, 45, 91))
    energy = acoustics.plate_energy(angle, 400.0, 100.0, 4.56)
    assert np.argmax(energy) == 45
    np.testing.assert_allclose(energy, energy[::-1], atol=1e-12)
