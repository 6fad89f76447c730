"""The paper's triangulation: stereo (eq. 1-2), active with the plane x = d (eq. 3-4) and with any plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, Points3, require_shape
from echolume_processing.optical import closed_form
from echolume_processing.optical.closed_form import active_block, active_points, stereo_block, stereo_points

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


def stereo(left: Matrix, right: Matrix, left_px: Points2, right_px: Points2) -> Points3:
    """Stereo triangulation of eq. 1-2 in closed form: least squares, then one step of inverse iteration.

    Parameters
    ----------
    left, right : (3, 4)
        Projection matrices, rig mm to undistorted pixels.
    left_px, right_px : (n, 2)
        Undistorted image points of the same n scene points.

    Returns
    -------
    (n, 3) float64
        Points in mm; within a micrometre of `stereo_eigen` while the rays pass each other by millimetres at most.

    References
    ----------
    Llata et al., eq. 1-2.
    """
    require_shape("left", left, (3, 4))
    require_shape("right", right, (3, 4))
    require_shape("left_px", left_px, (None, 2))
    require_shape("right_px", right_px, (len(left_px), 2))
    out = np.empty((len(left_px), 3))
    stereo_points(
        np.ascontiguousarray(left), np.ascontiguousarray(right),
        np.ascontiguousarray(left_px), np.ascontiguousarray(right_px), out,
    )  # fmt: skip
    return out


def stereo_columns(left: Matrix, right: Matrix, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Stereo points (3, n) of image points (4, n): u, v of the left camera, then of the right; see `stereo`."""
    require_shape("points_px", points_px, (4, None))
    out = np.empty((3, points_px.shape[1]))
    stereo_block(left, right, np.ascontiguousarray(points_px), points_px.shape[1], out)
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


def plane_from_pixel(
    centre_mm: NDArray[np.float64], ray_matrix: Matrix, normal: NDArray[np.float64], distance_mm: float
) -> Matrix:
    """The map (4, 3) from undistorted image points to points of the plane n.X = distance, both homogeneous.

    Parameters
    ----------
    centre_mm : (3,)
        Optical centre of the camera.
    ray_matrix : (3, 3)
        Ray direction in the rig frame of a homogeneous image point, `Camera.ray_matrix`.
    normal : (3,)
        Unit normal of the laser plane.
    distance_mm : float
        n.X of the plane; for the moving plane ``offset + s (n.g)``.

    Notes
    -----
    The inverse of eq. 3 for any plane: a ray c + a B p meets it where a = (distance - n.c) / (n.B p).
    """
    require_shape("centre_mm", centre_mm, (3,))
    require_shape("ray_matrix", ray_matrix, (3, 3))
    require_shape("normal", normal, (3,))
    return closed_form.plane_from_pixel(centre_mm, np.ascontiguousarray(ray_matrix), normal, distance_mm)


def active(plane: Matrix, points_px: Points2) -> Points3:
    """Active triangulation of eq. 3-4 in closed form, for any plane.

    Parameters
    ----------
    plane : (4, 3)
        From `plane_from_pixel`.
    points_px : (n, 2)
        Undistorted image points on the stripe.

    Returns
    -------
    (n, 3) float64
        Points in mm; not finite where a ray runs in the plane.

    References
    ----------
    Llata et al., eq. 3-4.
    """
    require_shape("plane", plane, (4, 3))
    require_shape("points_px", points_px, (None, 2))
    out = np.empty((len(points_px), 3))
    active_points(np.ascontiguousarray(plane), np.ascontiguousarray(points_px), out)
    return out


def active_columns(plane: Matrix, points_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Active points (3, n) of image points (2, n); see `active`."""
    require_shape("plane", plane, (4, 3))
    require_shape("points_px", points_px, (2, None))
    out = np.empty((3, points_px.shape[1]))
    active_block(np.ascontiguousarray(plane), np.ascontiguousarray(points_px), out)
    return out


def fundamental(left: Matrix, right: Matrix) -> Matrix:
    """F with ``right_h^T F left_h = 0`` for undistorted points of the same scene point, shape (3, 3)."""
    require_shape("left", left, (3, 4))
    require_shape("right", right, (3, 4))
    centre = -np.linalg.solve(left[:, :3], left[:, 3])
    e = right @ np.append(centre, 1.0)
    skew = np.array([[0, -e[2], e[1]], [e[2], 0, -e[0]], [-e[1], e[0], 0]])
    found = skew @ right @ np.linalg.pinv(left)
    return found / np.linalg.norm(found)
