"""Optical points to cells, and the maps of each sense alone."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_messages.plan import MapField
from echolume_messages.types import OPTICAL_POINT, ULTRASONIC_POINT, OpticalSource, Provenance
from echolume_processing.hybrid.baselines import baselines, nearest, union
from echolume_processing.hybrid.grid import accumulate

FIELD = MapField(x_mm=(0.0, 4.0), y_mm=(0.0, 3.0), cell_mm=1.0)


def optical(rows: list[tuple[float, float, float, OpticalSource]]) -> np.ndarray:
    points = np.zeros(len(rows), dtype=OPTICAL_POINT)
    for k, (x, y, z, source) in enumerate(rows):
        points[k] = (x, y, z, 0.05, source, 0, 0)
    return points


def test_a_cell_takes_the_median_and_names_its_sources() -> None:
    grid = accumulate(
        optical(
            [
                (1.5, 2.5, 10.0, OpticalSource.STEREO),
                (1.4, 2.4, 10.2, OpticalSource.ACTIVE_LEFT),
                (1.6, 2.6, 99.0, OpticalSource.ACTIVE_LEFT),
            ]
        ),
        FIELD,
    )
    assert grid.height_mm[2, 1] == np.float64(10.2)
    assert grid.count[2, 1] == 3
    assert grid.provenance[2, 1] == Provenance.STEREO | Provenance.ACTIVE_LEFT
    assert np.isnan(grid.height_mm[0, 0])
    assert grid.provenance[0, 0] == Provenance.NONE


def test_points_outside_the_field_and_points_without_a_height_are_left_out() -> None:
    grid = accumulate(
        optical(
            [
                (-0.1, 1.0, 5.0, OpticalSource.STEREO),
                (4.0, 1.0, 5.0, OpticalSource.STEREO),
                (1.0, 1.0, float("nan"), OpticalSource.STEREO),
            ]
        ),
        FIELD,
    )
    assert grid.count.sum() == 0


def test_one_absurd_height_leaves_the_other_cells_as_they_are() -> None:
    rng = np.random.default_rng(4)
    rows = [(x, y, z, OpticalSource.STEREO) for x, y, z in zip(*rng.uniform(0, 3, (3, 60)), strict=True)]
    one = accumulate(optical(rows), FIELD)
    two = accumulate(optical([*rows, (3.5, 0.5, 4e15, OpticalSource.STEREO)]), FIELD)
    np.testing.assert_array_equal(two.height_mm[:, :3], one.height_mm[:, :3])
    np.testing.assert_array_equal(two.sigma_mm[:, :3], one.sigma_mm[:, :3])
    assert two.height_mm[0, 3] > 3.9e15


def test_no_points_make_an_empty_grid() -> None:
    assert np.isnan(accumulate(np.zeros(0, dtype=OPTICAL_POINT), FIELD).height_mm).all()


@settings(max_examples=40, deadline=None)
@given(st.data())
def test_the_order_of_arrival_does_not_change_a_bit(data: st.DataObject) -> None:
    seed = data.draw(st.integers(0, 2**16))
    rng = np.random.default_rng(seed)
    points = np.zeros(60, dtype=OPTICAL_POINT)
    points["x_mm"], points["y_mm"] = rng.uniform(-1, 5, 60), rng.uniform(-1, 4, 60)
    points["z_mm"], points["sigma_z_mm"] = rng.normal(10, 3, 60), rng.uniform(0.01, 0.2, 60)
    points["source"] = rng.integers(1, 4, 60)
    order = rng.permutation(60)
    one, two = accumulate(points, FIELD), accumulate(points[order], FIELD)
    for name in ("height_mm", "sigma_mm", "count", "provenance"):
        assert getattr(one, name).tobytes() == getattr(two, name).tobytes()
    sound = np.zeros(0, dtype=ULTRASONIC_POINT)
    assert union(points, sound, FIELD).tobytes() == union(points[order], sound, FIELD).tobytes()


def test_the_union_is_the_mean_of_all_points_in_a_cell() -> None:
    sound = np.zeros(1, dtype=ULTRASONIC_POINT)
    sound["x_mm"], sound["y_mm"], sound["z_mm"] = 1.5, 2.5, 30.0
    light = optical([(1.5, 2.5, 0.0, OpticalSource.STEREO)])
    assert baselines(light, sound, FIELD).union_mm[2, 1] == np.float64(15.0)


def test_sound_alone_claims_the_nearest_contact_point_within_reach() -> None:
    field = MapField(x_mm=(0.0, 60.0), y_mm=(0.0, 1.0), cell_mm=1.0)
    sound = np.zeros(1, dtype=ULTRASONIC_POINT)
    sound["x_mm"], sound["y_mm"], sound["z_mm"] = 0.5, 0.5, 7.0
    image = nearest(sound, field)
    assert image[0, 19] == np.float64(7.0)
    assert np.isnan(image[0, 21])
