"""Do both cameras put the stripe at the same height? AT-left minus AT-right tells errors of the plane's position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix
from echolume_processing.optical.middle import median

Values = NDArray[np.float64]

MEDIAN_OF_NORMAL = 0.6745
"""Median of |N(0, 1)|."""
LAG_ROWS = 4
"""Rows so far apart do not share their speckle grain."""
FEW_POINTS = 50


@dataclass(frozen=True)
class Agreement:
    """Of one stripe, or of the stripes of a sweep.

    Attributes
    ----------
    points : int
        How many points both cameras see.
    median_mm : float
        Median |AT-left - AT-right| of z.
    noise_mm : float
        The median that noise alone explains, from how the difference varies from row to row.
    amplification : float
        Change of AT-left - AT-right for each mm of the plane's position, from the geometry.
    plane_mm : float
        Signed position error of the plane that the difference implies; of a sweep the median.
    error_mm : float
        RMS of the plane's error, tilt and scatter included, that is left when the noise is taken out.
    """

    points: int
    median_mm: float
    noise_mm: float
    amplification: float
    plane_mm: float
    error_mm: float


NONE = Agreement(0, *(float("nan"),) * 5)


@njit(cache=True, nogil=True)
def summary(
    active: Values, right_px: Values, plane: Matrix, left_centre: Values, right_centre: Values, normal: Values
) -> tuple[float, float, float, float, float]:
    """Median and noise of AT-left - AT-right, RMS without noise, amplification, signed median of a stripe; compiled.

    Parameters
    ----------
    active : (3, n)
        AT-left of the points that both cameras see, by rows, in mm.
    right_px : (2, n)
        Their undistorted image points in the right camera.
    plane : (4, 3)
        `triangulate.plane_from_pixel` of the right camera.
    left_centre, right_centre, normal : (3,)
        The cameras' centres in mm, and the laser plane's normal.

    Notes
    -----
    When the plane moves by a mm, a point moves along its ray r by r / (n.r): in z by about 2 for a camera that stands
    260 mm aside and 500 mm above, the other way for the one on the other side.
    """
    n = active.shape[1]
    if n <= 2 * LAG_ROWS:
        return np.nan, np.nan, np.nan, np.nan, np.nan
    difference, by_mm = np.empty(n), np.empty(n)
    for i in range(n):
        u, v = right_px[0, i], right_px[1, i]
        scale = 1.0 / (plane[3, 0] * u + plane[3, 1] * v + plane[3, 2])
        difference[i] = active[2, i] - (plane[2, 0] * u + plane[2, 1] * v + plane[2, 2]) * scale
        total = 0.0
        for sign, centre in ((1.0, left_centre), (-1.0, right_centre)):
            x, y, z = active[0, i] - centre[0], active[1, i] - centre[1], active[2, i] - centre[2]
            total += sign * z / (x * normal[0] + y * normal[1] + z * normal[2])
        by_mm[i] = total
    size, squares, steps = np.empty(n), 0.0, 0.0
    for i in range(n):
        size[i] = abs(difference[i])
        squares += difference[i] * difference[i]
        if i >= LAG_ROWS:
            step = difference[i] - difference[i - LAG_ROWS]
            steps += step * step
    mean, noise = squares / n, 0.5 * steps / (n - LAG_ROWS)
    return median(size, n), np.sqrt(noise), np.sqrt(max(mean - noise, 0.0)), median(by_mm, n), median(difference, n)


def of_stripe(points: int, found: tuple[float, float, float, float, float]) -> Agreement:
    """Agreement of one stripe of so many points from what `summary` found."""
    if points < FEW_POINTS:
        return NONE
    median_mm, sigma_mm, excess_mm, by_mm, middle_mm = found
    return Agreement(
        points, median_mm, MEDIAN_OF_NORMAL * sigma_mm, by_mm, middle_mm / by_mm, excess_mm / abs(by_mm)
    )  # fmt: skip


def of_sweep(stripes: Sequence[Agreement]) -> Agreement:
    """Agreement of a sweep: medians over those stripes that both cameras see."""
    seen = [s for s in stripes if s.points]
    if not seen:
        return NONE
    values = [(s.median_mm, s.noise_mm, s.amplification, s.plane_mm, s.error_mm) for s in seen]
    return Agreement(sum(s.points for s in seen), *(float(v) for v in np.median(values, axis=0)))
