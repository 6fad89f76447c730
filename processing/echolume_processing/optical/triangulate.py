"""The paper's triangulation: stereo (eq. 1-2), active with the plane x = d (eq. 3-4) and with any plane."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, Points3, require_shape

Points2 = NDArray[np.float64]


def stereo_system(left: Matrix, right: Matrix, left_px: Points2, right_px: Points2) -> NDArray[np.float64]:
    """The matrices A of eq. 1, shape (n, 4, 4), of n pairs of undistorted image points."""
    require_shape("left", left, (3, 4))
    require_shape("right", right, (3, 4))
    require_shape("left_px", left_px, (None, 2))
    require_shape("right_px", right_px, (len(left_px), 2))
    rows = [
        points[:, axis, None] * matrix[2] - matrix[axis]
        for matrix, points in ((left, left_px), (right, right_px))
        for axis in (0, 1)
    ]
    return np.stack(rows, axis=1)


def stereo_eigen(left: Matrix, right: Matrix, left_px: Points2, right_px: Points2) -> Points3:
    """Stereo triangulation, literally eq. 1-2: the eigenvector of least eigenvalue of A^T A.

    Parameters
    ----------
    left, right : (3, 4)
        Projection matrices, rig mm to undistorted pixels.
    left_px, right_px : (n, 2)
        Undistorted image points of the same n scene points.

    Returns
    -------
    (n, 3) float64
        Points in mm.

    References
    ----------
    Llata et al., eq. 1-2.
    """
    a = stereo_system(left, right, left_px, right_px)
    _, vectors = np.linalg.eigh(np.swapaxes(a, 1, 2) @ a)
    homogeneous = vectors[:, :, 0]
    return homogeneous[:, :3] / homogeneous[:, 3:]


@njit(cache=True, nogil=True)
def solve4(a: Matrix, b: NDArray[np.float64]) -> None:
    """Solve a x = b in place for a symmetric positive 4x4 matrix; the answer is in b."""
    for i in range(4):
        pivot = a[i, i]
        for j in range(i + 1, 4):
            factor = a[j, i] / pivot
            for k in range(i, 4):
                a[j, k] -= factor * a[i, k]
            b[j] -= factor * b[i]
    for i in range(3, -1, -1):
        for k in range(i + 1, 4):
            b[i] -= a[i, k] * b[k]
        b[i] /= a[i, i]


@njit(cache=True, nogil=True)
def stereo_point(
    left: Matrix, right: Matrix, ul: float, vl: float, ur: float, vr: float, out: NDArray[np.float64]
) -> None:
    """Least eigenvector of A^T A (eq. 1-2) by inverse iteration; writes x, y, z in mm to `out` (3,)."""
    a = np.empty((4, 4))
    for k in range(4):
        scale = 1e-3 if k == 3 else 1.0  # X in metres keeps A^T A well conditioned; scaled back below
        a[0, k] = (ul * left[2, k] - left[0, k]) * scale
        a[1, k] = (vl * left[2, k] - left[1, k]) * scale
        a[2, k] = (ur * right[2, k] - right[0, k]) * scale
        a[3, k] = (vr * right[2, k] - right[1, k]) * scale
    normal = np.empty((4, 4))
    trace = 0.0
    for i in range(4):
        for j in range(4):
            total = 0.0
            for r in range(4):
                total += a[r, i] * a[r, j]
            normal[i, j] = total
        trace += normal[i, i]
    for i in range(4):
        normal[i, i] += 1e-16 * trace
    x = np.array([0.0, 0.0, 0.0, 1.0])
    for _ in range(3):
        solve4(normal.copy(), x)
        size = np.sqrt(x[0] * x[0] + x[1] * x[1] + x[2] * x[2] + x[3] * x[3])
        for i in range(4):
            x[i] /= size
    for i in range(3):
        out[i] = 1000.0 * x[i] / x[3]


@njit(cache=True, nogil=True)
def _stereo(left: Matrix, right: Matrix, left_px: Points2, right_px: Points2, out: Points3) -> None:
    for i in range(left_px.shape[0]):
        stereo_point(left, right, left_px[i, 0], left_px[i, 1], right_px[i, 0], right_px[i, 1], out[i])


def stereo(left: Matrix, right: Matrix, left_px: Points2, right_px: Points2) -> Points3:
    """Stereo triangulation of eq. 1-2, compiled; see `stereo_eigen` for parameters and units."""
    require_shape("left", left, (3, 4))
    require_shape("right", right, (3, 4))
    require_shape("left_px", left_px, (None, 2))
    require_shape("right_px", right_px, (len(left_px), 2))
    out = np.empty((len(left_px), 3))
    _stereo(left, right, np.ascontiguousarray(left_px), np.ascontiguousarray(right_px), out)
    return out


def active_x_plane(matrix: Matrix, points_px: Points2, d_mm: float) -> Points3:
    """Active triangulation with the laser plane x = d, literally eq. 3-4.

    Parameters
    ----------
    matrix : (3, 4)
        Projection matrix M of the camera.
    points_px : (n, 2)
        Undistorted image points on the stripe.
    d_mm : float
        Position of the laser plane.

    Returns
    -------
    (n, 3) float64
        Points in mm; x is d.

    References
    ----------
    Llata et al., eq. 3-4.
    """
    require_shape("matrix", matrix, (3, 4))
    require_shape("points_px", points_px, (None, 2))
    n = len(points_px)
    a = np.empty((n, 3, 3))
    a[:, :, 0] = -matrix[:, 1]
    a[:, :, 1] = -matrix[:, 2]
    a[:, :2, 2] = points_px
    a[:, 2, 2] = 1.0
    b = matrix[:, [0, 3]] @ np.array([d_mm, 1.0])  # (3,)
    c = np.linalg.solve(a, np.broadcast_to(b, (n, 3))[:, :, None])[:, :, 0]  # y, z, alpha
    return np.column_stack([np.full(n, d_mm), c[:, 0], c[:, 1]])


def active_plane(
    centre_mm: NDArray[np.float64], rays: Points3, normal: NDArray[np.float64], distance_mm: float
) -> Points3:
    """Active triangulation with any plane n.X = distance: where each ray meets it.

    Parameters
    ----------
    centre_mm : (3,)
        Optical centre of the camera.
    rays : (n, 3)
        Directions of the image points, any length.
    normal : (3,)
        Unit normal of the laser plane.
    distance_mm : float
        n.X of the plane; for the moving plane ``offset + s (n.g)``.

    Returns
    -------
    (n, 3) float64
        Points in mm; not finite where a ray runs in the plane.

    Notes
    -----
    Equal to eq. 3-4 where the plane is x = d.
    """
    require_shape("centre_mm", centre_mm, (3,))
    require_shape("rays", rays, (None, 3))
    require_shape("normal", normal, (3,))
    with np.errstate(divide="ignore", invalid="ignore"):
        depth = (distance_mm - normal @ centre_mm) / (rays @ normal)  # (n,)
        return centre_mm + depth[:, None] * rays


def fundamental(left: Matrix, right: Matrix) -> Matrix:
    """F with ``right_h^T F left_h = 0`` for undistorted points of the same scene point, shape (3, 3)."""
    require_shape("left", left, (3, 4))
    require_shape("right", right, (3, 4))
    centre = -np.linalg.solve(left[:, :3], left[:, 3])
    e = right @ np.append(centre, 1.0)
    skew = np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])
    found = skew @ right @ np.linalg.pinv(left)
    return found / np.linalg.norm(found)
