"""The compiled way of a batch of pings: both models, slips left out, the choice, contact points and covariances."""

from __future__ import annotations

import numpy as np
from numba import njit

from echolume_processing.ultrasonic.contact_kernels import (
    FOOT_COV,
    KIND,
    NONE,
    NORMAL,
    NORMAL_COV,
    PLANE,
    PLANE_CHI,
    POINT,
    POINT_CHI,
    POINTS,
    RANK,
    TARGET,
    Flags,
    Floats,
    Four,
    H,
    Six,
    Triple,
    X,
    Y,
    chi_squared,
    fit_both,
    information,
    inverse,
    refined,
    times,
    with_common,
)
from echolume_processing.ultrasonic.slip_kernels import contradiction

MAX_CHI, SLIP_MM, SLIP_SIGMAS, MIN_COSINE, ALLOWED, ASSUME, COMMON_MM = 0, 1, 2, 3, 4, 5, 6
"""What the settings of a batch are. `ALLOWED`: 1 plane, 2 point, 3 both; `ASSUME`: believe a plane where the paths are
too few to test one."""
MOST_SLIPS = 2


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def spread(row: Floats, at: int, c: Six, s: float) -> None:
    """Write a symmetric matrix times a number into a row."""
    for k in range(6):
        row[at + k] = c[k] * s


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def write_normal(row: Floats, t: Triple, c: Six) -> None:
    """Normal towards the array, and its covariance: what is across of the target's, over its distance."""
    square = t[0] * t[0] + t[1] * t[1] + t[2] * t[2]
    s = -1.0 / np.sqrt(square)
    x, y, z = s * t[0], s * t[1], s * t[2]
    row[NORMAL], row[NORMAL + 1], row[NORMAL + 2] = x, y, z
    cx, cy, cz = times(c, x, y, z)
    along = x * cx + y * cy + z * cz
    across = (
        c[0] - 2.0 * x * cx + x * x * along,
        c[1] - x * cy - y * cx + x * y * along,
        c[2] - x * cz - z * cx + x * z * along,
        c[3] - 2.0 * y * cy + y * y * along,
        c[4] - y * cz - z * cy + y * z * along,
        c[5] - 2.0 * z * cz + z * z * along,
    )
    spread(row, NORMAL_COV, across, 1.0 / square)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def write_plane(row: Floats, layout: Floats, t: Triple, c: Six) -> None:
    """Where the sound of each receiver met the plane: on the line image -> receiver; with covariances."""
    n = layout.shape[0]
    row[TARGET], row[TARGET + 1], row[TARGET + 2] = 0.5 * t[0], 0.5 * t[1], 0.5 * t[2]
    spread(row, FOOT_COV, c, 0.25)
    half = 0.5 * (t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    for k in range(n):
        ax, ay, az = layout[k, X] - t[0], layout[k, Y] - t[1], layout[k, H] - t[2]
        d = -1.0 / (ax * t[0] + ay * t[1] + az * t[2])
        s = half * d
        at = POINTS + 3 * k
        row[at], row[at + 1], row[at + 2] = t[0] + s * ax, t[1] + s * ay, t[2] + s * az
        # d(contact) = (1 - s) dT + a (g . dT), g the gradient of s.
        gx = d * (t[0] * (1.0 - s) + s * ax)
        gy = d * (t[1] * (1.0 - s) + s * ay)
        gz = d * (t[2] * (1.0 - s) + s * az)
        cx, cy, cz = times(c, gx, gy, gz)
        m = 1.0 - s
        mm, q = m * m, 0.5 * (gx * cx + gy * cy + gz * cz)
        bx, by, bz = m * cx + q * ax, m * cy + q * ay, m * cz + q * az
        at = POINTS + 3 * n + 6 * k
        row[at] = mm * c[0] + 2.0 * ax * bx
        row[at + 1] = mm * c[1] + ax * by + ay * bx
        row[at + 2] = mm * c[2] + ax * bz + az * bx
        row[at + 3] = mm * c[3] + 2.0 * ay * by
        row[at + 4] = mm * c[4] + ay * bz + az * by
        row[at + 5] = mm * c[5] + 2.0 * az * bz


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def write_point(row: Floats, n: int, t: Triple, c: Six) -> None:
    """The point, and the same for each receiver."""
    row[TARGET], row[TARGET + 1], row[TARGET + 2] = t
    spread(row, FOOT_COV, c, 1.0)
    for k in range(n):
        at = POINTS + 3 * k
        row[at], row[at + 1], row[at + 2] = t
        spread(row, POINTS + 3 * n + 6 * k, c, 1.0)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def write_none(row: Floats, layout: Floats, paths: Floats, some: bool) -> None:
    """Each receiver for itself, as if the surface were perpendicular to the array's axis."""
    n = layout.shape[0]
    for k in range(TARGET, POINTS + 9 * n):
        row[k] = np.nan
    row[KIND], row[RANK] = NONE, 1.0 if some else 0.0
    row[NORMAL], row[NORMAL + 1], row[NORMAL + 2] = 0.0, 0.0, -1.0
    for k in range(n):
        x, y, h = layout[k, X], layout[k, Y], layout[k, H]
        deep = np.sqrt(max(paths[k] * paths[k] - x * x - y * y, 0.0)) if paths[k] > 0.0 else np.nan
        s = 0.5 * (deep + h) / deep if deep > 0.0 else 0.5
        at = POINTS + 3 * k
        row[at], row[at + 1], row[at + 2] = s * x, s * y, 0.5 * (deep + h)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def both(
    layout: Floats, ridge: Floats, length: Floats, weight: Floats, deep: bool
) -> tuple[Triple, Six, Four, float, Triple, Six, Four, float]:
    """Target, inverse normal matrix, unknowns and chi-squared of the plane, then of the point."""
    plane, m, u, point, p, v = fit_both(layout, ridge, length, weight)
    if deep:
        plane = refined(layout, ridge, length, weight, plane, False)
        point = refined(layout, ridge, length, weight, point, True)
    plane_chi = chi_squared(layout, length, weight, plane, False)
    point_chi = chi_squared(layout, length, weight, point, True)
    return plane, m, u, plane_chi, point, p, v, point_chi


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def in_front(t: Triple, cosine: float) -> bool:
    """Whether a target lies within the tilt that can return an echo."""
    return t[2] >= cosine * np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])


