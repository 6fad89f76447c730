"""Least-squares planes and spheres, with the share of points that a guideline lets one leave out."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares


@dataclass(frozen=True)
class Plane:
    """z = slope_x x + slope_y y + z0_mm."""

    slope_x: float
    slope_y: float
    z0_mm: float
    off_mm: NDArray[np.float64]
    """Signed distance of each point from it, along its normal; above is positive."""


@dataclass(frozen=True)
class Sphere:
    """A sphere."""

    centre_mm: NDArray[np.float64]
    radius_mm: float
    off_mm: NDArray[np.float64]
    """Distance of each point from its centre, less its radius."""


def fit_plane(points_mm: NDArray[np.float64]) -> Plane:
    """Least-squares plane of points (n, 3) of a height image: the errors are in z.

    Raises
    ------
    ValueError
        If the points are fewer than three, or lie on a line.
    """
    middle_mm = points_mm.mean(axis=0)
    x, y, z = (points_mm - middle_mm).T
    design = np.stack([x, y], axis=1)
    slopes, _, rank, _ = np.linalg.lstsq(design, z, rcond=None)
    if rank < 2:
        raise ValueError(f"points: expected three or more that span a plane, got {len(points_mm)} on a line")
    off_mm = (z - design @ slopes) / np.sqrt(1 + slopes @ slopes)
    return Plane(float(slopes[0]), float(slopes[1]), float(middle_mm[2] - slopes @ middle_mm[:2]), off_mm)


def fit_sphere(points_mm: NDArray[np.float64]) -> Sphere | None:
    """Sphere of least squared distances from points (n, 3), or None if they hold no curvature."""
    middle_mm = points_mm.mean(axis=0)
    p = points_mm - middle_mm
    solved, _, rank, _ = np.linalg.lstsq(np.column_stack([2 * p, np.ones(len(p))]), (p**2).sum(axis=1), rcond=None)
    square = float(solved[3] + solved[:3] @ solved[:3])
    if rank < 4 or square <= 0:
        return None
    start = np.append(solved[:3], np.sqrt(square))

    def off_mm(sphere: NDArray[np.float64]) -> NDArray[np.float64]:
        x, y, z = (p - sphere[:3]).T
        return np.sqrt(x**2 + y**2 + z**2) - sphere[3]

    found = np.asarray(least_squares(off_mm, start, method="lm").x, dtype=np.float64)
    return Sphere(found[:3] + middle_mm, float(found[3]), off_mm(found))


def without_worst(off_mm: NDArray[np.float64], share: float) -> NDArray[np.bool_]:
    """The points that stay when a share of them, rounded down, is left out, those furthest off first."""
    stays = np.ones(off_mm.size, dtype=np.bool_)
    dropped = int(share * off_mm.size)
    if dropped:
        stays[np.argsort(np.abs(off_mm), kind="stable")[-dropped:]] = False
    return stays
