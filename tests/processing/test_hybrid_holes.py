"""Closing the optical surface."""

from __future__ import annotations

import numpy as np
import pytest
from scipy import ndimage

from echolume_messages.plan import MapField
from echolume_processing.hybrid.grid import OpticalGrid
from echolume_processing.hybrid.holes import close

FIELD = MapField(x_mm=(0.0, 60.0), y_mm=(0.0, 50.0), cell_mm=1.0)


def grid_of(height_mm: np.ndarray) -> OpticalGrid:
    seen = np.isfinite(height_mm)
    return OpticalGrid(
        FIELD, height_mm, np.where(seen, 0.1, np.nan), np.where(seen, 9, 0), np.where(seen, 1, 0).astype(np.uint8)
    )


def test_a_big_hole_is_absorbing_and_a_narrow_one_is_occluded() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[20:40, 30:50] = np.nan
    height_mm[5:10, 5:25] = np.nan
    closed = close(grid_of(height_mm))
    assert len(closed.absorbing) == 1
    assert closed.absorbing[0].sum() == 400
    assert closed.occluded.sum() == 100
    assert np.isfinite(closed.height_mm).all()


def test_a_shadow_beside_a_step_gets_the_lower_height() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[:, 20:30] = 25.0
    height_mm[:, 30:34] = np.nan
    closed = close(grid_of(height_mm))
    assert closed.occluded[:, 30:34].all()
    assert (closed.height_mm[:, 30:34] == 0.0).all()


def test_lone_points_on_a_black_surface_do_not_break_its_hole() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[15:40, 20:45] = np.nan
    height_mm[25, 30] = 77.0
    height_mm[31, 38] = -40.0
    closed = close(grid_of(height_mm))
    assert len(closed.absorbing) == 1
    assert closed.absorbing[0].sum() == 625


def test_beyond_the_optical_pass_the_bench_goes_on() -> None:
    height_mm = np.full(FIELD.shape, np.nan)
    height_mm[10:40, 10:50] = 3.0
    closed = close(grid_of(height_mm))
    assert closed.outside.sum() == FIELD.shape[0] * FIELD.shape[1] - 30 * 40
    assert (closed.height_mm[closed.outside] == 0.0).all()
    assert not closed.absorbing


def test_nothing_seen_is_no_hole() -> None:
    closed = close(grid_of(np.full(FIELD.shape, np.nan)))
    assert closed.outside.all()
    assert not closed.seen.any()


def test_a_strip_before_a_row_of_steps_gets_the_ground_before_them() -> None:
    height_mm = np.zeros(FIELD.shape)
    for step in range(3):
        height_mm[20:40, 20 + 8 * step : 28 + 8 * step] = 10.0 * (step + 1)
        height_mm[40 : 42 + 2 * step, 20 + 8 * step : 28 + 8 * step] = np.nan
    closed = close(grid_of(height_mm))
    assert (closed.height_mm[40:] == 0.0).all()


def test_a_small_hole_in_level_ground_may_be_a_pit_and_is_not_filled() -> None:
    height_mm = np.full(FIELD.shape, 20.0)
    height_mm[20:24, 30:34] = np.nan
    height_mm[10, 10] = np.nan
    closed = close(grid_of(height_mm))
    assert not closed.occluded[20:24, 30:34].any()
    assert not closed.seen[20:24, 30:34].any()
    assert closed.occluded[10, 10]


def test_beside_a_steep_flank_nothing_is_guessed() -> None:
    x_mm = np.arange(60) + 0.5
    dome_mm = np.sqrt(np.maximum(0.0, 20.0**2 - (x_mm - 30) ** 2))
    height_mm = np.tile(dome_mm, (50, 1))
    height_mm[:, 10:14] = np.nan
    closed = close(grid_of(height_mm))
    assert not closed.occluded[:, 10:14].any()
    height_mm[:, 14:46] = 20.0
    assert close(grid_of(height_mm)).occluded[:, 10:14].all()


def filled(height_mm: np.ndarray, seen: np.ndarray, holes: np.ndarray, wide: np.ndarray) -> np.ndarray:
    """Every hole's cells one by one, each against all of the hole's rim."""
    out = np.where(seen, height_mm, 0.0)
    labels, number = ndimage.label(holes, np.ones((3, 3)))
    for k in range(1, number + 1):
        inside = labels == k
        rim = np.argwhere(ndimage.binary_dilation(inside, np.ones((3, 3))) & seen)
        if not rim.size:
            continue
        depth = ndimage.distance_transform_edt(np.pad(inside, 1)).max()
        looked = 25.0 if (wide & inside).any() else 3.0
        for j, i in np.argwhere(inside):
            away2 = ((rim - (j, i)) ** 2).sum(axis=1)
            near = away2 <= max(2 * np.sqrt(away2.min()) + looked, 2 * depth + 3.0) ** 2
            heights_mm = height_mm[rim[:, 0], rim[:, 1]]
            low = near & (heights_mm <= heights_mm[near].min() + 1.0)
            out[j, i] = heights_mm[np.argmin(np.where(low, away2, np.inf))]
    return out


@pytest.mark.parametrize("seed", range(8))
def test_each_cell_of_a_hole_gets_the_nearest_of_the_low_rim_cells(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height_mm = np.round(rng.normal(0, 1.5, FIELD.shape)) + np.where(np.arange(60) < 30, 0.0, 12.0)
    for _ in range(6):
        (j, i), (rows, columns) = rng.integers(0, (50, 60)), rng.integers(1, 18, 2)
        height_mm[j : j + rows, i : i + columns] = np.nan
    height_mm[rng.random(FIELD.shape) < 0.02 * seed] = np.nan
    closed = close(grid_of(height_mm))
    holes = ~closed.seen & ~closed.outside
    wide = np.any([np.zeros(FIELD.shape, dtype=np.bool_), *closed.absorbing], axis=0)
    assert holes.any()
    np.testing.assert_array_equal(closed.height_mm, filled(height_mm, closed.seen, holes, wide))
