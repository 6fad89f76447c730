"""The speed of sound against published values, and from paths that are known."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_processing.ultrasonic.air import Air, humid_mps, speed_from_paths, speed_of_sound_mps, water_mole_fraction


@pytest.mark.parametrize(
    ("temperature_c", "humidity", "published_mps"),
    [(0, 0.0047, 331.51), (10, 0.602, 337.86), (20, 0.0079, 343.33), (20, 0.602, 344.17), (30, 0.989, 351.51)],
)
def test_humid_air_is_as_fast_as_in_cramers_figure_1(temperature_c: float, humidity: float, published_mps: float):
    assert humid_mps(Air(temperature_c, humidity, carbon_dioxide=314e-6)) == pytest.approx(published_mps, abs=0.1)


def test_humid_air_follows_the_ideal_gas_of_its_mixture():
    for temperature_c in (5.0, 20.0, 28.0):
        w = water_mole_fraction(Air(temperature_c, 0.6))
        # heat capacities in units of R: 3.5 for air, 4.0 for water; molar masses in kg/mol
        heat = 3.5 * (1 - w) + 4.0 * w
        mass = 0.028965 * (1 - w) + 0.018015 * w
        ideal = np.sqrt(heat / (heat - 1) * 8.314463 * (temperature_c + 273.15) / mass)
        assert humid_mps(Air(temperature_c, 0.6)) == pytest.approx(ideal, rel=1e-3)


def test_half_of_saturation_at_20_degrees_is_1_percent_of_water():
    assert water_mole_fraction(Air(20.0, 0.5)) == pytest.approx(0.0116, abs=1e-4)  # 2339 Pa over water, steam tables


def test_dry_air_agrees_with_the_simple_formula_within_0p1_percent():
    for temperature_c in (0.0, 15.0, 30.0):
        assert humid_mps(Air(temperature_c, 0.0)) == pytest.approx(speed_of_sound_mps(temperature_c), rel=1e-3)


def test_air_beyond_the_formula_is_refused():
    with pytest.raises(ValueError, match="0 to 30 degrees"):
        humid_mps(Air(45.0))


def test_the_speed_comes_back_from_known_paths_with_its_sigma():
    rng, scores = np.random.default_rng(1), []
    paths = np.array([15.0, 21.2, 300.4, 301.0, 400.0, 600.0])
    for _ in range(300):
        measured = paths / 345.1e3 + rng.normal(0, 1e-7, 6)
        found = speed_from_paths(measured, paths, np.full(6, 1e-7), np.zeros(6))
        scores.append(((found.mps - 345.1) / found.sigma_mps) ** 2)
    assert 0.8 < np.mean(scores) < 1.2


def test_a_common_delay_is_found_beside_the_speed():
    paths = np.array([100.0, 300.0, 500.0, np.nan])
    found = speed_from_paths(40e-6 + paths / 340e3, paths, np.full(4, 1e-7), np.full(4, 0.01), common_delay=True)
    assert found.mps == pytest.approx(340.0, abs=1e-6)
    assert found.chi_squared < 1e-6
    with pytest.raises(ValueError, match="different lengths"):
        speed_from_paths(paths[:1] / 340e3, paths[:1], np.ones(1), np.ones(1), common_delay=True)
