"""Hand-eye poses: imposed and recovered, with honest covariances, and degenerate moves refused by name."""

import numpy as np
import pytest

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import invert, rotation_angle_rad, rotation_from_vector, transform
from echolume_processing.ultrasonic.handeye import direction_name, solve_ax_xb, solve_ax_zb

SIGMA_MM, SIGMA_RAD = 0.3, 2e-3
X = transform(rotation_from_vector(np.array([3.1, 0.2, -0.1])), np.array([4.0, -7.0, 52.0]))
Z = transform(rotation_from_vector(np.array([0.02, -0.01, 0.4])), np.array([120.0, -80.0, 3.0]))


def random_poses(rng: np.random.Generator, number: int, turns: np.ndarray | None = None) -> np.ndarray:
    turns = rng.normal(0, 0.25, (number, 3)) if turns is None else turns
    return np.array([transform(rotation_from_vector(t), rng.normal(0, 80, 3)) for t in turns])


def noisy(poses: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    out = poses.copy()
    out[:, :3, 3] += rng.normal(0, SIGMA_MM, (len(poses), 3))
    out[:, :3, :3] @= np.array([rotation_from_vector(w) for w in rng.normal(0, SIGMA_RAD, (len(poses), 3))])
    return out


def error_of(truth: np.ndarray, found: np.ndarray) -> np.ndarray:
    """Small pose error (6,): x, y, z and rotation vector of truth^-1 found."""
    moved = invert(truth) @ found
    skew = 0.5 * (moved[:3, :3] - moved[:3, :3].T)
    return np.array([*moved[:3, 3], skew[2, 1], skew[0, 2], skew[1, 0]])


def test_an_imposed_pose_is_recovered_exactly_without_noise():
    rng = np.random.default_rng(1)
    a = random_poses(rng, 10)
    moves = solve_ax_xb(a, invert(X) @ a @ X, SIGMA_MM, SIGMA_RAD)
    poses = solve_ax_zb(a, invert(Z) @ a @ X, SIGMA_MM, SIGMA_RAD)
    assert poses.z is not None
    for truth, found in ((X, moves.x), (X, poses.x), (Z, poses.z)):
        np.testing.assert_allclose(found, truth, atol=1e-6)
    assert moves.z is None


def test_turns_of_nearly_half_a_circle_are_no_trouble():
    rng = np.random.default_rng(2)
    a = random_poses(rng, 8, rng.normal(0, 1, (8, 3)) * 3.0 / np.sqrt(3))
    found = solve_ax_zb(a, invert(Z) @ a @ X, SIGMA_MM, SIGMA_RAD)
    np.testing.assert_allclose(found.x, X, atol=1e-7)


def test_the_stated_covariances_are_the_true_ones():
    rng = np.random.default_rng(3)
    a = random_poses(rng, 12)
    nees: dict[str, list[float]] = {"moves": [], "poses": []}
    chi: list[float] = []
    for _ in range(200):
        moves = solve_ax_xb(a, noisy(invert(X) @ a @ X, rng), SIGMA_MM, SIGMA_RAD)
        error = error_of(X, moves.x)
        nees["moves"].append(error @ np.linalg.solve(moves.covariance, error) / 6)
        poses = solve_ax_zb(a, noisy(invert(Z) @ a @ X, rng), SIGMA_MM, SIGMA_RAD)
        assert poses.z is not None
        error = np.concatenate([error_of(X, poses.x), error_of(invert(poses.z), invert(Z))])
        nees["poses"].append(error @ np.linalg.solve(poses.covariance, error) / 12)
        chi.append(poses.chi_squared)
    for values in nees.values():
        assert 0.9 < np.mean(values) < 1.1
    assert np.mean(chi) == pytest.approx(1.0, abs=0.05)


def test_rotation_and_translation_fitted_together_beat_the_closed_form():
    rng = np.random.default_rng(4)
    a = random_poses(rng, 8)
    joint, apart = [], []
    for _ in range(60):
        b = noisy(invert(X) @ a @ X, rng)
        found = solve_ax_xb(a, b, SIGMA_MM, SIGMA_RAD)
        closed = solve_ax_xb(a, b, 1e6 * SIGMA_MM, SIGMA_RAD, wanted_mm=1e12)
        joint.append(rotation_angle_rad(X[:3, :3].T @ found.x[:3, :3]))
        apart.append(rotation_angle_rad(X[:3, :3].T @ closed.x[:3, :3]))
    assert np.mean(np.square(joint)) < np.mean(np.square(apart))


def test_parallel_axes_are_refused_and_the_direction_is_named():
    rng = np.random.default_rng(5)
    a = random_poses(rng, 7, np.outer(rng.normal(0, 0.4, 7), [0, 0, 1.0]))
    for solve, b in ((solve_ax_xb, invert(X) @ a @ X), (solve_ax_zb, invert(Z) @ a @ X)):
        with pytest.raises(
            CalibrationRejectedError, match="parallel axes, z: undetermined is the translation of X along z"
        ):
            solve(a, b, SIGMA_MM, SIGMA_RAD)


def test_moves_without_turns_are_refused():
    a = random_poses(np.random.default_rng(6), 5, np.zeros((5, 3)))
    with pytest.raises(CalibrationRejectedError, match="no move turns the hand"):
        solve_ax_zb(a, invert(Z) @ a @ X, SIGMA_MM, SIGMA_RAD)


def test_turns_too_small_for_the_noise_name_what_they_leave_open():
    rng = np.random.default_rng(7)
    turns = np.column_stack([rng.normal(0, 0.02, 6), rng.normal(0, 0.02, 6), rng.normal(0, 0.4, 6)])
    a = random_poses(rng, 6, turns)
    with pytest.raises(CalibrationRejectedError, match=r"undetermined: .*translation of X.* along z"):
        solve_ax_zb(a, invert(Z) @ a @ X, SIGMA_MM, SIGMA_RAD)


def test_too_few_poses_and_wrong_shapes_are_refused():
    one = np.eye(4)[None]
    with pytest.raises(CalibrationRejectedError, match="at least 2"):
        solve_ax_xb(one, one, 1.0, 1.0)
    with pytest.raises(ValueError, match="sensor poses or moves: expected shape"):
        solve_ax_xb(np.tile(np.eye(4), (3, 1, 1)), one, 1.0, 1.0)


def test_a_direction_bears_the_name_of_its_axis():
    assert direction_name(np.array([0.0, -1.0, 0.01])) == "y"
    assert direction_name(np.array([-1.0, -1.0, 0.0])) == "(0.71, 0.71, -0.00)"
