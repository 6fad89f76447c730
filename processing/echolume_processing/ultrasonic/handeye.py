"""Where a sensor sits on a robot, from poses that the sensor measures itself: AX = XB and AX = ZB.

A is what the robot says (exact), B what the sensor measures, with a sigma. A closed form gives the start; rotation and
translation are then fitted together. Errors of X act in X's source frame, X T(e); those of Z in its target frame,
T(e) Z.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, require_shape, rotation_from_vector, transform

STEP = 1e-6
ROUNDS = 20
CLOSE = 1e-8
"""Of a change's chi-squared."""
PARALLEL = 0.02
"""Second over first singular value of the rotation vectors: less is one common axis."""
STILL_RAD = float(np.radians(0.5))
NAMED = 0.99
"""Cosine to an axis from which on a direction bears its name."""

Moves = NDArray[np.float64]  # (n, 4, 4)


@dataclass(frozen=True)
class HandEye:
    """A solution with what is known of its errors."""

    x: Matrix
    z: Matrix | None
    """Only of AX = ZB."""
    covariance: NDArray[np.float64]
    """(6, 6), or (12, 12) with Z's errors after X's: x, y, z in mm, rotation vector in rad."""
    chi_squared: float
    """Per degree of freedom: 1 where the sigmas are right."""
    rotation_rms_rad: float
    translation_rms_mm: float


def solve_ax_xb(
    robot_moves: Moves,
    sensor_moves: Moves,
    sigma_mm: float,
    sigma_rad: float,
    *,
    wanted_mm: float = 1.0,
    wanted_rad: float = 0.01,
) -> HandEye:
    """Pose X of a sensor on the robot's hand from moves: A X = X B.

    Parameters
    ----------
    robot_moves, sensor_moves : (n, 4, 4) float64
        Each move as the hand made it (A) and as the sensor saw it (B). Sigmas hold for each B alone: use moves that
        share no pose, or `solve_ax_zb` on the poses themselves.
    sigma_mm, sigma_rad : float
        Of B, per axis.
    wanted_mm, wanted_rad : float
        Directions of X that stay more uncertain than this are undetermined.

    Raises
    ------
    CalibrationRejectedError
        Naming the undetermined directions.

    References
    ----------
    F. C. Park and B. J. Martin, IEEE Trans. Robotics and Automation 10 (1994), doi:10.1109/70.326576.
    """
    _require_moves(robot_moves, sensor_moves, 2)
    _require_axes(_vectors(robot_moves), "X")
    rotation = _aligned(_vectors(robot_moves), _vectors(sensor_moves))
    rows = (robot_moves[:, :3, :3] - np.eye(3)).reshape(-1, 3)
    right = np.einsum("ij,nj->ni", rotation, sensor_moves[:, :3, 3]) - robot_moves[:, :3, 3]
    start = transform(rotation, np.linalg.lstsq(rows, right.ravel(), rcond=None)[0])

    def expected(errors: NDArray[np.float64]) -> tuple[Moves, Matrix, Matrix | None]:
        x = start @ _pose(errors)
        return np.linalg.inv(x) @ robot_moves @ x, x, None

    return _refined(expected, 6, sensor_moves, (sigma_mm, sigma_rad), (wanted_mm, wanted_rad))


def solve_ax_zb(
    robot_poses: Moves,
    sensor_poses: Moves,
    sigma_mm: float,
    sigma_rad: float,
    *,
    wanted_mm: float = 1.0,
    wanted_rad: float = 0.01,
) -> HandEye:
    """Pose X of a sensor on the robot's hand, and Z of what it looks at: A X = Z B.

    Parameters
    ----------
    robot_poses : (n, 4, 4) float64
        Hand in the robot's frame (A).
    sensor_poses : (n, 4, 4) float64
        Sensor in the frame of what it looks at (B).
    sigma_mm, sigma_rad, wanted_mm, wanted_rad
        As in `solve_ax_xb`.

    Raises
    ------
    CalibrationRejectedError
        Naming the undetermined directions.

    References
    ----------
    M. Shah, J. Mechanisms and Robotics 5 (2013), doi:10.1115/1.4024473.
    """
    _require_moves(robot_poses, sensor_poses, 3)
    _require_axes(_vectors(np.linalg.inv(robot_poses[0]) @ robot_poses[1:]), "X")
    a, b = robot_poses[:, :3, :3], sensor_poses[:, :3, :3]
    product = sum(np.kron(rb, ra) for ra, rb in zip(a, b, strict=True))
    left, _, right = np.linalg.svd(np.asarray(product, dtype=np.float64))
    z_rotation, x_rotation = (_nearest_rotation(v.reshape(3, 3, order="F")) for v in (left[:, 0], right[0]))
    rows = np.concatenate([a, np.tile(-np.eye(3), (len(a), 1, 1))], axis=2).reshape(-1, 6)
    shifts = sensor_poses[:, :3, 3] @ z_rotation.T - robot_poses[:, :3, 3]
    found = np.asarray(np.linalg.lstsq(rows, shifts.ravel(), rcond=None)[0], dtype=np.float64)
    x_start, z_start = transform(x_rotation, found[:3]), transform(z_rotation, found[3:])

    def expected(errors: NDArray[np.float64]) -> tuple[Moves, Matrix, Matrix | None]:
        x, z = x_start @ _pose(errors[:6]), _pose(errors[6:]) @ z_start
        return np.linalg.inv(z) @ robot_poses @ x, x, z

    return _refined(expected, 12, sensor_poses, (sigma_mm, sigma_rad), (wanted_mm, wanted_rad))


