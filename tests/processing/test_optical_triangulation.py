"""Camera model and triangulation: points imposed and recovered, the paper's forms against the fast ones."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_drivers.emulated.optics import CameraTruth, optical_truth
from echolume_messages.geometry import rotation_from_vector, transform
from echolume_processing.optical import triangulate
from echolume_processing.optical.camera import Camera

TRUTH = optical_truth(5)


def camera_of(truth: CameraTruth) -> Camera:
    return Camera(truth.matrix, truth.distortion, truth.camera_from_rig)


LEFT, RIGHT = camera_of(TRUTH.left), camera_of(TRUTH.right)
M = LEFT.projection, RIGHT.projection


def field_points(n: int = 300, seed: int = 0) -> np.ndarray:
    return np.random.default_rng(seed).uniform([-100, -90, 0], [100, 90, 50], (n, 3))


def undistorted(points_mm: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    return LEFT.undistort(TRUTH.left.project(points_mm)), RIGHT.undistort(TRUTH.right.project(points_mm))


def test_projection_agrees_with_the_emulated_camera() -> None:
    assert np.allclose(LEFT.project(field_points()), TRUTH.left.project(field_points()), atol=1e-9)


def test_undistorted_points_are_those_of_the_projection_matrix() -> None:
    points = field_points()
    homogeneous = np.column_stack([points, np.ones(len(points))]) @ M[0].T
    assert np.allclose(undistorted(points)[0], homogeneous[:, :2] / homogeneous[:, 2:], atol=1e-9)


def test_undistorting_nothing_stays_nothing() -> None:
    assert np.isnan(LEFT.undistort(np.array([[np.nan, 3.0]]))[0, 0])


@settings(max_examples=40, deadline=None)
@given(
    k1=st.floats(-0.35, 0.2),
    k2=st.floats(-0.1, 0.2),
    p1=st.floats(-2e-3, 2e-3),
    x=st.floats(-0.3, 0.3),
    y=st.floats(-0.3, 0.3),
)
def test_undistort_inverts_project_for_any_lens(k1: float, k2: float, p1: float, x: float, y: float) -> None:
    matrix = np.array([[900.0, 0.0, 320.0], [0.0, 905.0, 240.0], [0.0, 0.0, 1.0]])
    camera = Camera(matrix, np.array([k1, k2, p1, -p1, 0.01]), np.eye(4))
    image = camera.project(np.array([[x, y, 1.0]]))
    assert np.allclose(camera.undistort(image), [[900 * x + 320, 905 * y + 240]], atol=1e-6)


def test_rays_go_through_the_points() -> None:
    points = field_points()
    rays = LEFT.rays(undistorted(points)[0])
    ways = points - LEFT.centre_mm
    cosine = np.sum(rays * ways, axis=1) / np.linalg.norm(rays, axis=1) / np.linalg.norm(ways, axis=1)
    assert np.allclose(cosine, 1.0, atol=1e-12)


def test_stereo_triangulation_recovers_points() -> None:
    points = field_points()
    assert np.allclose(triangulate.stereo(*M, *undistorted(points)), points, atol=1e-6)


def test_fast_stereo_agrees_with_the_eigenvector_of_equations_1_and_2() -> None:
    points = field_points()
    left, right = undistorted(points)
    noise = np.random.default_rng(1).normal(0, 0.1, (2, len(points), 2))
    literal = triangulate.stereo_eigen(*M, left + noise[0], right + noise[1])
    assert np.allclose(triangulate.stereo(*M, left + noise[0], right + noise[1]), literal, atol=1e-4)


def test_matching_points_lie_on_their_epipolar_lines() -> None:
    left, right = undistorted(field_points())
    lines = np.column_stack([left, np.ones(len(left))]) @ triangulate.fundamental(*M).T
    distance_px = np.sum(lines * np.column_stack([right, np.ones(len(right))]), axis=1)
    assert np.abs(distance_px / np.hypot(lines[:, 0], lines[:, 1])).max() < 1e-6


@pytest.mark.parametrize("d_mm", [-80.0, 0.0, 63.5])
def test_active_triangulation_of_equations_3_and_4_recovers_points_of_the_plane(d_mm: float) -> None:
    points = field_points()
    points[:, 0] = d_mm
    for camera, image in zip((LEFT, RIGHT), undistorted(points), strict=True):
        literal = triangulate.active_x_plane(camera.projection, image, d_mm)
        assert np.allclose(literal, points, atol=1e-6)
        general = triangulate.active_plane(camera.centre_mm, camera.rays(image), np.array([1.0, 0.0, 0.0]), d_mm)
        assert np.allclose(general, literal, atol=1e-7)


def test_active_triangulation_recovers_points_of_a_tilted_plane() -> None:
    normal = rotation_from_vector(np.array([0.0, 0.05, -0.03])) @ np.array([1.0, 0.0, 0.0])
    points = field_points()
    points -= np.outer(points @ normal - 12.0, normal)
    image = undistorted(points)[1]
    assert np.allclose(triangulate.active_plane(RIGHT.centre_mm, RIGHT.rays(image), normal, 12.0), points, atol=1e-6)


def test_a_ray_within_the_plane_gives_no_finite_point() -> None:
    camera = Camera(np.eye(3), np.zeros(5), transform(np.eye(3), np.zeros(3)))
    found = triangulate.active_plane(camera.centre_mm, np.array([[0.0, 0.0, 1.0]]), np.array([1.0, 0.0, 0.0]), 5.0)
    assert not np.isfinite(found).all()


def test_points_of_a_wrong_shape_are_named() -> None:
    with pytest.raises(ValueError, match=r"left_px: expected shape \('n', 2\), got \(2, 5\)"):
        triangulate.stereo(*M, np.zeros((2, 5)), np.zeros((2, 5)))
