"""Compiled search for channels that contradict all others, by the hat matrix of the closed forms instead of refits."""

from __future__ import annotations

import numpy as np
from numba import njit

from echolume_processing.ultrasonic.contact_kernels import (
    OPEN_X,
    OPEN_Y,
    SQUARE,
    SURE,
    Floats,
    Four,
    H,
    Six,
    times,
)

Left = tuple[int, int, float]
"""Channels to leave out, -1 for none, and chi-squared per degree of freedom without them."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def hat_rows(
    layout: Floats, length: Floats, weight: Floats, u: Four, m: Six, point: bool, a: Floats, b: Floats, e: Floats
) -> float:
    """Fill, for each channel, its scaled row (n, 3), the inverse normal matrix times it (n, 3), and its residual (n,)
    in sigmas of path; returns the residuals' sum of squares."""
    unit = 1.0 if point else 0.5  # a residual of the equation is the path's times 2 L for a plane, about L for a point
    total = 0.0
    for k in range(layout.shape[0]):
        root = np.sqrt(weight[k]) / length[k]
        x, y, c = layout[k, OPEN_X], layout[k, OPEN_Y], (length[k] if point else 1.0)
        a[k, 0], a[k, 1], a[k, 2] = root * x, root * y, root * c
        b[k, 0], b[k, 1], b[k, 2] = times(m, a[k, 0], a[k, 1], a[k, 2])
        known = length[k] * length[k] - layout[k, SQUARE] + 2.0 * layout[k, H] * u[3]
        e[k] = unit * root * (known - x * u[0] - y * u[1] - c * u[2])
        total += e[k] * e[k]
    return total


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def contradiction(
    layout: Floats,
    length: Floats,
    weight: Floats,
    u: Four,
    m: Six,
    point: bool,
    freedom: int,
    most: int,
    limits: Floats,
) -> Left:
    """One channel, or two, without which all others agree: further off than the least slip, and beyond doubt.

    `limits` are the largest chi-squared per degree of freedom, the least slip in mm and in sigmas.
    """
    n = layout.shape[0]
    nobody = (-1, -1, np.inf)
    if np.isnan(u[0]):
        return nobody
    a, b, e = np.empty((n, 3)), np.empty((n, 3)), np.empty(n)
    total = hat_rows(layout, length, weight, u, m, point, a, b, e)
    if most >= 1 and freedom >= 2:
        best, second, at, off = np.inf, np.inf, -1, 0.0
        for k in range(n):
            if weight[k] > 0.0:
                rest = 1.0 - (a[k, 0] * b[k, 0] + a[k, 1] * b[k, 1] + a[k, 2] * b[k, 2])
                chi = total - e[k] * e[k] / rest
                if chi < best:
                    best, second, at, off = chi, best, k, abs(e[k] / rest)
                elif chi < second:
                    second = chi
        least = max(limits[1] * np.sqrt(weight[at]), limits[2])
        if best <= limits[0] * (freedom - 1) and off >= least and second - best >= SURE:
            return at, -1, best / (freedom - 1)
    if most >= 2 and freedom >= 3:
        best, second, i_at, j_at, off_i, off_j = np.inf, np.inf, -1, -1, 0.0, 0.0
        for i in range(n):
            if weight[i] > 0.0:
                ii = 1.0 - (a[i, 0] * b[i, 0] + a[i, 1] * b[i, 1] + a[i, 2] * b[i, 2])
                for j in range(i):
                    if weight[j] > 0.0:
                        jj = 1.0 - (a[j, 0] * b[j, 0] + a[j, 1] * b[j, 1] + a[j, 2] * b[j, 2])
                        ij = -(a[i, 0] * b[j, 0] + a[i, 1] * b[j, 1] + a[i, 2] * b[j, 2])
                        det = ii * jj - ij * ij
                        if det < 1e-9:
                            continue
                        di, dj = (jj * e[i] - ij * e[j]) / det, (ii * e[j] - ij * e[i]) / det
                        chi = total - e[i] * di - e[j] * dj
                        if chi < best:
                            best, second, i_at, j_at, off_i, off_j = chi, best, i, j, abs(di), abs(dj)
                        elif chi < second:
                            second = chi
        least_i = max(limits[1] * np.sqrt(weight[i_at]), limits[2])
        least_j = max(limits[1] * np.sqrt(weight[j_at]), limits[2])
        sure = off_i >= least_i and off_j >= least_j and second - best >= SURE
        if best <= limits[0] * (freedom - 2) and sure:
            return i_at, j_at, best / (freedom - 2)
    return nobody
