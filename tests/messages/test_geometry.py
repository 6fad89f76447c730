"""Rigid transforms form a group, and act on points."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echolume_messages import geometry as g

angle = st.floats(-10.0, 10.0)
length = st.floats(-1000.0, 1000.0)
vectors = st.tuples(angle, angle, angle).map(np.array)
transforms = st.tuples(vectors, st.tuples(length, length, length).map(np.array)).map(
    lambda t: g.transform(g.rotation_from_vector(t[0]), t[1])
)
poses = st.tuples(length, length, length, angle, angle, angle).map(np.array)
clouds = st.lists(st.tuples(length, length, length), min_size=1, max_size=8).map(lambda p: np.array(p, dtype=float))


@given(transforms)
def test_a_transform_and_its_inverse_cancel(m: np.ndarray) -> None:
    np.testing.assert_allclose(m @ g.invert(m), np.eye(4), atol=1e-9)
    np.testing.assert_allclose(g.invert(m) @ m, np.eye(4), atol=1e-9)
    np.testing.assert_allclose(g.invert(g.invert(m)), m, atol=1e-9)


@given(transforms, transforms, clouds)
def test_applying_two_transforms_is_applying_their_product(a: np.ndarray, b: np.ndarray, points: np.ndarray) -> None:
    np.testing.assert_allclose(g.apply(a, g.apply(b, points)), g.apply(a @ b, points), atol=1e-7)


@given(transforms, clouds)
def test_what_is_moved_there_and_back_is_where_it_was(m: np.ndarray, points: np.ndarray) -> None:
    np.testing.assert_allclose(g.apply(g.invert(m), g.apply(m, points)), points, atol=1e-8)


@given(transforms, clouds)
def test_distances_are_kept(m: np.ndarray, points: np.ndarray) -> None:
    before = np.linalg.norm(points[1:] - points[:-1], axis=1)
    moved = g.apply(m, points)
    np.testing.assert_allclose(np.linalg.norm(moved[1:] - moved[:-1], axis=1), before, atol=1e-8)
    assert moved.dtype == np.float64


@given(poses)
def test_the_robot_s_pose_is_a_rigid_transform(pose: np.ndarray) -> None:
    m = g.robot_from_flange(pose)
    np.testing.assert_allclose(m[:3, :3] @ m[:3, :3].T, np.eye(3), atol=1e-12)
    assert np.linalg.det(m[:3, :3]) == pytest.approx(1.0)
    np.testing.assert_array_equal(m[:3, 3], pose[:3])


@given(st.tuples(angle, angle, angle))
def test_wrist_angles_turn_about_x_then_y_then_z(angles: tuple[float, float, float]) -> None:
    rx, ry, rz = (g.rotation_from_vector(a * axis) for a, axis in zip(angles, np.eye(3), strict=True))
    np.testing.assert_allclose(g.rotation_from_euler(*angles), rz @ ry @ rx, atol=1e-12)


@given(st.floats(1e-12, 3.1), vectors)
def test_the_angle_of_a_rotation_is_found_again(angle_rad: float, axis: np.ndarray) -> None:
    norm = np.linalg.norm(axis)
    unit = axis / norm if norm > 1e-6 else np.array([0.0, 0.0, 1.0])
    found = g.rotation_angle_rad(g.rotation_from_vector(unit * angle_rad))
    assert found == pytest.approx(angle_rad, rel=1e-6, abs=1e-12)


def test_a_quarter_turn_about_z_moves_x_to_y() -> None:
    m = g.transform(g.rotation_from_euler(0, 0, np.pi / 2), np.array([1.0, 2.0, 3.0]))
    np.testing.assert_allclose(g.apply(m, np.array([[1.0, 0.0, 0.0]])), [[1.0, 3.0, 3.0]], atol=1e-15)


def test_wrong_shapes_are_named() -> None:
    with pytest.raises(ValueError, match=r"points: expected shape \('n', 3\), got \(3,\)"):
        g.apply(np.eye(4), np.zeros(3))
    with pytest.raises(ValueError, match=r"pose: expected shape \(6,\), got \(5,\)"):
        g.robot_from_flange(np.zeros(5))
