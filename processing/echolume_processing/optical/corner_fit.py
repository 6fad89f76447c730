"""Sub-pixel chessboard corners by fitting two blurred edges that cross, in a window that follows the board's shape."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_messages.types import Frame

Points2 = NDArray[np.float64]
Value = NDArray[np.float64]

REACH = 0.42
"""Half size of the window in squares; the squares' other edges lie at 1, their blur must stay outside."""
MAX_REACH_PX = 16.0
"""Larger windows gain little and cost time."""
MIN_PIXELS = 25
PARAMETERS = 9
ROUNDS = 15
STOP_PX = 1e-5
START_BLUR_PX = 1.2
MIN_BLUR_PX, MAX_BLUR_PX = 0.3, 6.0
MAX_SHIFT = 0.25
"""A corner that leaves its start by more than this share of a square has been lost: it stays where it was."""


@njit(cache=True, nogil=True)
def _solve(matrix: Value, right: Value, size: int) -> bool:
    """Solve in place by elimination with pivots, the answer in `right`; False if singular."""
    for k in range(size):
        pivot = k
        for i in range(k + 1, size):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if abs(matrix[pivot, k]) < 1e-12:
            return False
        if pivot != k:
            for j in range(size):
                matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
            right[k], right[pivot] = right[pivot], right[k]
        for i in range(k + 1, size):
            factor = matrix[i, k] / matrix[k, k]
            for j in range(k, size):
                matrix[i, j] -= factor * matrix[k, j]
            right[i] -= factor * right[k]
    for k in range(size - 1, -1, -1):
        for j in range(k + 1, size):
            right[k] -= matrix[k, j] * right[j]
        right[k] /= matrix[k, k]
    return True


@njit(cache=True, nogil=True)
def _window(image: Frame, x0: float, y0: float, half_u: Value, half_v: Value, out: Value) -> int:
    """Pixels (x, y, value, root of the weight) of the parallelogram around (x0, y0), x and y relative to it."""
    height, width = image.shape
    det = half_u[0] * half_v[1] - half_u[1] * half_v[0]
    if abs(det) < 1e-9:
        return 0
    reach_x, reach_y = abs(half_u[0]) + abs(half_v[0]), abs(half_u[1]) + abs(half_v[1])
    count = 0
    for row in range(max(math.ceil(y0 - reach_y), 0), min(int(y0 + reach_y), height - 1) + 1):
        for column in range(max(math.ceil(x0 - reach_x), 0), min(int(x0 + reach_x), width - 1) + 1):
            x, y = column - x0, row - y0
            a, b = (x * half_v[1] - y * half_v[0]) / det, (half_u[0] * y - half_u[1] * x) / det
            if abs(a) < 1.0 and abs(b) < 1.0 and count < out.shape[0]:
                out[count, 0], out[count, 1], out[count, 2] = x, y, float(image[row, column])
                out[count, 3] = math.sqrt((1.0 - a * a) * (1.0 - b * b))
                count += 1
    return count


@njit(cache=True, nogil=True)
def _start(pixels: Value, count: int, p: Value) -> None:
    """Brightness and contrast (parameters 5 and 6) by least squares, the edges given."""
    s_w = s_m = s_mm = s_v = s_mv = 0.0
    for i in range(count):
        w = pixels[i, 3] * pixels[i, 3]
        d1 = -math.sin(p[2]) * pixels[i, 0] + math.cos(p[2]) * pixels[i, 1]
        d2 = -math.sin(p[3]) * pixels[i, 0] + math.cos(p[3]) * pixels[i, 1]
        m = math.erf(d1 / p[4]) * math.erf(d2 / p[4])
        s_w += w
        s_m += w * m
        s_mm += w * m * m
        s_v += w * pixels[i, 2]
        s_mv += w * m * pixels[i, 2]
    det = s_w * s_mm - s_m * s_m
    p[6] = (s_w * s_mv - s_m * s_v) / det if det > 1e-9 else 1.0
    p[5] = (s_v - p[6] * s_m) / s_w


@njit(cache=True, nogil=True)
def _step(pixels: Value, count: int, p: Value, normal: Value, right: Value, lever: float) -> float:
    """Normal equations at p, (x, y, angle 1, angle 2, blur, level, contrast, slope x, slope y); the cost."""
    normal[:] = 0.0
    right[:] = 0.0
    j = np.empty(PARAMETERS)
    sin1, cos1, sin2, cos2 = math.sin(p[2]), math.cos(p[2]), math.sin(p[3]), math.cos(p[3])
    scale = 2.0 / math.sqrt(math.pi)
    cost = 0.0
    for i in range(count):
        x, y, w = pixels[i, 0] - p[0], pixels[i, 1] - p[1], pixels[i, 3]
        d1, d2 = (-sin1 * x + cos1 * y) / p[4], (-sin2 * x + cos2 * y) / p[4]
        e1, e2 = math.erf(d1), math.erf(d2)
        g1, g2 = p[6] * scale * math.exp(-d1 * d1) * e2, p[6] * scale * math.exp(-d2 * d2) * e1
        j[0] = w * (g1 * sin1 + g2 * sin2) / p[4]
        j[1] = -w * (g1 * cos1 + g2 * cos2) / p[4]
        j[2] = -w * g1 * (cos1 * x + sin1 * y) / p[4]
        j[3] = -w * g2 * (cos2 * x + sin2 * y) / p[4]
        j[4] = -w * (g1 * d1 + g2 * d2) / p[4]
        j[5] = w
        j[6] = w * e1 * e2
        j[7] = w * pixels[i, 0] / lever
        j[8] = w * pixels[i, 1] / lever
        value = p[5] + p[6] * e1 * e2 + (p[7] * pixels[i, 0] + p[8] * pixels[i, 1]) / lever
        residual = w * (pixels[i, 2] - value)
        cost += residual * residual
        for a in range(PARAMETERS):
            right[a] += j[a] * residual
            for b in range(a, PARAMETERS):
                normal[a, b] += j[a] * j[b]
    for a in range(PARAMETERS):
        for b in range(a):
            normal[a, b] = normal[b, a]
    return cost


