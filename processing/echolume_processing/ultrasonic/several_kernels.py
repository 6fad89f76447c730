"""Compiled least squares of several echoes in one channel, the complex heights eliminated (variable projection).

Everything is told by the matched filter's output b, its derivative, and the template's own correlation R with its first
two derivatives: angles are times, and all are taken about the bin `centre`, so that they turn slowly.
"""

from __future__ import annotations

import math

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
    height[:] = np.linalg.solve(gram, b)
    left = slope - first @ height
    # <d_k, d_l> less what the templates themselves take of it
    projected = -second + first @ np.linalg.solve(gram, first)
    explained = 0.0
    for i in range(count):
        explained += (b[i].conjugate() * height[i]).real
        right[i] = (height[i].conjugate() * left[i]).real
        for j in range(count):
            normal[i, j] = (height[i].conjugate() * height[j] * projected[i, j]).real
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
    for _ in range(ROUNDS):
        damped = normal.copy()
        for i in range(count):
            damped[i, i] = damped[i, i] * (1 + damping) + 1e-30
        if not math.isfinite(np.sum(damped)) or np.linalg.det(damped) == 0.0:
            return -1.0
        change = np.linalg.solve(damped, right)
        trial = np.minimum(np.maximum(angles + change, least), most)
        reached = _state(products, pulse, centre, trial, trial_height, trial_normal, trial_right)
        if reached > explained:
            settled = reached - explained < 1e-9 * reached
            angles[:], height[:], normal[:], right[:] = trial, trial_height, trial_normal, trial_right
            explained = reached
            damping = max(0.2 * damping, 1e-9)
            if settled:
                break
        else:
            damping *= 8
            if damping > 1e9:
                break
    for i in range(count):
        normal[i, i] += 1e-30
    if not math.isfinite(np.sum(normal)) or np.linalg.det(normal) == 0.0:
        return -1.0
    covariance[:] = np.linalg.inv(normal)
    return explained
