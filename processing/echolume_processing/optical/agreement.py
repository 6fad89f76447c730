"""Do both cameras put the stripe at the same height? AT-left minus AT-right tells errors of the plane's position."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix

Values = NDArray[np.float64]

MEDIAN_OF_NORMAL = 0.6745
"""Median of |N(0, 1)|."""
LAG_ROWS = 4
"""Rows so far apart do not share their speckle grain."""
FEW_POINTS = 50
FEW_STRIPES = 3
ALARM_SIGMAS = 2.0
"""A plane error of more than this many of its stated sigmas raises the alarm."""


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
        Size of the plane's error, tilt and scatter included, that is left when the noise is taken out.
    """

    points: int
    median_mm: float
    noise_mm: float
    amplification: float
    plane_mm: float
    error_mm: float


NONE = Agreement(0, *(float("nan"),) * 5)


def _error_mm(median_mm: float, noise_mm: float, amplification: float) -> float:
    return float(np.sqrt(max(median_mm**2 - noise_mm**2, 0.0)) / MEDIAN_OF_NORMAL / amplification)


@njit(cache=True, nogil=True)
def summary(
    active: Values, right_px: Values, plane: Matrix, left_centre: Values, right_centre: Values, normal: Values
) -> tuple[float, float, float, float]:
    """Median |AT-left - AT-right|, its noise, the amplification, and the median difference of one stripe; compiled.

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
    260 mm aside and 500 mm above, the other way for the one on the other side. Every fourth row is used.
    """
    n = active.shape[1]
    if n <= 2 * LAG_ROWS:
        return np.nan, np.nan, np.nan, np.nan
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
    few = difference[::LAG_ROWS].copy()
    noise = np.median(np.abs(few[1:] - few[:-1])) / np.sqrt(2.0)
    return np.median(np.abs(few)), noise, np.median(by_mm[::LAG_ROWS].copy()), np.median(few)


def of_stripe(points: int, found: tuple[float, float, float, float]) -> Agreement:
    """Agreement of one stripe of so many points from what `summary` found."""
    if points < FEW_POINTS:
        return NONE
    median_mm, noise_mm, by_mm, middle_mm = found
    return Agreement(points, median_mm, noise_mm, by_mm, middle_mm / by_mm, _error_mm(median_mm, noise_mm, abs(by_mm)))


def of_sweep(stripes: Sequence[Agreement]) -> Agreement:
    """Agreement of a sweep: medians over those stripes that both cameras see."""
    seen = [s for s in stripes if s.points]
    if not seen:
        return NONE
    median_mm, noise_mm, by_mm, plane_mm = (
        float(np.median([getattr(s, name) for s in seen]))
        for name in ("median_mm", "noise_mm", "amplification", "plane_mm")
    )
    error_mm = _error_mm(median_mm, noise_mm, abs(by_mm))
    return Agreement(sum(s.points for s in seen), median_mm, noise_mm, by_mm, plane_mm, error_mm)


@dataclass(frozen=True)
class _Stripe:
    agreement: Agreement
    x_mm: float
    t_ns: int


class SweepHealth:
    """Follows the agreement of both cameras over one sweep, and says when noise does not explain it any more.

    Parameters
    ----------
    plane_sigma_mm : float
        Stated sigma of the laser plane's position.
    """

    def __init__(self, plane_sigma_mm: float) -> None:
        self.limit_mm = ALARM_SIGMAS * plane_sigma_mm
        self._stripes: list[_Stripe] = []

    def add(self, agreement: Agreement, x_mm: float, t_ns: int) -> None:
        """Take one stripe, with the guide's position and the time of its frames."""
        if agreement.points:
            self._stripes.append(_Stripe(agreement, x_mm, t_ns))

    @property
    def sweep(self) -> Agreement:
        """Of the stripes so far."""
        return of_sweep([s.agreement for s in self._stripes])

    @property
    def alarm(self) -> bool:
        """Whether the plane's error exceeds what noise and its stated sigma explain."""
        return len(self._stripes) >= FEW_STRIPES and self.sweep.error_mm > self.limit_mm

    @property
    def speed_mmps(self) -> float:
        """Median speed of the guide between stripes; nan while unknown."""
        s = self._stripes
        steps = [(b.x_mm - a.x_mm, 1e-9 * (b.t_ns - a.t_ns)) for a, b in pairwise(s)]
        speeds = [dx / dt for dx, dt in steps if dt > 0]
        return float(np.median(speeds)) if speeds else float("nan")

    def report(self) -> dict[str, object]:
        """What is published: all in mm, `sync_ms` is the time by which frames and guide would be out of step."""
        sweep = self.sweep
        if not sweep.points:
            return {"stripes": 0, "alarm": False}
        speed_mmps = self.speed_mmps
        moving = bool(np.isfinite(speed_mmps)) and abs(speed_mmps) > 1.0
        return {
            "stripes": len(self._stripes),
            "points": sweep.points,
            "median_mm": round(sweep.median_mm, 4),
            "noise_mm": round(sweep.noise_mm, 4),
            "amplification": round(sweep.amplification, 2),
            "plane_mm": round(sweep.plane_mm, 4),
            "error_mm": round(sweep.error_mm, 4),
            "limit_mm": round(self.limit_mm, 4),
            "sync_ms": round(1e3 * sweep.plane_mm / speed_mmps, 2) if moving else None,
            "alarm": self.alarm,
        }
