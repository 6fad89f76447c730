"""Optical points to cells, and the maps of each sense alone."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_messages.plan import MapField
from echolume_messages.types import OPTICAL_POINT, ULTRASONIC_POINT, OpticalSource, Provenance
from echolume_processing.hybrid.baselines import baselines, nearest, union
from echolume_processing.hybrid.grid import accumulate, gather

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


def test_one_absurd_height_spoils_no_other_cell() -> None:
    rng = np.random.default_rng(4)
    rows = [(x, y, z, OpticalSource.STEREO) for x, y, z in zip(*rng.uniform(0, 3, (3, 60)), strict=True)]
    one = accumulate(optical(rows), FIELD)
    two = accumulate(optical([*rows, (3.5, 0.5, 4e15, OpticalSource.STEREO)]), FIELD)
    np.testing.assert_array_equal(two.height_mm[:, :2], one.height_mm[:, :2])
    assert np.abs(two.height_mm - one.height_mm)[:, 2].max() < 1.0, "its neighbour is no slope, but a neighbour"
    np.testing.assert_array_equal(two.sigma_mm[:, :3], one.sigma_mm[:, :3])
    assert two.height_mm[0, 3] > 3.9e15


def stripes(height_mm: Callable[[np.ndarray, np.ndarray], np.ndarray], at_mm: float) -> np.ndarray:
    """One stripe in each column of cells, so far from its low side, on a surface."""
    x, y = (a.ravel() for a in np.meshgrid(np.arange(0.0, 20.0) + at_mm, np.arange(0.0, 20.0, 0.23) + 0.01))
    return optical([(*p, OpticalSource.STEREO) for p in zip(x, y, height_mm(x, y), strict=True)])


SQUARE = MapField(x_mm=(0.0, 20.0), y_mm=(0.0, 20.0), cell_mm=1.0)
MIDDLES = np.meshgrid(np.arange(0.5, 20.0), np.arange(0.5, 20.0))


@pytest.mark.parametrize("at_mm", [0.05, 0.3, 0.9])
@pytest.mark.parametrize(("slope_x", "slope_y"), [(0.0, 0.0), (0.6, 0.0), (-1.5, 0.4), (0.1, -0.9)])
def test_heights_are_those_at_the_centres_of_the_cells(at_mm: float, slope_x: float, slope_y: float) -> None:
    points = stripes(lambda x, y: 30 + slope_x * x + slope_y * y, at_mm)
    exact_mm = 30 + slope_x * MIDDLES[0] + slope_y * MIDDLES[1]
    assert np.abs(accumulate(points, SQUARE).height_mm - exact_mm).max() < 0.002 + 0.06 * abs(slope_y)
    off_mm = np.abs(gather(points, SQUARE).grid.height_mm - exact_mm).max()
    assert off_mm >= 0.9 * abs(slope_x * (at_mm - 0.5)) - 0.06 * abs(slope_y)


def test_a_step_stays_where_it_is() -> None:
    points = stripes(lambda x, y: np.where(x < 8, 5.0, 25.0), 0.1)
    np.testing.assert_allclose(accumulate(points, SQUARE).height_mm, np.where(MIDDLES[0] < 8, 5.0, 25.0), atol=1e-6)


def test_a_balls_flank_is_at_its_own_height() -> None:
    def ball(x: np.ndarray, y: np.ndarray) -> np.ndarray:
        return np.sqrt(np.maximum(14.0**2 - (x - 10) ** 2 - (y - 10) ** 2, 0))

    grid = accumulate(stripes(ball, 0.1), SQUARE)
    inside = np.hypot(MIDDLES[0] - 10, MIDDLES[1] - 10) < 11
    off_mm = np.abs(grid.height_mm - ball(*(m.clip(0.2, 19.8) for m in MIDDLES)))[inside]
    assert off_mm.max() < 0.12
    assert np.median(off_mm) < 0.02


@pytest.mark.parametrize("rise_mm", [2.3, 20.0])
def test_a_step_beside_a_shadow_is_no_slope(rise_mm: float) -> None:
    points = stripes(lambda x, y: np.where(x < 8, 5.0, 5.0 + rise_mm), 0.1)
    points = points[(points["x_mm"] < 9) | (points["x_mm"] > 13)]
    height_mm = accumulate(points, SQUARE).height_mm
    np.testing.assert_allclose(height_mm[:, :8], 5.0, atol=1e-6)
    np.testing.assert_allclose(height_mm[:, 8], 5.0 + rise_mm, atol=1e-6)


def test_a_flank_beside_a_shadow_goes_on() -> None:
    points = stripes(lambda x, y: 2.0 * x, 0.1)
    height_mm = accumulate(points[points["x_mm"] < 9], SQUARE).height_mm
    np.testing.assert_allclose(height_mm[:, :9], 2.0 * MIDDLES[0][:, :9], atol=2e-3)


@pytest.mark.parametrize(("columns", "rows"), [(1, 4), (4, 1), (1, 1)])
def test_a_field_may_be_one_cell_wide(columns: int, rows: int) -> None:
    field = MapField(x_mm=(0.0, columns), y_mm=(0.0, rows), cell_mm=1.0)
    points = optical([(0.1, 0.2, 5.0, OpticalSource.STEREO)])
    assert accumulate(points, field).height_mm.ravel()[0] == 5.0
    assert np.isnan(accumulate(points[:0], field).height_mm).all()


def test_stereo_points_do_not_count_beside_the_active_ones_that_they_are_made_of() -> None:
    places = [(0.5, 0.1 * k, 10.0) for k in range(1, 9)]
    both = [(*p, s) for p in places for s in (OpticalSource.ACTIVE_LEFT, OpticalSource.ACTIVE_RIGHT)]
    alone = accumulate(optical(both), FIELD).sigma_mm[0, 0]
    with_stereo = accumulate(optical([*both, *((*p, OpticalSource.STEREO) for p in places)]), FIELD)
    assert with_stereo.sigma_mm[0, 0] == alone
    assert with_stereo.count[0, 0] == 24
    only = accumulate(optical([(*p, OpticalSource.STEREO) for p in places]), FIELD).sigma_mm[0, 0]
    assert only == pytest.approx(1.2533 * 0.05 / np.sqrt(8))


def test_no_points_make_an_empty_grid() -> None:
    assert np.isnan(accumulate(np.zeros(0, dtype=OPTICAL_POINT), FIELD).height_mm).all()


HEIGHTS_MM = {
    "scattered": np.linspace(-30, 30, 977),
    "tied": np.array([0.0, 0.5, 0.5, 1.0]),
    "absurd": np.array([0.0, 1.0, 4e15, -4e15, 9e9, -1e12, np.nan, np.inf]),
}


def median_of(values: list[int]) -> float:
    """Of whole numbers as numpy's 64 bits hold them: too large ones wrap around."""
    ordered = np.sort(np.array(values, dtype=np.int64))
    return 0.5 * float(ordered[(ordered.size - 1) // 2] + ordered[ordered.size // 2])


@pytest.mark.parametrize("kind", HEIGHTS_MM)
@pytest.mark.parametrize("number", [1, 2, 30, 5000])
def test_every_cell_has_what_its_points_say_one_cell_at_a_time(kind: str, number: int) -> None:
    rng = np.random.default_rng(number)
    points = np.zeros(number, dtype=OPTICAL_POINT)
    points["x_mm"], points["y_mm"] = rng.uniform(0, 4, number), rng.uniform(0, 3, number)
    points["z_mm"], points["sigma_z_mm"] = rng.choice(HEIGHTS_MM[kind], number), rng.uniform(0, 0.3, number)
    points["source"] = rng.integers(1, 4, number)
    made = gather(points, FIELD)
    grid = made.grid
    for j, i in np.ndindex(FIELD.shape):
        there = points[(points["y_mm"] // 1 == j) & (points["x_mm"] // 1 == i) & np.isfinite(points["z_mm"])]
        assert grid.count[j, i] == there.size
        if not there.size:
            assert np.isnan([grid.height_mm[j, i], grid.sigma_mm[j, i]]).all()
            assert not made.aside_mm[:, j, i].any()
            continue
        steps, own = (np.rint(there[name] * np.float64(1000)).astype(np.int64) for name in ("z_mm", "sigma_z_mm"))
        median = median_of(steps.tolist())
        off = 0.5 * median_of(np.abs(2 * steps - np.int64(2 * median)).tolist())
        stereo = int((there["source"] == OpticalSource.STEREO).sum())
        spread_mm = max(off * 1.4826 / 1000, median_of(own.tolist()) / 1000)
        assert grid.height_mm[j, i] == median / 1000
        assert grid.sigma_mm[j, i] == max(0.01, 1.2533 * spread_mm / np.sqrt(max(stereo, there.size - stereo)))
        for axis, (name, middle_mm) in enumerate((("x_mm", i + 0.5), ("y_mm", j + 0.5))):
            total = np.rint(there[name] * np.float64(1000)).sum()
            assert made.aside_mm[axis, j, i] == total / (there.size * 1000) - middle_mm


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
