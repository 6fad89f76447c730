"""The compiled chain from both cameras' stripes to points with covariances; `pipeline` is its outside."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.types import OpticalSource, Structured
from echolume_processing.optical import agreement, closed_form, covariance, epipolar, plane_shift, select
from echolume_processing.optical.candidates import Candidates, View, gather

Values = NDArray[np.float64]

SATURATED, BOTH = 1, 2
"""Bits of a point's flags."""
_STEREO, _LEFT, _RIGHT = (int(s) for s in OpticalSource)


class Terms(NamedTuple):
    """Gates and error terms of one pipeline."""

    gates_mm: Values
    """Lowest and highest z, lowest and highest y."""
    normal: Values
    """Of the laser plane."""
    left_px: float
    """Sigma of the left camera's model."""
    right_px: float
    tolerance_px: float
    run_rows: int


class Found(NamedTuple):
    """What `run` gives; `pipeline.StripePoints` says more."""

    covariance: Values
    joint_mm: Values
    joint_covariance: Values
    left_verdicts: NDArray[np.int64]
    right_verdicts: NDArray[np.int64]
    agreement: tuple[float, float, float, float, float]


@njit(cache=True, nogil=True)
def _variance(side: Candidates, verdict: select.Verdicts) -> Values:
    """Variance of each column, (n,): as the extraction states it, and what the stripe itself shows on top."""
    extra = select.unexplained_px2(side, verdict)
    out = np.empty(len(verdict))
    for n in range(len(out)):
        out[n] = side.measured[1, n] * side.measured[1, n] + extra
    return out


@njit(cache=True, nogil=True)
def _plane_variance(points: Values, plane_mm2: Values) -> Values:
    """Variance of the laser plane's position at points (3, n), (n,)."""
    out = np.empty(points.shape[1])
    for i in range(len(out)):
        y, z = points[1, i], points[2, i]
        variance = plane_mm2[0] + y * (plane_mm2[1] + y * plane_mm2[3] + z * plane_mm2[4])
        out[i] = max(variance + z * (plane_mm2[2] + z * plane_mm2[5]), 0.0)
    return out


@njit(cache=True, nogil=True)
def _write(
    out: Structured, first: int, points: Values, cov: Values, row: NDArray[np.int64], flags: NDArray[np.uint8],
    source: int,
) -> None:  # fmt: skip
    for i in range(points.shape[1]):
        point = out[first + i]
        point.x_mm, point.y_mm, point.z_mm = points[0, i], points[1, i], points[2, i]
        point.sigma_z_mm = np.sqrt(cov[5, i])
        point.source, point.flags, point.row = source, flags[i], row[i]


@njit(cache=True, nogil=True)
def _along_ray(point: Values, centre: Values, plane: Values, shift_mm: float, out: Values) -> None:
    """Where the ray from a camera's centre to a point on the laser plane meets it when it is shifted."""
    x, y, z = point[0] - centre[0], point[1] - centre[1], point[2] - centre[2]
    times = shift_mm / (plane[0] * x + plane[1] * y + plane[2] * z)
    out[0], out[1], out[2] = point[0] + times * x, point[1] + times * y, point[2] + times * z


@njit(cache=True, nogil=True)
def _camera_mm(left: View, right: View, terms: Terms, middle: Values, per_mm: float) -> float:
    """What the errors of both cameras' models do to the place of the plane as they see it together.

    A column's error moves a point along the plane, which its ray meets aslant; `per_mm` is what agreement calls the
    amplification.
    """
    total = 0.0
    for view, sigma_px in ((left, terms.left_px), (right, terms.right_px)):
        ray = middle - view.centre_mm
        total += (sigma_px * (ray * ray).sum() / (view.lens[0] * (ray * terms.normal).sum())) ** 2
    return np.sqrt(total) / abs(per_mm)


@njit(cache=True, nogil=True)
def _active(
    side: Candidates, verdict: select.Verdicts, variance: Values, view: View, plane_mm2: Values, camera_px: float,
    plane: Values, shift_mm: float, source: int, out: Structured, first: int,
) -> Values:  # fmt: skip
    """Write the active points of one camera, on the plane where it really was; their covariance (6, n)."""
    kept, n = np.empty(len(verdict), np.int64), 0
    for k in range(len(verdict)):
        if verdict[k] <= select.LAST_BELIEVED:
            kept[n] = k
            n += 1
    points, sigma = np.empty((3, n)), np.empty(n)
    row, flags = np.empty(n, np.int64), np.empty(n, np.uint8)
    for i in range(n):
        k = kept[i]
        _along_ray(side.active_mm[:, k], view.centre_mm, plane[0], shift_mm, points[:, i])
        sigma[i] = np.sqrt(variance[k] + camera_px * camera_px)
        row[i] = side.row[k]
        flags[i] = SATURATED * side.saturated[k] + BOTH * (verdict[k] == 0)
    found = np.empty((6, n))
    plane_mm = np.sqrt(_plane_variance(points, plane_mm2))
    covariance.meet(points, view.projection, plane, True, sigma, camera_px, plane_mm, found)
    _write(out, first, points, found, row, flags, source)
    return found


