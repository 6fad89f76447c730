"""From the ultrasonic cloud to gray-level images and back to 3D."""

import numpy as np
import pytest

from echolume_processing.ultrasonic import image


def scan(pitch_mm: float = 5.0) -> np.ndarray:
    """A raster over a block 60 x 40 mm, 30 mm high."""
    x, y = np.meshgrid(np.arange(-60, 61, pitch_mm), np.arange(-50, 51, pitch_mm))
    z = np.where((np.abs(x) < 30) & (np.abs(y) < 20), 30.0, 0.0)
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def test_nearest_interpolation_invents_no_heights():
    points = scan()
    heights = image.interpolate_nearest(points, image.raster_over(points, 1.0))
    assert heights.shape == (101, 121)
    assert set(np.unique(heights)) == {0.0, 30.0}


def test_linear_interpolation_reproduces_a_slope():
    points = scan()
    points[:, 2] = 0.1 * points[:, 0] - 0.2 * points[:, 1]
    raster = image.raster_over(points, 1.0)
    x, y = np.moveaxis(raster.centres(), -1, 0)
    np.testing.assert_allclose(image.interpolate_linear(points, raster, 5.0), 0.1 * x - 0.2 * y, atol=0.05)


def test_gray_levels_carry_heights_to_half_a_level():
    heights = np.linspace(-5, 46, 300).reshape(10, 30)
    scale = image.gray_scale_of(heights)
    assert scale.resolution_mm == pytest.approx(0.2)
    assert np.abs(scale.heights(scale.image(heights)) - heights).max() <= 0.1001


def test_filters_smooth_sharpen_and_divide():
    points = scan()
    gray = image.gray_scale_of(points[:, 2]).image(image.interpolate_nearest(points, image.raster_over(points, 1.0)))
    smooth = image.gaussian(gray, 3.0)
    sharp = image.unsharp(smooth, 3.0)
    steepest = [int(np.abs(np.diff(i.astype(int), axis=1)).max()) for i in (smooth, sharp, gray)]
    assert steepest[0] < steepest[1] < steepest[2]
    np.testing.assert_array_equal(image.threshold(gray), gray)
    np.testing.assert_array_equal(image.threshold(smooth, 128) > 0, smooth > 128)


def test_hough_edges_come_back_to_3d_on_the_block():
    points = scan()
    raster = image.raster_over(points, 1.0)
    heights = image.interpolate_nearest(points, raster)
    gray = image.gray_scale_of(heights).image(heights)
    segments = image.edge_segments(image.gaussian(gray, 1.0), min_length_px=25)
    edges = image.segments_to_rig(segments, heights, raster)
    assert len(edges) >= 4
    directions = edges[:, 1, :2] - edges[:, 0, :2]
    upright = np.abs(directions[:, 0]) < 2
    assert np.abs(np.abs(edges[upright, :, 0]) - 27.5).max() < 2.0
    assert np.abs(np.abs(edges[~upright, :, 1]) - 17.5).max() < 2.0
    assert np.median(edges[..., 2]) == pytest.approx(30.0)


