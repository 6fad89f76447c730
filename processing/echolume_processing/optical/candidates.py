"""The stripe candidates of one camera as a list, strongest first in each row, and where they lie on the laser plane."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, require_shape
from echolume_processing.optical import closed_form, lens, triangulate
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.stripe import Stripe

Values = NDArray[np.float64]
Indices = NDArray[np.int64]


class View(NamedTuple):
    """What the kernels need of a camera, and of its place beside the other one."""

    projection: Matrix
    """M = K [R | t], (3, 4)."""
    centre_mm: Values
    """Optical centre, (3,)."""
    ray_matrix: Matrix
    """`Camera.ray_matrix`, (3, 3)."""
    lens: Values
    """`Camera.lens`, (10,)."""
    f_to_other: Matrix
    """Fundamental matrix, ``other_h^T f this_h = 0``, (3, 3)."""


class Candidates(NamedTuple):
    """The n candidates of one camera, by rows, strongest first."""

    start: Indices
    """Candidates of row r are start[r] .. start[r + 1] - 1; (rows + 1,)."""
    row: Indices
    """Image row, (n,)."""
    measured: Values
    """Column in the distorted image, its sigma, its width in px, and amplitude in digital numbers; (4, n)."""
    saturated: NDArray[np.bool_]
    """The sensor clipped there, (n,)."""
    points_px: Values
    """Undistorted image point, (2, n)."""
    active_mm: Values
    """Point on the laser plane (AT), (3, n); nan beyond the gates."""
    expected_px: Values
    """Where the other camera should see that point, (2, n): undistorted column, distorted row."""


def view_of(camera: Camera, other: Camera) -> View:
    """The view of a camera that works together with `other`."""
    m = np.ascontiguousarray(camera.projection)
    f = triangulate.fundamental(m, other.projection)
    return View(m, camera.centre_mm, np.ascontiguousarray(camera.ray_matrix), camera.lens, np.ascontiguousarray(f))


@njit(cache=True, nogil=True)
def _gather(
    column: Values, sigma: Values, width: Values, amplitude: Values, clipped: NDArray[np.bool_]
) -> tuple[Indices, Indices, Values, NDArray[np.bool_]]:
    rows, most = column.shape
    start = np.empty(rows + 1, np.int64)
    n = 0
    for r in range(rows):
        start[r] = n
        for k in range(most):
            n += not np.isnan(column[r, k])
    start[rows] = n
    row, measured, saturated = np.empty(n, np.int64), np.empty((4, n)), np.empty(n, np.bool_)
    for r in range(rows):
        i = start[r]
        for k in range(most):
            if not np.isnan(column[r, k]):
                row[i] = r
                measured[0, i], measured[1, i] = column[r, k], sigma[r, k]
                measured[2, i], measured[3, i] = width[r, k], amplitude[r, k]
                saturated[i] = clipped[r, k]
                i += 1
    return start, row, measured, saturated


@njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract"})
def _place(points: Values, plane: Values, other: Values, other_lens: Values, active: Values, expected: Values) -> None:
    # Into names first: the compiler cannot know that the loop's results do not change them.
    p00, p01, p02, p10, p11, p12 = plane[0, 0], plane[0, 1], plane[0, 2], plane[1, 0], plane[1, 1], plane[1, 2]
    p20, p21, p22, p30, p31, p32 = plane[2, 0], plane[2, 1], plane[2, 2], plane[3, 0], plane[3, 1], plane[3, 2]
    m00, m01, m02, m03 = other[0, 0], other[0, 1], other[0, 2], other[0, 3]
    m10, m11, m12, m13 = other[1, 0], other[1, 1], other[1, 2], other[1, 3]
    m20, m21, m22, m23 = other[2, 0], other[2, 1], other[2, 2], other[2, 3]
    fx, skew, cx, fy, cy = other_lens[0], other_lens[1], other_lens[2], other_lens[3], other_lens[4]
    k1, k2, p1, p2, k3 = other_lens[5], other_lens[6], other_lens[7], other_lens[8], other_lens[9]
    for i in range(points.shape[1]):
        u, v = points[0, i], points[1, i]
        scale = 1.0 / (p30 * u + p31 * v + p32)
        x = (p00 * u + p01 * v + p02) * scale
        y = (p10 * u + p11 * v + p12) * scale
        z = (p20 * u + p21 * v + p22) * scale
        active[0, i], active[1, i], active[2, i] = x, y, z
        near = 1.0 / (m20 * x + m21 * y + m22 * z + m23)
        uo = (m00 * x + m01 * y + m02 * z + m03) * near
        vo = (m10 * x + m11 * y + m12 * z + m13) * near
        yn = (vo - cy) / fy
        xn = (uo - cx - skew * yn) / fx
        r2 = xn * xn + yn * yn
        radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * k3))
        expected[0, i] = uo
        expected[1, i] = fy * (yn * radial + p1 * (r2 + 2.0 * yn * yn) + 2.0 * p2 * xn * yn) + cy


@njit(cache=True, nogil=True)
def _close_gates(gates: Values, active: Values, expected: Values) -> None:
    for i in range(active.shape[1]):
        if not (gates[0] < active[2, i] < gates[1] and gates[2] < active[1, i] < gates[3]):
            active[:, i] = np.nan
            expected[:, i] = np.nan


@njit(cache=True, nogil=True)
def gather(
    column: Values,
    sigma: Values,
    width: Values,
    amplitude: Values,
    clipped: NDArray[np.bool_],
    view: View,
    other: View,
    normal: Values,
    distance_mm: float,
    gates_mm: Values,
) -> Candidates:
    """List the candidates of a frame's `Stripe`, undistort them, and put them on the laser plane; compiled."""
    start, row, measured, saturated = _gather(column, sigma, width, amplitude, clipped)
    n = len(row)
    points, active, expected = np.empty((2, n)), np.empty((3, n)), np.empty((2, n))
    lens.undistort(measured[0], row.astype(np.float64), view.lens, points[0], points[1])
    plane = closed_form.plane_from_pixel(view.centre_mm, view.ray_matrix, normal, distance_mm)
    _place(points, plane, other.projection, other.lens, active, expected)
    _close_gates(gates_mm, active, expected)
    return Candidates(start, row, measured, saturated, points, active, expected)


def contiguous(found: Stripe) -> tuple[Values, Values, Values, Values, NDArray[np.bool_]]:
    """What `gather` takes of a stripe, each (rows, k) in C order."""
    column, sigma, width, amplitude = (
        np.ascontiguousarray(values, dtype=np.float64)
        for values in (found.column_px, found.sigma_px, found.width_px, found.amplitude_dn)
    )
    return column, sigma, width, amplitude, np.ascontiguousarray(found.saturated)


def candidates_of(
    found: Stripe, view: View, other: View, normal: Values, distance_mm: float, gates_mm: Values
) -> Candidates:
    """List the candidates of a frame, undistort them, and put them on the laser plane.

    Parameters
    ----------
    found : Stripe
        Of the camera's frame.
    view, other : View
        The camera that saw it, and the other one.
    normal, distance_mm : (3,), float
        The laser plane n.X = distance.
    gates_mm : (4,)
        Lowest and highest z, lowest and highest y.
    """
    require_shape("gates_mm", gates_mm, (4,))
    require_shape("normal", normal, (3,))
    return gather(*contiguous(found), view, other, normal, distance_mm, gates_mm)
