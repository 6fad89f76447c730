"""Compiled lens distortion: image points to undistorted ones by Newton's method."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Values = NDArray[np.float64]

STEPS = 3
"""Newton steps that every point takes; those that are not done by then go on one by one."""
MORE_STEPS = 20
DONE = 1e-6
"""Length of a step, of normalised coordinates, after which the next would be its square."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _step(x: float, y: float, x0: float, y0: float, k: Values) -> tuple[float, float]:
    """Newton's step from (x, y) towards the point that the lens moves to (x0, y0); k is k1, k2, p1, p2, k3."""
    k1, k2, p1, p2, k3 = k[5], k[6], k[7], k[8], k[9]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
    slope = 2.0 * (k1 + r2 * (2.0 * k2 + 3.0 * r2 * k3))
    off_x = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x) - x0
    off_y = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y - y0
    a = radial + x * x * slope + 2.0 * p1 * y + 6.0 * p2 * x
    b = x * y * slope + 2.0 * p1 * x + 2.0 * p2 * y
    d = radial + y * y * slope + 6.0 * p1 * y + 2.0 * p2 * x
    scale = 1.0 / (a * d - b * b)
    return (d * off_x - b * off_y) * scale, (a * off_y - b * off_x) * scale


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def undistort(u: Values, v: Values, lens: Values, out_u: Values, out_v: Values) -> None:
    """Fill `out_u`, `out_v` (n,) with the undistorted points of image points `u`, `v` (n,); see `Camera.lens`."""
    fx, skew, cx, fy, cy = lens[0], lens[1], lens[2], lens[3], lens[4]
    moved = np.empty(len(u))
    # No branch in this loop: the compiler takes several points at once.
    for i in range(len(u)):
        y0 = (v[i] - cy) / fy
        x0 = (u[i] - cx - skew * y0) / fx
        x, y = x0, y0
        step_x, step_y = 0.0, 0.0
        for _ in range(STEPS):
            step_x, step_y = _step(x, y, x0, y0, lens)
            x -= step_x
            y -= step_y
        out_u[i], out_v[i], moved[i] = x, y, abs(step_x) + abs(step_y)
    for i in range(len(u)):
        if moved[i] > DONE:
            y0 = (v[i] - cy) / fy
            x0 = (u[i] - cx - skew * y0) / fx
            for _ in range(MORE_STEPS):
                step_x, step_y = _step(out_u[i], out_v[i], x0, y0, lens)
                out_u[i] -= step_x
                out_v[i] -= step_y
                if not abs(step_x) + abs(step_y) > DONE:
                    break
    for i in range(len(u)):
        x, y = out_u[i], out_v[i]
        out_u[i] = fx * x + skew * y + cx
        out_v[i] = fy * y + cy