@njit(cache=True, nogil=True)
def run(
    left_stripe: tuple[Values, Values, Values, Values, NDArray[np.bool_]],
    right_stripe: tuple[Values, Values, Values, Values, NDArray[np.bool_]],
    left: View,
    right: View,
    terms: Terms,
    distance_mm: float,
    plane_mm2: Values,
    out: Structured,
) -> Found:
    """Fill `out` with OPTICAL_POINTs: stereo, active left, active right; there are as many as covariances.

    Parameters
    ----------
    left_stripe, right_stripe : tuples
        `candidates.contiguous` of both cameras' stripes.
    left, right : View
        The cameras.
    terms : Terms
        Gates and error terms.
    distance_mm : float
        n.X of the laser plane.
    plane_mm2 : (6,)
        Variance of its position: what multiplies 1, y, z, y^2, y z, z^2. Active and joint points lie on the plane that
        the stereo points of the same stripe measure, see `plane_shift`.
    out : (at least the rows of left twice and of right once,) OPTICAL_POINT
        Filled.
    """
    a, b, c, d, e = left_stripe
    first = gather(a, b, c, d, e, left, right, terms.normal, distance_mm, terms.gates_mm)
    a, b, c, d, e = right_stripe
    second = gather(a, b, c, d, e, right, left, terms.normal, distance_mm, terms.gates_mm)
    to_right = epipolar.walk(first, second, left.f_to_other, terms.tolerance_px)
    to_left = epipolar.walk(second, first, right.f_to_other, terms.tolerance_px)
    verdicts = select.choose(first, second, to_right, to_left, terms.run_rows)
    variances = _variance(first, verdicts[0]), _variance(second, verdicts[1])

    index, other = select.pairs(verdicts[0], verdicts[1], to_right.partner)
    n = len(index)
    seen, active = np.empty((4, n)), np.empty((3, n))
    sigma_left, sigma_right = np.empty(n), np.empty(n)
    row, flags = np.empty(n, np.int64), np.empty(n, np.uint8)
    for i in range(n):
        k, m = index[i], other[i]
        seen[0, i], seen[1, i] = first.points_px[0, k], first.points_px[1, k]
        seen[2, i], seen[3, i] = to_right.points_px[0, k], to_right.points_px[1, k]
        active[0, i], active[1, i], active[2, i] = first.active_mm[0, k], first.active_mm[1, k], first.active_mm[2, k]
        sigma_left[i] = np.sqrt(variances[0][k] + terms.left_px**2)
        sigma_right[i] = np.sqrt(to_right.gain[k] * variances[1][m] + terms.right_px**2)
        row[i] = first.row[k]
        flags[i] = SATURATED * (first.saturated[k] or second.saturated[m]) + BOTH
    points, stereo = np.empty((3, n)), np.empty((6, n))
    closed_form.stereo_block(left.projection, right.projection, seen, n, points)
    covariance.meet(
        points, left.projection, right.projection, False, sigma_left, terms.left_px, sigma_right, stereo
    )  # fmt: skip
    _write(out, 0, points, stereo, row, flags, _STEREO)
    plane = closed_form.plane_from_pixel(right.centre_mm, right.ray_matrix, terms.normal, distance_mm)
    agreed = agreement.summary(active, seen[2:], plane, left.centre_mm, right.centre_mm, terms.normal)
    shift_mm = 0.0
    if n >= agreement.FEW_POINTS:
        middle = np.array([active[0].mean(), active[1].mean(), active[2].mean()])
        camera_mm = _camera_mm(left, right, terms, middle, agreed[3])
        shift_mm, plane_mm2 = plane_shift.shift(
            n, agreed[1], agreed[3], agreed[4], middle[1], middle[2], camera_mm, plane_mm2
        )
    joint, joint_covariance = np.empty((3, n)), np.empty((6, n))
    variance = _plane_variance(points, plane_mm2)
    covariance.constrain(points, stereo, terms.normal, distance_mm + shift_mm, variance, joint, joint_covariance)

    surface = np.zeros((3, 4))
    surface[0, :3] = terms.normal
    surface[2, 3] = 1.0
    at_left = _active(
        first, verdicts[0], variances[0], left, plane_mm2, terms.left_px, surface, shift_mm, _LEFT, out, n
    )  # fmt: skip
    at_right = _active(
        second, verdicts[1], variances[1], right, plane_mm2, terms.right_px, surface, shift_mm, _RIGHT, out,
        n + at_left.shape[1],
    )  # fmt: skip
    m, last = n + at_left.shape[1], n + at_left.shape[1] + at_right.shape[1]
    every = np.empty((6, last))
    for i in range(6):
        every[i, :n], every[i, n:m], every[i, m:] = stereo[i], at_left[i], at_right[i]
    left_counts, right_counts = select.count(verdicts[0]), select.count(verdicts[1])
    return Found(every, joint, joint_covariance, left_counts, right_counts, agreed)
