"""Compiled least squares of several echoes in one channel, the complex heights eliminated (variable projection).

Everything is told by the matched filter's output b, its derivative, and the template's own correlation R with its first
two derivatives: angles are times, and all are taken about the bin `centre`, so that they turn slowly.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_processing.ultrasonic.echo_kernels import moments

Values = NDArray[np.float64]
Spectra = NDArray[np.complex64]
Complex = NDArray[np.complex128]

ROUNDS = 40
LIKE = 0.995
"""Correlation of two templates beyond which they are the same echo."""


@njit(cache=True, nogil=True, error_model="numpy")
def eliminate(matrix: NDArray[Any], right: NDArray[Any]) -> bool:
    """Gauss's elimination in place: `right` (n, m) becomes the solution; False if the matrix (n, n) is singular.

    Far quicker to compile than a call of LAPACK, and as quick to run at this size.
    """
    count = len(matrix)
    for k in range(count):
        pivot = k
        for i in range(k + 1, count):
            if abs(matrix[i, k]) > abs(matrix[pivot, k]):
                pivot = i
        if not abs(matrix[pivot, k]) > 0.0:
            return False
        for j in range(count):
            matrix[k, j], matrix[pivot, j] = matrix[pivot, j], matrix[k, j]
        for j in range(right.shape[1]):
            right[k, j], right[pivot, j] = right[pivot, j], right[k, j]
        for i in range(count):
            if i != k:
                share = matrix[i, k] / matrix[k, k]
                for j in range(k, count):
                    matrix[i, j] -= share * matrix[k, j]
                for j in range(right.shape[1]):
                    right[i, j] -= share * right[k, j]
    for k in range(count):
        for j in range(right.shape[1]):
            right[k, j] /= matrix[k, k]
    return True


@njit(cache=True, nogil=True, error_model="numpy")
def pair_start(
    products: Spectra, pulse: Spectra, centre: float, middle: float, half: float, points: int, out: Values
) -> None:
    """The two angles on a grid around `middle` whose echoes explain most, ascending."""
    work = np.empty(6)
    b, correlation = np.empty(points, dtype=np.complex128), np.empty(points, dtype=np.complex128)
    step = 2 * half / (points - 1)
    for k in range(points):
        moments(products, centre, middle - half + k * step, work)
        b[k] = complex(work[0], work[1])
        moments(pulse, centre, k * step, work)
        correlation[k] = complex(work[0], work[1])
    best = -1.0
    for i in range(points):
        for j in range(i + 1, points):
            r = correlation[j - i]
            share = r.real * r.real + r.imag * r.imag
            if share > LIKE * LIKE:
                continue
            # R(i - j) is the conjugate of R(j - i)
            cross = (b[i].conjugate() * r.conjugate() * b[j]).real
            explained = (abs(b[i]) ** 2 + abs(b[j]) ** 2 - 2 * cross) / (1 - share)
            if explained > best:
                best = explained
                out[0], out[1] = middle - half + i * step, middle - half + j * step


@njit(cache=True, nogil=True, error_model="numpy")
def _state(
    products: Spectra, pulse: Spectra, centre: float, angles: Values, height: Complex, normal: Values, right: Values
) -> float:
    """Heights for given angles, normal equations of the angles, and what the echoes explain; -1 if two coincide."""
    count = len(angles)
    work = np.empty(6)
    b, slope = np.empty(count, dtype=np.complex128), np.empty(count, dtype=np.complex128)
    gram = np.empty((count, count), dtype=np.complex128)
    first = np.empty((count, count), dtype=np.complex128)
    second = np.empty((count, count), dtype=np.complex128)
    for i in range(count):
        moments(products, centre, angles[i], work)
        b[i], slope[i] = complex(work[0], work[1]), complex(work[2], work[3])
        for j in range(i, count):
            moments(pulse, centre, angles[i] - angles[j], work)
            gram[i, j], first[i, j] = complex(work[0], work[1]), complex(work[2], work[3])
            second[i, j] = complex(work[4], work[5])
            if j > i:
                if abs(gram[i, j]) > LIKE:
                    return -1.0
                gram[j, i], first[j, i] = gram[i, j].conjugate(), -first[i, j].conjugate()
                second[j, i] = second[i, j].conjugate()
    solved = np.empty((count, count + 1), dtype=np.complex128)
    for i in range(count):
        solved[i, count] = b[i]
        for j in range(count):
            solved[i, j] = first[i, j]
    if not eliminate(gram, solved):
        return -1.0
    explained = 0.0
    for i in range(count):
        height[i] = solved[i, count]
        explained += (b[i].conjugate() * height[i]).real
    for i in range(count):
        left = slope[i]
        for k in range(count):
            left -= first[i, k] * height[k]
        right[i] = (height[i].conjugate() * left).real
        for j in range(count):
            # <d_i, d_j> less what the templates themselves take of it
            projected = -second[i, j]
            for k in range(count):
                projected += first[i, k] * solved[k, j]
            normal[i, j] = (height[i].conjugate() * height[j] * projected).real
    return explained


@njit(cache=True, nogil=True, error_model="numpy")
def fit_echoes(
    products: Spectra,
    pulse: Spectra,
    centre: float,
    least: float,
    most: float,
    angles: Values,
    height: Complex,
    covariance: Values,
) -> float:
    """Refine angles in place by Levenberg's steps; what the echoes explain, or -1 where two of them coincide.

    `height` (count,) receives the complex heights about `centre`, `covariance` (count, count) that of the angles for
    noise of 1 in the real part of the matched filter's output.
    """
    count = len(angles)
    normal, right = np.empty((count, count)), np.empty(count)
    trial_height = np.empty(count, dtype=np.complex128)
    trial_normal, trial_right = np.empty((count, count)), np.empty(count)
    explained = _state(products, pulse, centre, angles, height, normal, right)
    if explained < 0:
        return -1.0
    damping = 1e-3
    damped, change, trial = np.empty((count, count)), np.empty((count, 1)), np.empty(count)
    for _ in range(ROUNDS):
        for i in range(count):
            change[i, 0] = right[i]
            for j in range(count):
                damped[i, j] = normal[i, j] * (1 + damping if i == j else 1.0)
        if not eliminate(damped, change):
            return -1.0
        for i in range(count):
            trial[i] = min(max(angles[i] + change[i, 0], least), most)
        reached = _state(products, pulse, centre, trial, trial_height, trial_normal, trial_right)
        if reached > explained:
            settled = reached - explained < 1e-9 * reached
            for i in range(count):
                angles[i], height[i], right[i] = trial[i], trial_height[i], trial_right[i]
                for j in range(count):
                    normal[i, j] = trial_normal[i, j]
            explained = reached
            damping = max(0.2 * damping, 1e-9)
            if settled:
                break
        else:
            damping *= 8
            if damping > 1e9:
                break
    for i in range(count):
        for j in range(count):
            covariance[i, j] = 1.0 if i == j else 0.0
    return explained if eliminate(normal, covariance) else -1.0
