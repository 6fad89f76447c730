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
