"""Planes from what pings met one by one."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_processing.hybrid.heard import Heard, seeds
from echolume_processing.hybrid.plates import Plane

NOISE_MM, NOISE_RAD = 0.06, 0.004


def met(
    plane: Plane, x_mm: tuple[float, float], y_mm: tuple[float, float], seed: int = 1
) -> tuple[np.ndarray, np.ndarray]:
    """Contacts every 10 mm on a plane, with noise in height and normal."""
    rng = np.random.default_rng(seed)
    x, y = (a.ravel() for a in np.meshgrid(np.arange(*x_mm, 10.0), np.arange(*y_mm, 10.0)))
    place = np.column_stack((x, y, plane.at(x, y) + NOISE_MM * rng.normal(size=x.size)))
    normal = np.array([-plane.slope_x, -plane.slope_y, 1.0]) + NOISE_RAD * rng.normal(size=(x.size, 3))
    return place, normal / np.linalg.norm(normal, axis=1)[:, None]


def heard_of(*parts: tuple[np.ndarray, np.ndarray]) -> Heard:
    return Heard(np.concatenate([p for p, _ in parts]), np.concatenate([n for _, n in parts]))


@pytest.mark.parametrize("slope", [(0.0, 0.0), (0.176, 0.0), (-0.09, 0.3)])
def test_a_tilted_plane_is_recovered_from_its_contacts(slope: tuple[float, float]) -> None:
    plane = Plane(0.0, 0.0, 30.0, *slope)
    found = heard_of(met(plane, (-40, 41), (-30, 31)))
    (seed,) = seeds(found, np.arange(len(found.place_mm)))
    assert seed.which.size == len(found.place_mm)
    assert abs(seed.plane.at(np.array([0.0]), np.array([0.0]))[0] - 30.0) < 0.05
    assert np.hypot(seed.plane.slope_x - slope[0], seed.plane.slope_y - slope[1]) < 0.002
    assert 0.3 * NOISE_MM < seed.spread_mm < 2 * NOISE_MM


def test_two_planes_side_by_side_are_two_seeds_the_larger_first() -> None:
    low, high = Plane(0.0, 0.0, 15.0), Plane(0.0, 0.0, 35.0)
    found = heard_of(met(low, (-60, -5), (-30, 31), 1), met(high, (0, 31), (-30, 31), 2))
    first, second = seeds(found, np.arange(len(found.place_mm)))
    assert first.which.size == 42
    assert second.which.size == 28
    assert abs(first.plane.z_mm - 15.0) < 0.05
    assert abs(second.plane.z_mm - 35.0) < 0.05


def test_scattered_contacts_are_no_plane() -> None:
    rng = np.random.default_rng(4)
    place = rng.uniform((-40, -40, 0), (40, 40, 40), (20, 3))
    normal = rng.normal((0, 0, 1), 0.2, (20, 3))
    found = Heard(place, normal / np.linalg.norm(normal, axis=1)[:, None])
    assert all(seed.which.size <= 4 for seed in seeds(found, np.arange(20)))


def test_pings_that_met_nothing_have_no_say() -> None:
    place, normal = met(Plane(0.0, 0.0, 20.0), (-30, 31), (-30, 31))
    place[::5] = np.nan
    (seed,) = seeds(Heard(place, normal), np.arange(len(place)))
    assert not np.isin(np.arange(0, len(place), 5), seed.which).any()
    assert seeds(Heard(place, normal), np.arange(0, len(place), 5)) == []


def test_planes_that_do_not_hang_together_are_found_one_by_one() -> None:
    plane = Plane(0.0, 0.0, 25.0)
    found = heard_of(met(plane, (-80, -39), (-20, 21), 1), met(plane, (40, 81), (-20, 21), 2))
    assert len(seeds(found, np.arange(len(found.place_mm)))) == 2