# With its types, it is compiled (once for an installation) when it is imported and not at the first ping.
@njit(
    "void(f8[:,::1], f8[::1], i8, b1, f8[::1], f8[:,::1], f8[:,::1], b1[:,::1], f8[:,::1])",
    cache=True,
    nogil=True,
    error_model="numpy",
    fastmath={"contract"},
)
def contact_rows(
    layout: Floats,
    ridge: Floats,
    rank: int,
    deep: bool,
    settings: Floats,
    paths: Floats,
    sigmas: Floats,
    used: Flags,
    rows: Floats,
) -> None:
    """Fill a row (see `contact_kernels`) and the used receivers of each ping from paths (pings, n) and sigmas (pings or
    1, n)."""
    pings, n = paths.shape
    length, weight = np.empty(n), np.empty(n)
    max_chi, allowed = settings[MAX_CHI], int(settings[ALLOWED])
    for i in range(pings):
        count = 0
        row = rows[i]
        for k in range(n):
            path, sigma = paths[i, k], sigmas[i if sigmas.shape[0] > 1 else 0, k]
            good = 0.0 < path < np.inf and 0.0 < sigma < np.inf
            used[i, k] = good
            length[k] = path if good else 1.0
            weight[k] = 1.0 / (sigma * sigma) if good else 0.0
            count += good
        freedom = count - rank
        row[PLANE_CHI] = row[POINT_CHI] = np.nan
        if freedom < 0 or (freedom == 0 and settings[ASSUME] == 0.0):
            write_none(row, layout, paths[i], count > 0)
            continue
        plane, m, u, plane_chi, point, p, v, point_chi = both(layout, ridge, length, weight, deep)
        least = max_chi * freedom
        if freedom > 0 and not plane_chi <= least and not (allowed > PLANE and point_chi <= least):
            most = min(MOST_SLIPS, count // 4)
            a, b, chi = contradiction(layout, length, weight, u, m, False, freedom, most, settings)
            if allowed >= POINT:
                c, d, other = contradiction(layout, length, weight, v, p, True, freedom, most, settings)
                if c >= 0 and (a < 0 or (b >= 0 and d < 0) or ((b >= 0) == (d >= 0) and other < chi)):
                    a, b = c, d
            if a >= 0:
                weight[a], used[i, a] = 0.0, False
                freedom -= 1
                if b >= 0:
                    weight[b], used[i, b] = 0.0, False
                    freedom -= 1
                plane, m, u, plane_chi, point, p, v, point_chi = both(layout, ridge, length, weight, deep)
        if freedom == 0:
            plane_chi = 0.0 if allowed != POINT and plane[2] > 0.0 else np.nan
            point_chi = 0.0 if allowed == POINT and point[2] > 0.0 else np.nan
        else:
            plane_chi, point_chi = plane_chi / freedom, point_chi / freedom
            row[PLANE_CHI], row[POINT_CHI] = plane_chi, point_chi
        is_plane = allowed != POINT and plane_chi <= max_chi and not (allowed > POINT and point_chi < plane_chi)
        is_point = allowed >= POINT and point_chi <= max_chi and not (allowed > POINT and plane_chi <= point_chi)
        is_plane = is_plane and in_front(plane, settings[MIN_COSINE])
        is_point = is_point and in_front(point, settings[MIN_COSINE])
        if not (is_plane or is_point):
            for k in range(n):
                used[i, k] = 0.0 < paths[i, k] < np.inf
            write_none(row, layout, paths[i], True)
            continue
        t = plane if is_plane else point
        fisher, _ = information(layout, ridge, length, weight, t, is_point)
        c6, _ = inverse(fisher)
        if settings[COMMON_MM] > 0.0:
            c6 = with_common(layout, weight, t, is_point, c6, settings[COMMON_MM] * settings[COMMON_MM])
        row[KIND], row[RANK] = PLANE if is_plane else POINT, rank
        write_normal(row, t, c6)
        if is_plane:
            write_plane(row, layout, t, c6)
        else:
            write_point(row, n, t, c6)
