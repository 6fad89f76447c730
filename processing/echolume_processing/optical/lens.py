"""Compiled lens distortion, one image point at a time."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

MAX_ITERATIONS = 20


@njit(cache=True, nogil=True, error_model="numpy")
def undistort_point(u: float, v: float, lens: NDArray[np.float64]) -> tuple[float, float]:
    """Undistorted pixel coordinates of an image point, by Newton's method; `lens` is `Camera.lens`."""
    fx, skew, cx, fy, cy = lens[0], lens[1], lens[2], lens[3], lens[4]
    k1, k2, p1, p2, k3 = lens[5], lens[6], lens[7], lens[8], lens[9]
    y0 = (v - cy) / fy
    x0 = (u - cx - skew * y0) / fx
    x, y = x0, y0
    for _ in range(MAX_ITERATIONS):
        r2 = x * x + y * y
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
        off_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - x0
        off_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - y0
        a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
        b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
        d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
        scale = 1.0 / (a * d - b * b)
        step_x, step_y = (d * off_x - b * off_y) * scale, (a * off_y - b * off_x) * scale
        x -= step_x
        y -= step_y
        if not abs(step_x) + abs(step_y) > 1e-6:  # the next step would be its square
            break
    return fx * x + skew * y + cx, fy * y + cy


@njit(cache=True, nogil=True, error_model="numpy")
def distorted_row(u: float, v: float, lens: NDArray[np.float64]) -> float:
    """Image row at which the camera shows an undistorted point."""
    y = (v - lens[4]) / lens[3]
    x = (u - lens[2] - lens[1] * y) / lens[0]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (lens[5] + r2 * (lens[6] + r2 * lens[9]))
    return lens[3] * (y * radial + lens[7] * (r2 + 2.0 * y * y) + 2.0 * lens[8] * x * y) + lens[4]


@njit(cache=True, nogil=True)
def undistort_points(points: NDArray[np.float64], lens: NDArray[np.float64], out: NDArray[np.float64]) -> None:
    """Fill `out` (n, 2) with the undistorted image points of `points` (n, 2)."""
    for i in range(points.shape[0]):
        out[i, 0], out[i, 1] = undistort_point(points[i, 0], points[i, 1], lens)
