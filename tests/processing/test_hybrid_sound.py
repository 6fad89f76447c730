"""Sound alone: contact points beside their surface are told, slopes are followed, and sigmas know of rims."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated.scene import SceneBuilder
from echolume_messages.calibration import ArrayCalibration
from echolume_messages.plan import MapField
from echolume_messages.types import ULTRASONIC_POINT, EchoKind, Structured
from echolume_processing.hybrid.baselines import nearest, placed
from echolume_processing.hybrid.rules.sound import (
    CLEAN_MM,
    DOUBTFUL_MM,
    beside,
    carried_mm,
    disk,
    late_mm,
    rim_mm2,
    sigma_of,
    sound_image,
)
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline
from processing.hybrid_scan import FIELD, SmallScan, small_scan

SQUARE = MapField(x_mm=(-40.0, 40.0), y_mm=(-40.0, 40.0), cell_mm=1.0)
GAP = slice(48 - 6, 48 + 6)
BARS_MM = 20.0


@pytest.fixture(scope="module")
def scan() -> SmallScan:
    """Two long bars, 20 mm apart."""
    scene = SceneBuilder("bars").box((-30, -10), (-45, 45), BARS_MM).box((10, 30), (-45, 45), BARS_MM)
    return small_scan(scene.build(), pitch_mm=10.0)


@pytest.fixture(scope="module")
def heard(scan: SmallScan) -> Structured:
    pipeline = UltrasonicPipeline(scan.calibration)
    return placed(np.concatenate([pipeline.process(p) for p in scan.pings]))


@pytest.fixture(scope="module")
def array(scan: SmallScan) -> ArrayCalibration:
    return scan.calibration.array


def points_at(height_mm: np.ndarray, pitch: int = 3, kind: EchoKind = EchoKind.NONE) -> Structured:
    """A contact point, of no known sigma, in the middle of every few cells of `SQUARE`."""
    rows, columns = (axis.ravel() for axis in np.mgrid[1 : SQUARE.shape[0] : pitch, 1 : SQUARE.shape[1] : pitch])
    points = np.zeros(rows.size, dtype=ULTRASONIC_POINT)
    points["x_mm"], points["y_mm"] = SQUARE.x_mm[0] + columns + 0.5, SQUARE.y_mm[0] + rows + 0.5
    points["z_mm"], points["nz"], points["kind"] = height_mm[rows, columns], 1.0, kind
    points["zz_mm2"] = np.nan if kind == EchoKind.NONE else 0.01
    return placed(points)


def test_between_two_bars_sound_alone_finds_the_ground_that_the_nearest_point_does_not(
    scan: SmallScan, heard: Structured, array: ArrayCalibration
) -> None:
    middle = (slice(20, -20), GAP)
    plain = nearest(heard, FIELD)[middle]
    found = sound_image(heard, array, FIELD).height_mm[middle]
    assert np.mean(np.abs(plain) < 1) < 0.5
    assert np.mean(np.abs(found) < 1) > 0.8


def test_on_the_bars_nothing_is_lost(scan: SmallScan, heard: Structured, array: ArrayCalibration) -> None:
    found = sound_image(heard, array, FIELD).height_mm
    for left_mm in (-30, 10):
        top = found[20:-20, 48 + left_mm + 2 : 48 + left_mm + 18]
        assert np.mean(np.abs(top - BARS_MM) < 1) > 0.95


def test_what_lags_behind_the_same_surface_is_beside_it(array: ArrayCalibration) -> None:
    height_mm = np.zeros(SQUARE.shape)
    height_mm[:, 40:] = 20.0
    height_mm[:, 34:40] = 20.0 - 1.5 * late_mm(array)
    points = points_at(height_mm)
    wrong = (points["x_mm"] > -6) & (points["x_mm"] < 0)
    np.testing.assert_array_equal(beside(points, array), wrong)


def test_a_point_on_a_plane_and_a_surface_at_another_height_are_left_alone(array: ArrayCalibration) -> None:
    height_mm = np.zeros(SQUARE.shape)
    height_mm[:, 40:] = 3.0  # more than a slip, less than a bar
    assert not beside(points_at(height_mm), array).any()
    height_mm[:, 34:40] = -1.5 * late_mm(array)
    assert beside(points_at(height_mm), array).any()
    assert not beside(points_at(height_mm, kind=EchoKind.PLANE), array).any()


def test_lateness_goes_with_the_wave(array: ArrayCalibration) -> None:
    twice = msgspec.structs.replace(array, low_hz=array.low_hz / 2, high_hz=array.high_hz / 2)
    assert late_mm(twice) == pytest.approx(2 * late_mm(array))


def test_a_plane_is_followed_to_the_cell() -> None:
    points = points_at(np.zeros(SQUARE.shape), kind=EchoKind.PLANE)[:3]
    points["nx"], points["nz"] = -np.sin(0.1), np.cos(0.1)
    points["kind"][2] = EchoKind.NONE
    found = carried_mm(points, points["x_mm"] + 4.0, points["y_mm"] + 7.0)
    np.testing.assert_allclose(found, [4 * np.tan(0.1), 4 * np.tan(0.1), 0.0], rtol=1e-5)


def test_without_a_rim_a_sigma_is_that_of_the_point(array: ArrayCalibration) -> None:
    flat = np.zeros(SQUARE.shape)
    found = sound_image(points_at(flat, kind=EchoKind.PLANE), array, SQUARE)
    np.testing.assert_allclose(found.sigma_mm, np.hypot(0.1, CLEAN_MM), rtol=1e-5)
    doubtful = sound_image(points_at(flat), array, SQUARE)
    np.testing.assert_allclose(doubtful.sigma_mm, np.hypot(late_mm(array), CLEAN_MM), rtol=1e-5)
    slipping = msgspec.structs.replace(array, low_hz=38e3, high_hz=42e3)
    np.testing.assert_allclose(sound_image(points_at(flat), slipping, SQUARE).sigma_mm, DOUBTFUL_MM, rtol=1e-3)


def test_near_a_rim_a_sigma_grows_with_its_height_and_with_the_distance_to_the_point() -> None:
    step_mm = np.zeros((20, 40))
    step_mm[:, 20:] = 10.0
    near, far = (np.sqrt(rim_mm2(step_mm, np.full(step_mm.shape, away_mm), 1.0))[10] for away_mm in (0.5, 6.0))
    assert near[19] == pytest.approx(10 * np.sqrt(0.3))
    assert near[0] == 0
    assert (np.diff(near[11:20]) >= 0).all()
    assert (far >= near).all()
    assert far[16] > 2 * near[16]
    np.testing.assert_allclose(np.sqrt(rim_mm2(2 * step_mm, np.full(step_mm.shape, 0.5), 1.0))[10], 2 * near)


def test_beyond_the_reach_of_sound_nothing_is_said(array: ArrayCalibration) -> None:
    points = points_at(np.zeros(SQUARE.shape))
    left = points[points["x_mm"] < -20]
    found = sound_image(left, array, SQUARE)
    assert np.isnan(found.height_mm[:, 45:]).all()
    np.testing.assert_array_equal(np.isnan(found.height_mm), np.isnan(found.sigma_mm))
    assert np.isfinite(found.height_mm[:, :20]).all()


def test_a_point_that_states_no_variance_is_doubtful() -> None:
    points = np.zeros(4, dtype=ULTRASONIC_POINT)
    points["zz_mm2"] = [0.04, np.nan, np.inf, 0.0]
    np.testing.assert_allclose(sigma_of(points), [0.2, DOUBTFUL_MM, DOUBTFUL_MM, DOUBTFUL_MM], rtol=1e-6)


def test_what_is_deep_below_the_bench_is_no_surface(array: ArrayCalibration) -> None:
    height_mm = np.zeros(SQUARE.shape)
    height_mm[:, :30] = -290.0
    assert (sound_image(points_at(height_mm), array, SQUARE).height_mm[:, :45] == 0).mean() > 0.4
    assert np.nanmin(sound_image(points_at(height_mm), array, SQUARE).height_mm) == 0


def test_a_disk_has_its_middle_whatever_its_radius() -> None:
    assert disk(0.2, 1.0).sum() == 1
    assert disk(2.0, 1.0).sum() == 13