@njit(cache=True, nogil=True)
def _fit(pixels: Value, count: int, p: Value, reach: float) -> bool:
    """Levenberg-Marquardt from p; False if it does not settle within `MAX_SHIFT` of the start."""
    normal, right = np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    trial, work, step = np.empty(PARAMETERS), np.empty((PARAMETERS, PARAMETERS)), np.empty(PARAMETERS)
    damping = 1e-3
    cost = _step(pixels, count, p, normal, right, reach)
    for _ in range(ROUNDS):
        work[:] = normal
        step[:] = right
        for a in range(PARAMETERS):
            work[a, a] *= 1.0 + damping
        if not _solve(work, step, PARAMETERS):
            return False
        for a in range(PARAMETERS):
            trial[a] = p[a] + step[a]
        trial[4] = min(max(trial[4], MIN_BLUR_PX), MAX_BLUR_PX)
        work[:] = normal
        before = right.copy()
        new_cost = _step(pixels, count, trial, normal, right, reach)
        if new_cost < cost:
            p[:] = trial
            cost = new_cost
            damping *= 0.1
            if math.hypot(step[0], step[1]) < STOP_PX:
                break
        else:
            normal[:] = work
            right[:] = before
            damping *= 10.0
            if damping > 1e6:
                break
    return math.hypot(p[0], p[1]) < MAX_SHIFT * reach / REACH


@njit(cache=True, nogil=True)
def _refine(image: Frame, points: Points2, u: Points2, v: Points2, reach: float, out: Points2, blur_px: Value) -> None:
    pixels = np.empty((int(8 * MAX_REACH_PX * MAX_REACH_PX), 4))
    p = np.empty(PARAMETERS)
    for k in range(points.shape[0]):
        half_u = u[k] * min(reach, MAX_REACH_PX / math.hypot(u[k, 0], u[k, 1]))
        half_v = v[k] * min(reach, MAX_REACH_PX / math.hypot(v[k, 0], v[k, 1]))
        count = _window(image, points[k, 0], points[k, 1], half_u, half_v, pixels)
        out[k] = points[k]
        blur_px[k] = np.nan
        if count < MIN_PIXELS:
            continue
        p[:] = 0.0
        p[2], p[3], p[4] = math.atan2(u[k, 1], u[k, 0]), math.atan2(v[k, 1], v[k, 0]), START_BLUR_PX
        _start(pixels, count, p)
        span_px = max(math.hypot(half_u[0], half_u[1]), math.hypot(half_v[0], half_v[1]))
        if _fit(pixels, count, p, span_px):
            out[k, 0] += p[0]
            out[k, 1] += p[1]
            blur_px[k] = p[4] / math.sqrt(2.0)


def refine_corners(
    image: Frame, points_px: Points2, along_x_px: Points2, along_y_px: Points2, reach: float = REACH
) -> tuple[Points2, Value]:
    """Corners of a board to about a hundredth of a pixel.

    Parameters
    ----------
    image : (rows, columns) uint8
        A view of the board, not undistorted.
    points_px : (n, 2) float64
        Corners to within about two pixels.
    along_x_px, along_y_px : (n, 2) float64
        One square along the board's x and y at each corner, as seen in the image.
    reach : float
        Half size of each corner's window, in squares.

    Returns
    -------
    corners_px : (n, 2) float64
        A corner that cannot be fitted stays where it was.
    blur_px : (n,) float64
        Standard deviation of the edges' blur; nan where the fit failed.

    Notes
    -----
    Around a corner the print is ``level + contrast * erf(d1 / blur) * erf(d2 / blur)`` with d1, d2 the distances from
    the two edges, plus a slope of the light. All nine parameters are fitted to the raw pixels of a parallelogram that
    follows the squares, weighted down towards its rim; nothing is resampled. The blur is taken as round.
    """
    require_shape("points_px", points_px, (None, 2))
    for name, value in (("along_x_px", along_x_px), ("along_y_px", along_y_px)):
        require_shape(name, value, (len(points_px), 2))
    out, blur_px = np.empty((len(points_px), 2)), np.empty(len(points_px))
    points, u, v = (np.ascontiguousarray(a, dtype=np.float64) for a in (points_px, along_x_px, along_y_px))
    _refine(np.ascontiguousarray(image), points, u, v, reach, out, blur_px)
    return out, blur_px
