"""Energy over a plate's angle: equation 9, figure 6, Table I, and the cross-talk that its first row asks for."""

from __future__ import annotations

from functools import lru_cache

import numpy as np
import pytest
from scipy import signal

from echolume_processing.ultrasonic import plate_energy, table_one
from echolume_processing.ultrasonic.cross_talk import CrossTalk
from echolume_processing.ultrasonic.table_one import ANGLES_RAD, TABLE_I, TableFit

CARRIER_HZ, RATE_HZ, SPEED_MM_PER_S = 40_000.0, 1e6, 343_200.0


@lru_cache
def fits() -> tuple[TableFit, TableFit]:
    return table_one.fit_table(), table_one.fit_table_with_cross_talk()


def test_a_known_gaussian_is_recovered() -> None:
    fit = plate_energy.fit_gaussian(ANGLES_RAD, 0.97 * np.exp(-((ANGLES_RAD - 0.03) ** 2) / 0.31**2))
    assert (fit.a, fit.b_rad, fit.c_rad) == pytest.approx((0.97, 0.03, 0.31), abs=1e-6)


def test_the_angle_comes_back_from_the_energy() -> None:
    fit = plate_energy.GaussianFit(1.0, 0.0, 0.32)
    energy = float(fit(np.array([0.2]))[0])
    assert plate_energy.angle_from_energy(energy, fit) == pytest.approx(0.2)


def test_the_energy_of_a_perpendicular_plate_is_largest_and_symmetric() -> None:
    energy = plate_energy.plate_energy(ANGLES_RAD, 400.0, 100.0, 4.56)
    assert np.argmax(energy) == 45
    np.testing.assert_allclose(energy, energy[::-1], atol=1e-12)


def test_the_paths_to_a_turned_plate_are_those_to_the_emitters_image() -> None:
    """At 45 degrees the image of (0, 0) in a plate through (0, 200) lies at (-200, 200)."""
    echoes = plate_energy.plate_echoes(np.array([np.pi / 4]), 200.0, 60.0, 4.56)
    expected = [[np.hypot(-30 + 200, 200)], [np.hypot(30 + 200, 200)]]
    np.testing.assert_allclose(echoes.paths_mm, expected, atol=1e-9)


def test_one_physical_radius_reproduces_table_1() -> None:
    plain, _ = fits()
    assert plain.wavenumber_radius == pytest.approx(4.56, abs=0.02)
    assert plain.rms_c_deg == pytest.approx(0.95, abs=0.02)
    assert plain.rms_c_without_row_1_deg == pytest.approx(0.58, abs=0.02)


def test_without_cross_talk_the_first_row_is_far_too_narrow() -> None:
    plain, _ = fits()
    assert plain.residuals_c_deg[0] == pytest.approx(-2.68, abs=0.05)


def test_one_level_of_cross_talk_widens_the_first_row_and_leaves_the_others_alone() -> None:
    plain, lifted = fits()
    assert abs(lifted.residuals_c_deg[0]) < 0.5
    assert lifted.rms_c_deg < 0.5
    assert lifted.rms_c_without_row_1_deg < plain.rms_c_without_row_1_deg
    without = np.array([g.c_rad for g in table_one.table_gaussians(lifted.wavenumber_radius)])
    with_talk = np.array([g.c_rad for g in lifted.gaussians])
    widened_deg = np.degrees(with_talk - without)
    assert widened_deg[0] > 2.5
    assert np.all(np.abs(widened_deg[1:]) < 0.6)
    assert np.all(np.abs(widened_deg[3:]) < 0.05)  # from 400 mm on there is none of it left


def test_the_other_eleven_rows_by_themselves_foretell_the_first() -> None:
    others = table_one.fit_table_with_cross_talk(rows=slice(1, None))
    assert others.cross_talk is not None
    assert others.cross_talk.level == pytest.approx(0.02, abs=0.003)
    assert abs(others.residuals_c_deg[0]) < 1.0


def test_set_up_offsets_are_one_a_distance() -> None:
    plain, _ = fits()
    np.testing.assert_allclose(plain.offsets_deg[::3], [1.043, -2.033, 3.167, 3.647], atol=1e-3)
    np.testing.assert_allclose(plain.residuals_b_deg.reshape(4, 3).sum(axis=1), 0, atol=1e-12)


def test_the_table_is_printed_row_by_row_with_residuals() -> None:
    lines = table_one.table_lines(*fits())
    assert len(lines) == 2 + len(TABLE_I)
    assert "21.20" in lines[2]
    assert "(-2.68)" in lines[2]


def rectified_energies(angles_rad: np.ndarray, level: float) -> np.ndarray:
    """The paper's chain on carriers: direct sound and echo, rectified, Butterworth, squared from the first echo on."""
    time_s = np.arange(12_000) / RATE_HZ
    ring = np.exp(-time_s * np.pi * CARRIER_HZ / 20.0)
    burst = np.convolve(np.convolve((time_s < 8 / CARRIER_HZ) * 1.0, ring)[:12_000], ring)[:12_000]
    echoes = plate_energy.plate_echoes(angles_rad, 200.0, 30.0, 4.63)
    low_pass = signal.butter(3, 1000.0, fs=RATE_HZ, output="sos")
    gate = round(echoes.paths_mm.min() / SPEED_MM_PER_S * RATE_HZ)
    total = np.zeros(angles_rad.shape)
    for (side, k), path_mm in np.ndenumerate(echoes.paths_mm):
        wave = np.zeros(12_000)
        for size, length_mm in ((echoes.amplitudes[side, k], path_mm), (level / 15.0, 15.0)):
            late_s = time_s - length_mm / SPEED_MM_PER_S
            wave += size * np.interp(late_s, time_s, burst, left=0.0) * np.sin(2 * np.pi * CARRIER_HZ * late_s)
        total[k] += np.sum(signal.sosfilt(low_pass, np.abs(wave))[gate:] ** 2)
    return total / total[0]


@pytest.mark.parametrize("level", [0.0, 0.019])
def test_energies_with_cross_talk_are_those_of_rectified_and_filtered_carriers(level: float) -> None:
    angles = np.radians([0.0, 10.0, 20.0, 30.0, 45.0])
    expected = plate_energy.plate_energy(angles, 200.0, 30.0, 4.63, CrossTalk(level))
    np.testing.assert_allclose(rectified_energies(angles, level), expected, atol=0.012)


def test_no_cross_talk_is_none_at_all() -> None:
    alone = plate_energy.plate_energy(ANGLES_RAD, 200.0, 30.0, 4.6)
    np.testing.assert_allclose(plate_energy.plate_energy(ANGLES_RAD, 200.0, 30.0, 4.6, CrossTalk(0.0)), alone)
