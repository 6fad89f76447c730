"""Compiled choice of the carrier's cycles of one ping, with a plane or a point as what its paths have in common."""

from __future__ import annotations

import math

import numpy as np
from numba import njit
from numpy.typing import NDArray

Values = NDArray[np.float64]

PLANE, POINT = 0, 1
STEPS = 12


@njit(cache=True, nogil=True, error_model="numpy")
def predict(model: int, receivers: Values, at: Values, path: Values, slope: Values) -> None:
    """Paths (n,) and their derivatives (n, 3) for the emitter's image in a plane, or a point, at `at` (3,)."""
    there = math.sqrt(at[0] ** 2 + at[1] ** 2 + at[2] ** 2) if model == POINT else 0.0
    for i in range(len(receivers)):
        x, y, z = at[0] - receivers[i, 0], at[1] - receivers[i, 1], at[2] - receivers[i, 2]
        back = math.sqrt(x * x + y * y + z * z)
        path[i] = back + there
        slope[i, 0], slope[i, 1], slope[i, 2] = x / back, y / back, z / back
        if model == POINT:
            for k in range(3):
                slope[i, k] += at[k] / there


@njit(cache=True, nogil=True, error_model="numpy")
def fit(model: int, receivers: Values, paths: Values, sigma: float, at: Values, path: Values, slope: Values) -> float:
    """Least squares from `at`, in place; chi-squared, infinite if it runs away. `path` receives the model's paths."""
    predict(model, receivers, at, path, slope)
    for _ in range(STEPS):
        xx = xy = xz = yy = yz = zz = x = y = z = 0.0
        for i in range(len(paths)):
            a, b, c, left = slope[i, 0], slope[i, 1], slope[i, 2], paths[i] - path[i]
            xx, xy, xz, yy, yz, zz = xx + a * a, xy + a * b, xz + a * c, yy + b * b, yz + b * c, zz + c * c
            x, y, z = x + a * left, y + b * left, z + c * left
        # the inverse by its minors
        ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
        iyy, iyz, izz = xx * zz - xz * xz, xy * xz - xx * yz, xx * yy - xy * xy
        whole = xx * ixx + xy * ixy + xz * ixz
        if not whole > 0.0:
            return math.inf
        dx, dy = (ixx * x + ixy * y + ixz * z) / whole, (ixy * x + iyy * y + iyz * z) / whole
        dz = (ixz * x + iyz * y + izz * z) / whole
        at[0], at[1], at[2] = at[0] + dx, at[1] + dy, at[2] + dz
        if not at[2] > 0.0:
            return math.inf
        predict(model, receivers, at, path, slope)
        if abs(dx) + abs(dy) + abs(dz) < 1e-6:
            break
    total = 0.0
    for i in range(len(paths)):
        total += ((paths[i] - path[i]) / sigma) ** 2
    return total


@njit(cache=True, nogil=True, error_model="numpy")
def settle(
    receivers: Values,
    coarse: Values,
    coarse_sigma: Values,
    fine: Values,
    fine_sigma: float,
    wavelength: float,
    best: Values,
    scores: Values,
) -> None:
    """Whole wavelengths added to `fine` so that one model explains it and `coarse` is not contradicted.

    `best` (n,) receives the paths; `scores` (3,) chi-squared of the fine paths, the sum that was minimised, and that of
    the next best choice.
    """
    count = len(fine)
    path, slope = np.empty(count), np.empty((count, 3))
    trial, at, middle = np.empty(count), np.empty(3), 0.0
    for i in range(count):
        middle += coarse[i] / count
    scores[:] = math.inf
    for model in (PLANE, POINT):
        at[0], at[1], at[2] = 0.0, 0.0, middle if model == PLANE else 0.5 * middle
        if not math.isfinite(fit(model, receivers, coarse, 1.0, at, path, slope)):
            continue
        begin = path.copy()
        for common in (0, 1, -1, 2, -2):
            for i in range(count):
                aim = begin[i] + common * wavelength
                trial[i] = fine[i] + wavelength * math.floor((aim - fine[i]) / wavelength + 0.5)
            chi = math.inf
            for _ in range(4):
                chi = fit(model, receivers, trial, fine_sigma, at, path, slope)
                if not math.isfinite(chi):
                    break
                moved = False
                for i in range(count):
                    turns = math.floor((path[i] - trial[i]) / wavelength + 0.5)
                    if turns != 0:
                        trial[i] += turns * wavelength
                        moved = True
                if not moved:
                    break
            if not math.isfinite(chi):
                at[0], at[1], at[2] = 0.0, 0.0, middle if model == PLANE else 0.5 * middle
                fit(model, receivers, coarse, 1.0, at, path, slope)
                continue
            total = chi
            for i in range(count):
                total += ((trial[i] - coarse[i]) / coarse_sigma[i]) ** 2
            same = True
            for i in range(count):
                same = same and abs(trial[i] - best[i]) < 0.5 * wavelength
            if total < scores[1]:
                if not same and math.isfinite(scores[1]):
                    scores[2] = scores[1]
                scores[0], scores[1] = chi, total
                best[:] = trial
            elif not same:
                scores[2] = min(scores[2], total)
