"""The compiled closed forms of the paper's triangulation."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Matrix = NDArray[np.float64]
Points = NDArray[np.float64]

BLOCK = 256
"""Points that are worked on together; their intermediate values stay in the nearest cache."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def stereo_block(m: Matrix, w: Matrix, px: NDArray[np.float64], count: int, out: NDArray[np.float64]) -> None:
    """Points (3, count) of image points (4, count); one value a line, so that the compiler takes several at once."""
    for i in range(count):
        ul, vl, ur, vr = px[0, i], px[1, i], px[2, i], px[3, i]
        # The rows of A.
        a0, a1, a2, a3 = ul * m[2, 0] - m[0, 0], ul * m[2, 1] - m[0, 1], ul * m[2, 2] - m[0, 2], ul * m[2, 3] - m[0, 3]
        b0, b1, b2, b3 = vl * m[2, 0] - m[1, 0], vl * m[2, 1] - m[1, 1], vl * m[2, 2] - m[1, 2], vl * m[2, 3] - m[1, 3]
        c0, c1, c2, c3 = ur * w[2, 0] - w[0, 0], ur * w[2, 1] - w[0, 1], ur * w[2, 2] - w[0, 2], ur * w[2, 3] - w[0, 3]
        d0, d1, d2, d3 = vr * w[2, 0] - w[1, 0], vr * w[2, 1] - w[1, 1], vr * w[2, 2] - w[1, 2], vr * w[2, 3] - w[1, 3]
        # A^T A = [[P, q], [q^T, r]].
        xx, xy = a0 * a0 + b0 * b0 + c0 * c0 + d0 * d0, a0 * a1 + b0 * b1 + c0 * c1 + d0 * d1
        xz, yy = a0 * a2 + b0 * b2 + c0 * c2 + d0 * d2, a1 * a1 + b1 * b1 + c1 * c1 + d1 * d1
        yz, zz = a1 * a2 + b1 * b2 + c1 * c2 + d1 * d2, a2 * a2 + b2 * b2 + c2 * c2 + d2 * d2
        qx = a0 * a3 + b0 * b3 + c0 * c3 + d0 * d3
        qy = a1 * a3 + b1 * b3 + c1 * c3 + d1 * d3
        qz = a2 * a3 + b2 * b3 + c2 * c3 + d2 * d3
        ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        iyy, iyz, izz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        scale = 1.0 / (xx * ixx + xy * ixy + xz * ixz)
        # Least squares with the last coordinate 1: X = -P^-1 q.
        x = -(ixx * qx + ixy * qy + ixz * qz) * scale
        y = -(ixy * qx + iyy * qy + iyz * qz) * scale
        z = -(ixz * qx + iyz * qy + izz * qz) * scale
        # One step of inverse iteration from there: X + P^-1 X |A X|^2 / (1 + |X|^2).
        ra, rb = a0 * x + a1 * y + a2 * z + a3, b0 * x + b1 * y + b2 * z + b3
        rc, rd = c0 * x + c1 * y + c2 * z + c3, d0 * x + d1 * y + d2 * z + d3
        eigen = (ra * ra + rb * rb + rc * rc + rd * rd) / (1.0 + x * x + y * y + z * z) * scale
        out[0, i] = x + eigen * (ixx * x + ixy * y + ixz * z)
        out[1, i] = y + eigen * (ixy * x + iyy * y + iyz * z)
        out[2, i] = z + eigen * (ixz * x + iyz * y + izz * z)


@njit(cache=True, nogil=True)
def stereo_points(left: Matrix, right: Matrix, left_px: Points, right_px: Points, out: Points) -> None:
    """Fill `out` (n, 3) with the stereo points of n pairs; see `triangulate.stereo`."""
    px, xyz = np.empty((4, BLOCK)), np.empty((3, BLOCK))
    for start in range(0, left_px.shape[0], BLOCK):
        count = min(BLOCK, left_px.shape[0] - start)
        for i in range(count):
            px[0, i], px[1, i] = left_px[start + i, 0], left_px[start + i, 1]
            px[2, i], px[3, i] = right_px[start + i, 0], right_px[start + i, 1]
        stereo_block(left, right, px, count, xyz)
        for i in range(count):
            out[start + i, 0], out[start + i, 1], out[start + i, 2] = xyz[0, i], xyz[1, i], xyz[2, i]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def active_points(m: Matrix, points_px: Points, out: Points) -> None:
    """Fill `out` (n, 3) with the active points of image points (n, 2); see `triangulate.active`."""
    for i in range(points_px.shape[0]):
        u, v = points_px[i, 0], points_px[i, 1]
        scale = 1.0 / (m[3, 0] * u + m[3, 1] * v + m[3, 2])
        out[i, 0] = (m[0, 0] * u + m[0, 1] * v + m[0, 2]) * scale
        out[i, 1] = (m[1, 0] * u + m[1, 1] * v + m[1, 2]) * scale
        out[i, 2] = (m[2, 0] * u + m[2, 1] * v + m[2, 2]) * scale


@njit(cache=True, nogil=True)
def plane_from_pixel(centre: Points, ray_matrix: Matrix, normal: Points, distance: float) -> Matrix:
    """See `triangulate.plane_from_pixel`."""
    out = np.empty((4, 3))
    along = normal[0] * centre[0] + normal[1] * centre[1] + normal[2] * centre[2]
    for k in range(3):
        out[3, k] = normal[0] * ray_matrix[0, k] + normal[1] * ray_matrix[1, k] + normal[2] * ray_matrix[2, k]
        for i in range(3):
            out[i, k] = centre[i] * out[3, k] + (distance - along) * ray_matrix[i, k]
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def active_block(m: Matrix, px: Points, out: Points) -> None:
    """Fill `out` (3, n) with the active points of image points (2, n); see `triangulate.active_columns`."""
    # Into names first: the compiler cannot know that the loop's results do not change them.
    m00, m01, m02, m10, m11, m12 = m[0, 0], m[0, 1], m[0, 2], m[1, 0], m[1, 1], m[1, 2]
    m20, m21, m22, m30, m31, m32 = m[2, 0], m[2, 1], m[2, 2], m[3, 0], m[3, 1], m[3, 2]
    for i in range(px.shape[1]):
        u, v = px[0, i], px[1, i]
        scale = 1.0 / (m30 * u + m31 * v + m32)
        out[0, i] = (m00 * u + m01 * v + m02) * scale
        out[1, i] = (m10 * u + m11 * v + m12) * scale
        out[2, i] = (m20 * u + m21 * v + m22) * scale
