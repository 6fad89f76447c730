"""The plane's covariance against the scatter of fits, and the alignment aid against planes that were imposed."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_drivers.emulated.optics import optical_truth
from echolume_messages.calibration import LaserCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_processing.optical.align import plane_alignment, stripe_alignment, stripe_points
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.laser import StripeOnBoard, fit_laser
from echolume_processing.optical.stripe import Stripe

TRUTH = optical_truth(1)
CAMERAS = tuple(Camera(c.matrix, c.distortion, c.camera_from_rig) for c in (TRUTH.left, TRUTH.right))
SLOPES = -0.006, 0.004
"""x = 2 + SLOPES[0] y + SLOPES[1] z."""


def boards(seed: int, shared_mm: float = 0.03, noise_mm: float = 0.02, count: int = 7) -> list[StripeOnBoard]:
    """Stripes of the plane x = s whose points share an error on each stripe."""
    rng = np.random.default_rng(seed)
    out = []
    for k in range(count):
        for s in (-40.0, 0.0, 40.0):
            y = np.linspace(-50, 50, 40)
            z = 4.0 * (k % 5) + 0.3 * (k % 3 - 1) * y
            x = s + rng.normal(0, shared_mm) + rng.normal(0, noise_mm, len(y))
            out.append(StripeOnBoard(f"{k:02d}", s, np.column_stack([x, y, z])))
    return out


def stepped(y: np.ndarray) -> np.ndarray:
    """A block of 20 mm under the middle of the line."""
    return np.where(np.abs(y) < 25, 20.0, 0.0)


def line_points(height=stepped, noise_mm: float = 0.02, seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    y = np.linspace(-80, 80, 600)
    z = height(y)
    return np.column_stack([2 + SLOPES[0] * y + SLOPES[1] * z + rng.normal(0, noise_mm, len(y)), y, z])


def seen(camera: Camera, points: np.ndarray) -> Stripe:
    """The stripe of points, a column a row, as a camera sees them."""
    u, v = camera.project(points).T
    columns = np.full((1024, 1), np.nan)
    order = np.argsort(v)
    rows = np.arange(int(np.ceil(v.min())), int(v.max()) + 1)
    columns[rows, 0] = np.interp(rows, v[order], u[order])
    ones = np.ones((1024, 1))
    return Stripe(columns, 4 * ones, 100 * ones, np.zeros((1024, 1), np.bool_), np.full(1024, 1.0), 0.02 * ones)


def test_the_planes_sigma_is_the_scatter_of_the_fits() -> None:
    place = 30.0, -60.0, 20.0
    fits = [fit_laser(boards(seed)).calibration for seed in range(40)]
    off_mm = [
        np.dot(f.normal, (30.0, *place[1:])) - f.offset_mm - 30.0 * np.dot(f.normal, f.guide_direction) for f in fits
    ]
    sigmas = [f.sigma_mm(*place) for f in fits]
    assert np.mean(np.square(off_mm) / np.square(sigmas)) == pytest.approx(1.0, abs=0.5)
    assert np.median(sigmas) < 0.03


def test_the_error_that_a_stripes_points_share_is_found() -> None:
    assert fit_laser(boards(3, shared_mm=0.05)).shared_mm == pytest.approx(0.05, rel=0.35)
    assert fit_laser(boards(3, shared_mm=0.0)).shared_mm < 0.01


def test_the_papers_plane_is_the_special_case_of_no_slopes() -> None:
    exact = fit_laser(boards(0, shared_mm=0.0, noise_mm=1e-6)).calibration
    assert np.allclose(exact.normal, (1, 0, 0), atol=1e-6)
    assert np.allclose(exact.guide_direction, (1, 0, 0), atol=1e-6)
    assert exact.offset_mm == pytest.approx(0, abs=1e-5)


def test_a_board_that_moved_before_its_stripes_is_named() -> None:
    stripes = boards(0)
    for s in stripes:
        if s.board == "04":
            s.points_mm[:, 0] += 0.45
    with pytest.raises(
        CalibrationRejectedError, match=r"stripes on board 04 lie 0\.\d+ mm from the plane found without"
    ):
        fit_laser(stripes)


def test_a_plane_without_covariance_knows_no_sigma() -> None:
    plain = LaserCalibration(normal=(1, 0, 0), offset_mm=0.0, guide_direction=(1, 0, 0), rms_mm=0.0)
    assert plain.sigma_mm(0, 0, 0) is None


def test_turns_of_the_plane_are_recovered_from_one_stripe() -> None:
    found = stripe_alignment(line_points())
    assert found.about_z_deg == pytest.approx(np.degrees(-np.arctan(SLOPES[0])), abs=0.01)
    assert found.about_y_deg == pytest.approx(np.degrees(np.arctan(SLOPES[1])), abs=0.02)
    assert found.angle_deg == pytest.approx(np.degrees(np.arctan(np.hypot(*SLOPES))), abs=0.015)
    assert found.over_field_mm == pytest.approx(200 * 0.006 + 40 * 0.004, abs=0.05)
    assert 0 < found.about_z_sigma_deg < 0.01


def test_on_a_flat_bench_only_the_turn_about_z_is_told() -> None:
    found = stripe_alignment(line_points(height=np.zeros_like))
    assert found.about_y_deg is None
    assert found.about_z_deg == pytest.approx(0.344, abs=0.01)
    assert "about y unknown: put a block under a part of the line" in found.text


def test_points_that_are_not_of_the_line_do_not_turn_it() -> None:
    points = line_points()
    points[::20, 0] += 15.0
    points[5] = np.nan
    assert stripe_alignment(points).about_z_deg == pytest.approx(0.344, abs=0.01)


def test_a_few_false_points_do_not_invent_a_turn_about_y() -> None:
    points = line_points(height=np.zeros_like)
    points[[100, 300], 2] += 150.0
    points[500] += [-30.0, 0.0, -120.0]
    found = stripe_alignment(points)
    assert found.about_y_deg is None
    assert found.about_z_deg == pytest.approx(0.344, abs=0.01)


def test_a_parallel_plane_has_no_angle() -> None:
    assert plane_alignment(np.array([1.0, 0.0, 0.0])).over_field_mm == 0
    tilted = plane_alignment(np.array([1.0, -SLOPES[0], -SLOPES[1]]))
    assert tilted.about_z_deg == pytest.approx(0.3438, abs=1e-3)
    assert tilted.about_y_deg == pytest.approx(0.2292, abs=1e-3)


def test_too_short_a_stripe_is_refused_with_advice() -> None:
    with pytest.raises(CalibrationRejectedError, match="let the whole line be seen by both cameras"):
        stripe_alignment(line_points()[:60])


@pytest.mark.parametrize("height", [np.zeros_like, lambda y: 0.1 * y + 10], ids=["flat", "slope"])
def test_a_stripe_in_both_cameras_becomes_points_without_its_plane(height) -> None:
    points = line_points(height, noise_mm=0.0)
    found = stripe_points(CAMERAS, *(seen(camera, points) for camera in CAMERAS))
    assert len(found) > 300
    expected = 2 + SLOPES[0] * found[:, 1] + SLOPES[1] * found[:, 2]
    assert np.abs(found[:, 0] - expected).max() < 0.02
    assert np.abs(found[:, 2] - height(found[:, 1])).max() < 0.02


def test_no_stripe_no_points() -> None:
    empty = seen(CAMERAS[0], line_points())
    empty.column_px[:] = np.nan
    assert stripe_points(CAMERAS, empty, empty).shape == (0, 3)
