"""The compiled closed forms of contact points: plane and point from path lengths, their test, and their covariance.

Both models are linear in three unknowns. With the emitter at the origin, receivers r_i = (x, y, h) and paths L_i,

    plane, E' the emitter's image:  L^2 - r^2 + 2 h E'z = -2 x E'x - 2 y E'y + |E'|^2
    point P:                        L^2 - r^2 + 2 h Pz  = -2 x Px  - 2 y Py  + 2 L |P|

so that the unknowns (a, b, g) are a straight line over the depth t, and g's meaning is a quadratic for t. The target T
is E' or P. A symmetric matrix is six numbers: xx, xy, xz, yy, yz, zz.
"""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

Floats = NDArray[np.float64]
Flags = NDArray[np.bool_]
Triple = tuple[float, float, float]
Four = tuple[float, float, float, float]
Six = tuple[float, float, float, float, float, float]

NONE, PLANE, POINT = 0, 1, 2
"""As in `EchoKind`."""
KIND, RANK, PLANE_CHI, POINT_CHI, TARGET, NORMAL, FOOT_COV, NORMAL_COV, POINTS = 0, 1, 2, 3, 4, 7, 10, 16, 22
"""Where in a row a value begins. `TARGET` holds the foot of a plane or the point; behind the contact points (3 each)
come their covariances (6 each)."""
X, Y, H, SQUARE, OPEN_X, OPEN_Y = 0, 1, 2, 3, 4, 5
"""Columns of a layout; the last two are x and y less what the layout leaves undetermined."""
DEGENERATE = 1e-9
"""Determinant over the product of the diagonal, below which receivers do not determine a model."""
SURE = 9.0
"""By this much of chi-squared leaving out one channel must beat leaving out any other."""


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def inverse(m: Six) -> tuple[Six, bool]:
    """Inverse of a symmetric positive 3x3 matrix, and whether it has one."""
    xx, xy, xz, yy, yz, zz = m
    ixx, ixy, ixz = yy * zz - yz * yz, xz * yz - xy * zz, xy * yz - xz * yy
    det = xx * ixx + xy * ixy + xz * ixz
    s = 1.0 / det
    good = det > DEGENERATE * (xx * yy * zz)
    return (ixx * s, ixy * s, ixz * s, (xx * zz - xz * xz) * s, (xy * xz - xx * yz) * s, (xx * yy - xy * xy) * s), good


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def times(m: Six, x: float, y: float, z: float) -> Triple:
    """Symmetric matrix times vector."""
    return m[0] * x + m[1] * y + m[2] * z, m[1] * x + m[3] * y + m[4] * z, m[2] * x + m[4] * y + m[5] * z


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def target(u: Triple, v: Triple, point: bool) -> Triple:
    """The target of the unknowns u + t v, in front of the receivers; not a number if there is none."""
    p = 0.25 if point else 0.0  # the constraint is g^2 / 4 for a point and g for a plane
    q = 1.0 - 4.0 * p
    a = 1.0 + 0.25 * (v[0] * v[0] + v[1] * v[1]) - p * v[2] * v[2]
    b = 0.25 * (u[0] * v[0] + u[1] * v[1]) - p * u[2] * v[2] - 0.5 * q * v[2]
    c = 0.25 * (u[0] * u[0] + u[1] * u[1]) - p * u[2] * u[2] - q * u[2]
    t = (np.sqrt(b * b - a * c) - b) / a
    if not t > 0.0 or (point and not u[2] + t * v[2] > 0.0):
        t = np.nan
    return -0.5 * (u[0] + t * v[0]), -0.5 * (u[1] + t * v[1]), t


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def along(u: Triple, v: Triple, t: float, otherwise: float, good: bool) -> Four:
    """The unknowns (a, b, g) at a depth, or at another if there is none, and that depth; not numbers if not good."""
    d = otherwise if np.isnan(t) else t
    return (u[0] + d * v[0] if good else np.nan), u[1] + d * v[1], u[2] + d * v[2], d


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def fit_both(
    layout: Floats, ridge: Floats, length: Floats, weight: Floats
) -> tuple[Triple, Six, Four, Triple, Six, Four]:
    """Target, inverse normal matrix and unknowns of the plane, then of the point.

    Weights are 1 / sigma^2, 0 where missing. The unknowns exist where paths that contradict each other have no target.
    """
    xx = xy = yy = x1 = y1 = s1 = xl = yl = ll = sl = 0.0
    xb = yb = b1 = bl = xh = yh = h1 = hl = 0.0
    for k in range(layout.shape[0]):
        x, y, h2, path = layout[k, OPEN_X], layout[k, OPEN_Y], 2.0 * layout[k, H], length[k]
        square = path * path
        w = weight[k] / square
        b = square - layout[k, SQUARE]
        wx, wy, wl = w * x, w * y, w * path
        xx += wx * x
        xy += wx * y
        yy += wy * y
        x1 += wx
        y1 += wy
        s1 += w
        xl += wx * path
        yl += wy * path
        sl += wl
        ll += wl * path
        xb += wx * b
        yb += wy * b
        b1 += w * b
        bl += wl * b
        xh += wx * h2
        yh += wy * h2
        h1 += w * h2
        hl += wl * h2
    xx += ridge[0] * s1
    xy += ridge[1] * s1
    yy += ridge[2] * s1
    m, plane_ok = inverse((xx, xy, x1, yy, y1, s1))
    p, point_ok = inverse((xx, xy, xl, yy, yl, ll))
    u, v = times(m, xb, yb, b1), times(m, xh, yh, h1)
    o, q = times(p, xb, yb, bl), times(p, xh, yh, hl)
    none = (np.nan, np.nan, np.nan)
    plane = target(u, v, False) if plane_ok else none
    point = target(o, q, True) if point_ok else none
    mean = sl / s1
    return plane, m, along(u, v, plane[2], mean, plane_ok), point, p, along(o, q, point[2], 0.5 * mean, point_ok)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def chi_squared(layout: Floats, length: Floats, weight: Floats, t: Triple, point: bool) -> float:
    """Weighted sum of squares of the paths' residuals."""
    base = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]) if point else 0.0
    out = 0.0
    for k in range(layout.shape[0]):
        x, y, z = t[0] - layout[k, X], t[1] - layout[k, Y], t[2] - layout[k, H]
        left = length[k] - base - np.sqrt(x * x + y * y + z * z)
        out += weight[k] * left * left
    return out


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def information(
    layout: Floats, ridge: Floats, length: Floats, weight: Floats, t: Triple, point: bool
) -> tuple[Six, Triple]:
    """Fisher information about the target, and the gradient of half of chi-squared downhill."""
    base = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2]) if point else 0.0
    f = 1.0 / base if point else 0.0
    xx = xy = xz = yy = yz = zz = gx = gy = gz = s = 0.0
    for k in range(layout.shape[0]):
        x, y, z = t[0] - layout[k, X], t[1] - layout[k, Y], t[2] - layout[k, H]
        way = np.sqrt(x * x + y * y + z * z)
        i = 1.0 / way
        jx = f * t[0] + (t[0] - layout[k, OPEN_X]) * i
        jy = f * t[1] + (t[1] - layout[k, OPEN_Y]) * i
        jz = f * t[2] + z * i
        w = weight[k]
        left = w * (length[k] - base - way)
        xx += w * jx * jx
        xy += w * jx * jy
        xz += w * jx * jz
        yy += w * jy * jy
        yz += w * jy * jz
        zz += w * jz * jz
        gx += left * jx
        gy += left * jy
        gz += left * jz
        s += w
    return (xx + ridge[3] * s, xy + ridge[4] * s, xz, yy + ridge[5] * s, yz, zz), (gx, gy, gz)


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def refined(layout: Floats, ridge: Floats, length: Floats, weight: Floats, t: Triple, point: bool) -> Triple:
    """One Gauss-Newton step: where receivers are not coplanar with the emitter, the depth is in the residuals too."""
    m, g = information(layout, ridge, length, weight, t, point)
    c, good = inverse(m)
    if not good:
        return t
    d = times(c, g[0], g[1], g[2])
    return t[0] + d[0], t[1] + d[1], t[2] + d[2]


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def with_common(layout: Floats, weight: Floats, t: Triple, point: bool, c: Six, variance: float) -> Six:
    """Covariance of the target when all paths share one more error (sound's speed, the robot's pose)."""
    base = np.sqrt(t[0] * t[0] + t[1] * t[1] + t[2] * t[2])
    x = y = z = s = 0.0
    for k in range(layout.shape[0]):
        ax, ay, az = t[0] - layout[k, X], t[1] - layout[k, Y], t[2] - layout[k, H]
        w = weight[k] / np.sqrt(ax * ax + ay * ay + az * az)
        x += w * (t[0] - layout[k, OPEN_X])
        y += w * (t[1] - layout[k, OPEN_Y])
        z += w * az
        s += weight[k]
    if point:
        s /= base
        x, y, z = x + s * t[0], y + s * t[1], z + s * t[2]
    x, y, z = times(c, x, y, z)
    return (
        c[0] + variance * x * x,
        c[1] + variance * x * y,
        c[2] + variance * x * z,
        c[3] + variance * y * y,
        c[4] + variance * y * z,
        c[5] + variance * z * z,
    )