def turned_block(turn_rad: float, shift_mm: np.ndarray, seed: int) -> np.ndarray:
    """A raster of 5 mm over a block 80 x 60 mm, 30 mm high, turned and shifted, heights with 0.1 mm of noise."""
    x, y = np.meshgrid(np.arange(-80, 81, 5.0), np.arange(-80, 81, 5.0))
    u, v = on_block(np.stack([x, y], axis=-1), turn_rad, shift_mm)
    z = np.where((np.abs(u) < 40) & (np.abs(v) < 30), 30.0, 0.0) + np.random.default_rng(seed).normal(0, 0.1, x.shape)
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def on_block(xy: np.ndarray, turn_rad: float, shift_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    dx, dy = np.moveaxis(xy - shift_mm, -1, 0)
    return np.cos(turn_rad) * dx + np.sin(turn_rad) * dy, np.cos(turn_rad) * dy - np.sin(turn_rad) * dx


def test_errors_of_edges_are_as_large_as_their_sigmas_say():
    across, up, sides = [], [], set()
    for seed in range(24):
        rng = np.random.default_rng(seed)
        turn_rad, shift_mm = (0.0 if seed % 4 == 0 else rng.uniform(-0.6, 0.6)), rng.uniform(-3, 3, 2)
        points = turned_block(turn_rad, shift_mm, seed)
        raster = image.raster_over(points, 1.0)
        heights = image.interpolate_nearest(points, raster)
        gray = image.gaussian(image.gray_scale_of(heights).image(heights), 1.5)
        segments = image.edge_segments(gray, min_length_px=25, max_gap_px=8)
        edges = image.edges_in_rig(segments, heights, raster, image.spacing_mm(points), 0.1)
        for edge in edges:
            u, v = on_block(edge.ends_mm[:, :2], turn_rad, shift_mm)
            offs = (u - 40, u + 40, v - 30, v + 30)
            side = min(range(4), key=lambda k: np.abs(offs[k]).max())
            sides.add((seed, side))
            across.extend(offs[side] / edge.sigma_across_mm)
            up.append((edge.ends_mm[0, 2] - 30) / np.sqrt(edge.covariance_mm2[0, 2, 2]))
            assert edge.step_mm == pytest.approx(30, abs=1)
    assert len(sides) >= 0.9 * 4 * 24
    assert 0.7 < np.sqrt(np.mean(np.square(across))) < 1.3
    assert 0.5 < np.sqrt(np.mean(np.square(up))) < 1.5


def test_a_segment_on_level_ground_is_no_edge():
    points = scan()
    points[:, 2] = np.random.default_rng(0).normal(0, 0.1, len(points))
    raster = image.raster_over(points, 1.0)
    heights = image.interpolate_nearest(points, raster)
    assert image.edges_in_rig(np.array([[20.0, 20.0, 20.0, 80.0]]), heights, raster, 5.0, 0.1) == []


def test_natural_neighbours_reproduce_a_slope_within_a_tenth_of_its_rise_per_pixel():
    rng = np.random.default_rng(1)
    points = np.column_stack([rng.uniform(-50, 50, (400, 2)), np.zeros(400)])
    points[:, 2] = 0.3 * points[:, 0] - 0.2 * points[:, 1]
    raster = image.Raster(-35.0, -35.0, 1.0, 71, 71)
    x, y = np.moveaxis(raster.centres(), -1, 0)
    error = image.interpolate_natural(points, raster) - (0.3 * x - 0.2 * y)
    assert np.sqrt(np.mean(error**2)) < 0.1 * np.hypot(0.3, 0.2)


def test_natural_neighbours_pass_through_points_and_weigh_four_corners_alike():
    x, y = np.meshgrid(np.arange(0, 41, 10.0), np.arange(0, 41, 10.0))
    z = np.random.default_rng(2).uniform(0, 30, x.shape)
    points = np.column_stack([x.ravel(), y.ravel(), z.ravel()])
    heights = image.interpolate_natural(points, image.raster_over(points, 1.0))
    np.testing.assert_allclose(heights[::10, ::10], z, atol=1e-9)
    middles = 0.25 * (z[1:, 1:] + z[1:, :-1] + z[:-1, 1:] + z[:-1, :-1])
    np.testing.assert_allclose(heights[5::10, 5::10], middles, rtol=0.02)


def test_every_interpolation_stays_within_the_heights_of_its_points():
    rng = np.random.default_rng(3)
    points = np.column_stack([rng.uniform(-40, 40, (200, 2)), rng.uniform(5, 25, 200)])
    raster = image.raster_over(points, 1.0)
    for name, interpolate in image.INTERPOLATIONS.items():
        heights = interpolate(points, raster)
        assert heights.shape == (raster.rows, raster.columns), name
        assert heights.dtype == np.float64
        assert points[:, 2].min() - 1e-9 <= heights.min() <= heights.max() <= points[:, 2].max() + 1e-9, name


def test_linear_interpolation_between_scattered_points_is_exact_on_a_plane():
    rng = np.random.default_rng(4)
    points = np.column_stack([rng.uniform(-50, 50, (300, 2)), np.zeros(300)])
    points[:, 2] = 5 + 0.3 * points[:, 0] - 0.2 * points[:, 1]
    raster = image.Raster(-30.0, -30.0, 0.7, 80, 80)
    x, y = np.moveaxis(raster.centres(), -1, 0)
    np.testing.assert_allclose(image.interpolate_delaunay(points, raster), 5 + 0.3 * x - 0.2 * y, atol=1e-9)


def test_gray_levels_take_a_chosen_resolution_or_say_which_would_do():
    heights = np.linspace(-5, 46, 300).reshape(10, 30)
    scale = image.gray_scale_from(heights, 0.25)
    assert scale.resolution_mm == pytest.approx(0.25)
    assert scale.image(heights).max() == 204
    with pytest.raises(ValueError, match=r"take 0\.200 mm or more"):
        image.gray_scale_from(heights, 0.1)


@pytest.mark.parametrize("interpolate", [image.interpolate_delaunay, image.interpolate_natural])
def test_clouds_that_span_no_surface_are_refused(interpolate):
    raster = image.Raster(0.0, 0.0, 1.0, 10, 10)
    with pytest.raises(ValueError, match="has 2 points; a surface needs 3"):
        interpolate(np.zeros((2, 3)), raster)
    row = np.column_stack([np.arange(9.0), 2 * np.arange(9.0), np.ones(9)])
    with pytest.raises(ValueError, match="lie in one row"):
        interpolate(row, raster)


def test_an_empty_cloud_is_refused_with_what_to_check():
    with pytest.raises(ValueError, match="the cloud is empty"):
        image.raster_over(np.zeros((0, 3)), 1.0)
    with pytest.raises(ValueError, match="the cloud is empty"):
        image.interpolate_nearest(np.zeros((0, 3)), image.Raster(0.0, 0.0, 1.0, 4, 4))
    with pytest.raises(ValueError, match="larger pixel"):
        image.raster_over(np.array([[0.0, 0.0, 0.0], [1e6, 1e6, 0.0]]), 0.1)
