"""The stripe candidates of one camera as a list, strongest first in each row, and where they lie on the laser plane."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, require_shape
from echolume_processing.optical import lens, triangulate
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.stripe import Stripe

Values = NDArray[np.float64]
Indices = NDArray[np.int64]


@dataclass(frozen=True)
class View:
    """A camera with what the kernels need of it and of the other one."""

    camera: Camera
    projection: Matrix
    centre_mm: NDArray[np.float64]
    ray_matrix: Matrix
    lens: NDArray[np.float64]
    f_to_other: Matrix

    @classmethod
    def of(cls, camera: Camera, other: Camera) -> View:
        """Of a camera that works together with `other`."""
        m = np.ascontiguousarray(camera.projection)
        f = triangulate.fundamental(m, other.projection)
        return cls(camera, m, camera.centre_mm, np.ascontiguousarray(camera.ray_matrix), camera.lens, f)


@dataclass(frozen=True)
class Candidates:
    """The n candidates of one camera, by rows, strongest first.

    Attributes
    ----------
    start : (rows + 1,) int64
        Candidates of row r are start[r] .. start[r + 1] - 1.
    row : (n,) int64
        Image row.
    measured : (4, n) float64
        Column in the distorted image, its sigma and its width in px, amplitude in digital numbers.
    saturated : (n,) bool
        The sensor clipped there.
    points_px : (2, n) float64
        Undistorted image point.
    active_mm : (3, n) float64
        Point on the laser plane (AT); nan beyond the gates.
    expected_px : (2, n) float64
        Where the other camera should see that point: undistorted column, distorted row.
    """

    start: Indices
    row: Indices
    measured: Values
    saturated: NDArray[np.bool_]
    points_px: Values
    active_mm: Values
    expected_px: Values

    @property
    def rows(self) -> int:
        """Rows of the image."""
        return len(self.start) - 1

    @property
    def sigma_px(self) -> Values:
        """Sigma of the column, (n,)."""
        return self.measured[1]


@njit(cache=True, nogil=True)
def _gather(
    column: Values, sigma: Values, width: Values, amplitude: Values, saturated: NDArray[np.bool_],
    start: Indices, row: Indices, measured: Values, clipped: NDArray[np.bool_],
) -> int:  # fmt: skip
    n = 0
    for r in range(column.shape[0]):
        start[r] = n
        for k in range(column.shape[1]):
            if np.isfinite(column[r, k]):
                row[n] = r
                measured[0, n], measured[1, n] = column[r, k], sigma[r, k]
                measured[2, n], measured[3, n] = width[r, k], amplitude[r, k]
                clipped[n] = saturated[r, k]
                n += 1
    start[column.shape[0]] = n
    return n


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


def candidates_of(
    found: Stripe,
    view: View,
    other: View,
    normal: NDArray[np.float64],
    distance_mm: float,
    gates_mm: NDArray[np.float64],
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
    column = np.ascontiguousarray(found.column_px, dtype=np.float64)
    rows, most = column.shape[0], column.size
    start, row = np.empty(rows + 1, dtype=np.int64), np.empty(most, dtype=np.int64)
    measured, saturated = np.empty((4, most)), np.empty(most, dtype=np.bool_)
    n = _gather(
        column, *(np.ascontiguousarray(a, dtype=np.float64) for a in (found.sigma_px, found.width_px)),
        np.ascontiguousarray(found.amplitude_dn, dtype=np.float64), np.ascontiguousarray(found.saturated),
        start, row, measured, saturated,
    )  # fmt: skip
    row = row[:n]
    points, active, expected = np.empty((2, n)), np.empty((3, n)), np.empty((2, n))
    lens.undistort(measured[0, :n], row.astype(np.float64), view.lens, points[0], points[1])
    plane = triangulate.plane_from_pixel(view.centre_mm, view.ray_matrix, normal, distance_mm)
    _place(points, plane, other.projection, other.lens, active, expected)
    _close_gates(gates_mm, active, expected)
    return Candidates(start, row, np.ascontiguousarray(measured[:, :n]), saturated[:n], points, active, expected)
