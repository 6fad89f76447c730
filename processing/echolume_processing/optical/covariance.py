"""Covariance of triangulated points from the pixels', the cameras' and the laser plane's uncertainty; compiled.

Points are (3, n). A covariance is (6, n): xx, xy, xz, yy, yz, zz in mm^2. A point is where three surfaces meet: those
of its column and row in one camera, and that of the other camera's column (ST) or the laser plane (AT). With g the
three gradients and s their sigmas, the covariance is the sum of s_i^2 j_i j_i^T, j_i the columns of the inverse of g.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, require_shape

Values = NDArray[np.float64]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def meet(
    points: Values, m: Matrix, third: Matrix, turned: bool, sigma_u: Values, sigma_v: float, sigma_third: Values,
    out: Values,
) -> None:  # fmt: skip
    """Fill `out` (6, n) with the covariance of points (3, n).

    The third surface is a column of the camera `third`, or if `turned` the plane third[0].
    """
    m00, m01, m02, m10, m11, m12 = m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2]
    m20, m21, m22, m03, m13, m23 = m[2, 0], m[2, 1], m[2, 2], m[0, 3], m[1, 3], m[2, 3]
    w00, w01, w02, w03 = third[0, 0], third[0, 1], third[0, 2], third[0, 3]
    w20, w21, w22, w23 = third[2, 0], third[2, 1], third[2, 2], third[2, 3]
    for i in range(points.shape[1]):
        x, y, z = points[0, i], points[1, i], points[2, i]
        near = 1.0 / (m20 * x + m21 * y + m22 * z + m23)
        u = (m00 * x + m01 * y + m02 * z + m03) * near
        v = (m10 * x + m11 * y + m12 * z + m13) * near
        ax, ay, az = (m00 - u * m20) * near, (m01 - u * m21) * near, (m02 - u * m22) * near
        bx, by, bz = (m10 - v * m20) * near, (m11 - v * m21) * near, (m12 - v * m22) * near
        near_w = 1.0 / (w20 * x + w21 * y + w22 * z + w23)
        uw = 0.0 if turned else (w00 * x + w01 * y + w02 * z + w03) * near_w
        cx, cy, cz = (w00 - uw * w20) * near_w, (w01 - uw * w21) * near_w, (w02 - uw * w22) * near_w
        # Columns of the inverse of (a, b, c): b x c, c x a, a x b over their determinant.
        px, py, pz = by * cz - bz * cy, bz * cx - bx * cz, bx * cy - by * cx
        qx, qy, qz = cy * az - cz * ay, cz * ax - cx * az, cx * ay - cy * ax
        rx, ry, rz = ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx
        scale = 1.0 / (ax * px + ay * py + az * pz)
        scale *= scale
        s, t, k = sigma_u[i] * sigma_u[i] * scale, sigma_v * sigma_v * scale, sigma_third[i] * sigma_third[i] * scale
        out[0, i] = s * px * px + t * qx * qx + k * rx * rx
        out[1, i] = s * px * py + t * qx * qy + k * rx * ry
        out[2, i] = s * px * pz + t * qx * qz + k * rx * rz
        out[3, i] = s * py * py + t * qy * qy + k * ry * ry
        out[4, i] = s * py * pz + t * qy * qz + k * ry * rz
        out[5, i] = s * pz * pz + t * qz * qz + k * rz * rz


def stereo_covariance(
    left: Matrix, right: Matrix, points_mm: Values, left_px: Values, right_px: Values, row_px: float
) -> Values:
    """Covariance (6, n) of stereo points whose right image point was found on the left one's epipolar line.

    Parameters
    ----------
    left, right : (3, 4)
        Projection matrices.
    points_mm : (3, n)
        The points.
    left_px, right_px : (n,)
        Sigmas of the columns, camera uncertainty included.
    row_px : float
        Sigma of the row: a stripe has its column measured in whole rows, so that only the camera's is left.
    """
    require_shape("points_mm", points_mm, (3, len(left_px)))
    out = np.empty((6, len(left_px)))
    meet(points_mm, left, right, False, left_px, row_px, right_px, out)
    return out


def active_covariance(
    matrix: Matrix, normal: Values, points_mm: Values, column_px: Values, row_px: float, plane_mm: float
) -> Values:
    """Covariance (6, n) of active points; `plane_mm` is the sigma of the laser plane's position."""
    require_shape("points_mm", points_mm, (3, len(column_px)))
    plane = np.zeros((3, 4))
    plane[0, :3], plane[2, 3] = normal, 1.0
    out = np.empty((6, len(column_px)))
    meet(points_mm, matrix, plane, True, column_px, row_px, np.full(len(column_px), plane_mm), out)
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def constrain(
    points: Values, cov: Values, normal: Values, distance: float, variance: Values, moved: Values, out: Values
) -> None:
    """See `joint`."""
    nx, ny, nz = normal[0], normal[1], normal[2]
    for i in range(points.shape[1]):
        xx, xy, xz, yy, yz, zz = cov[0, i], cov[1, i], cov[2, i], cov[3, i], cov[4, i], cov[5, i]
        kx, ky, kz = xx * nx + xy * ny + xz * nz, xy * nx + yy * ny + yz * nz, xz * nx + yz * ny + zz * nz
        scale = 1.0 / (kx * nx + ky * ny + kz * nz + variance[i])
        off = (distance - nx * points[0, i] - ny * points[1, i] - nz * points[2, i]) * scale
        moved[0, i], moved[1, i], moved[2, i] = (
            points[0, i] + kx * off,
            points[1, i] + ky * off,
            points[2, i] + kz * off,
        )
        out[0, i], out[1, i], out[2, i] = xx - kx * kx * scale, xy - kx * ky * scale, xz - kx * kz * scale
        out[3, i], out[4, i], out[5, i] = yy - ky * ky * scale, yz - ky * kz * scale, zz - kz * kz * scale


def joint(
    points_mm: Values, covariance: Values, normal: Values, distance_mm: float, plane_mm: float
) -> tuple[Values, Values]:
    """Joint ST + AT: stereo points drawn to the laser plane as far as both deserve.

    Parameters
    ----------
    points_mm, covariance : (3, n), (6, n)
        Stereo points and their covariance.
    normal, distance_mm : (3,), float
        The laser plane n.X = distance.
    plane_mm : float
        Sigma of the plane's position; 0 makes it a hard constraint: the points lie on it exactly.

    Returns
    -------
    points_mm, covariance : (3, n), (6, n)

    Notes
    -----
    The closed form of weighted least squares over the columns of both cameras and the plane. With the plane exact,
    z is the mean of AT-left and AT-right, weighted by their variances.
    """
    require_shape("covariance", covariance, (6, points_mm.shape[1]))
    moved, out = np.empty_like(points_mm), np.empty_like(covariance)
    variance = np.full(points_mm.shape[1], plane_mm**2)
    constrain(points_mm, covariance, normal, distance_mm, variance, moved, out)
    return moved, out


def full(covariance: Values) -> NDArray[np.float64]:
    """Symmetric matrices (n, 3, 3) of (6, n)."""
    require_shape("covariance", covariance, (6, None))
    return np.ascontiguousarray(covariance[[0, 1, 2, 1, 3, 4, 2, 4, 5]].T).reshape(-1, 3, 3)