def _require_moves(robot: Moves, sensor: Moves, least: int) -> None:
    require_shape("robot poses or moves", robot, (None, 4, 4))
    require_shape("sensor poses or moves", sensor, (len(robot), 4, 4))
    if len(robot) < least:
        raise CalibrationRejectedError(f"hand-eye: {len(robot)} poses or moves, at least {least} are needed")


def _require_axes(vectors_rad: NDArray[np.float64], name: str) -> None:
    """Refuse moves that turn about one axis, or not at all; vectors (n, 3)."""
    _, strength, axes = np.linalg.svd(vectors_rad, full_matrices=False)
    if np.linalg.norm(vectors_rad, axis=1).max() < STILL_RAD:
        raise CalibrationRejectedError(
            f"hand-eye: no move turns the hand: the translation of {name} is undetermined in all directions; add poses "
            "turned about two different axes"
        )
    if strength[1] < PARALLEL * strength[0]:
        axis = direction_name(axes[0])
        raise CalibrationRejectedError(
            f"hand-eye: all moves turn the hand about parallel axes, {axis}: undetermined is the translation of {name} "
            f"along {axis}; add poses turned about another axis"
        )


def direction_name(vector: NDArray[np.float64]) -> str:
    """``x``, ``y`` or ``z`` for a direction near an axis, else its components."""
    unit = vector / np.linalg.norm(vector)
    k = int(np.argmax(np.abs(unit)))
    if abs(unit[k]) > NAMED:
        return "xyz"[k]
    return "(" + ", ".join(f"{c:.2f}" for c in (unit * np.sign(unit[k])).tolist()) + ")"


def _vectors(moves: Moves) -> NDArray[np.float64]:
    """Rotation vectors (n, 3)."""
    return np.asarray(Rotation.from_matrix(moves[:, :3, :3]).as_rotvec(), dtype=np.float64)


def _aligned(to: NDArray[np.float64], source: NDArray[np.float64]) -> Matrix:
    """Rotation that turns vectors (n, 3) to others best."""
    return _nearest_rotation(to.T @ source)


def _nearest_rotation(matrix: Matrix) -> Matrix:
    matrix = matrix * np.sign(np.linalg.det(matrix))
    left, _, right = np.linalg.svd(matrix)
    return left @ np.diag([1.0, 1.0, float(np.sign(np.linalg.det(left @ right)))]) @ right


def _pose(errors: NDArray[np.float64]) -> Matrix:
    return transform(rotation_from_vector(errors[3:]), errors[:3])


def _refined(
    expected: Callable[[NDArray[np.float64]], tuple[Moves, Matrix, Matrix | None]],
    size: int,
    seen: Moves,
    sigmas: tuple[float, float],
    wanted: tuple[float, float],
) -> HandEye:
    """Gauss-Newton from a start that is near, and the covariance there."""

    def residuals(errors: NDArray[np.float64]) -> NDArray[np.float64]:
        made = expected(errors)[0]
        turned = _vectors(np.swapaxes(made, 1, 2) @ seen)
        return np.column_stack([(seen - made)[:, :3, 3] / sigmas[0], turned / sigmas[1]])

    at = np.zeros(size)
    slopes = np.zeros((6 * len(seen), size))
    for _ in range(ROUNDS):
        for k in range(size):
            ahead, behind = at.copy(), at.copy()
            ahead[k] += STEP
            behind[k] -= STEP
            slopes[:, k] = ((residuals(ahead) - residuals(behind)) / (2 * STEP)).ravel()
        change = np.linalg.lstsq(slopes, -residuals(at).ravel(), rcond=None)[0]
        at = at + change
        if float(np.sum((slopes @ change) ** 2)) < CLOSE:
            break
    _require_determined(slopes.T @ slopes, wanted)
    left = residuals(at)
    _, x, z = expected(at)
    return HandEye(
        x,
        z,
        np.asarray(np.linalg.inv(slopes.T @ slopes), dtype=np.float64),
        float(np.sum(left**2)) / (left.size - size),
        float(np.sqrt(np.mean(left[:, 3:] ** 2))) * sigmas[1],
        float(np.sqrt(np.mean(left[:, :3] ** 2))) * sigmas[0],
    )


def _require_determined(information: NDArray[np.float64], wanted: tuple[float, float]) -> None:
    """Refuse where a direction stays more uncertain than wanted, and name it."""
    scale = np.tile(np.repeat(wanted, 3), len(information) // 6)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    loose = [_words(vectors[:, k]) for k in np.flatnonzero(values < 1.0).tolist()]
    if loose:
        raise CalibrationRejectedError(
            f"hand-eye: undetermined: {'; '.join(loose)}; add poses, turned further and about other axes"
        )


def _words(direction: NDArray[np.float64]) -> str:
    """The shifts and turns that a direction in the space of errors consists of."""
    parts = {
        f"{kind} of {name}": direction[6 * n + 3 * k : 6 * n + 3 * k + 3]
        for n, name in enumerate("XZ"[: len(direction) // 6])
        for k, kind in enumerate(("translation", "rotation"))
    }
    most = max(float(np.linalg.norm(v)) for v in parts.values())
    return " with ".join(
        f"{what} {'along' if what[0] == 't' else 'about'} {direction_name(v)}"
        for what, v in parts.items()
        if np.linalg.norm(v) > 0.3 * most
    )
