"""Smooth surfaces that bend: through the ways of many pings, where no single one met a plane."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_processing.hybrid.heard import Heard, Seed
from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.sounding import Sounding

LEAST_PINGS = 10
ROUNDS = 10
OFF_MM = 0.6
"""A ping of which the way differs by more from the surface's met something else."""
AGREES_MM = 0.25
"""The ways of a surface's own pings differ by no more from it, in the median."""
SHARPEST_PER_MM = 1 / 12
"""A surface that bends more returns the echo of an edge."""
HOLLOW_PER_MM = 1 / 400
"""Hollow surfaces have several nearest points from where the array stands."""
LEAST_SPAN_MM = 6.0
"""The places where pings met it lie at least so far apart, along and across."""


def curved_seed(found: Sounding, spoken: Heard, which: NDArray[np.int64]) -> Seed | None:
    """The bent surface to which the ways of some pings are the shortest; None if there is none.

    Parameters
    ----------
    found
        Where the array stood.
    spoken
        The paths that pings heard.
    which
        Pings to be explained.

    Notes
    -----
    Each ping's echo comes from the point of the surface next to the array, so that raising the surface there shortens
    the way by the cosine of its slope: least squares over six coefficients, without pings that are far off.
    """
    ping, centre_mm, way_mm = _ways_from(found, spoken, which)
    if np.unique(ping).size < LEAST_PINGS:
        return None
    across = centre_mm[:, :2].mean(axis=0)
    plane = Plane(float(across[0]), float(across[1]), float(np.median(centre_mm[:, 2] - way_mm)))
    used, off_mm = np.ones(ping.size, dtype=np.bool_), np.zeros(ping.size)
    for number in range(ROUNDS):
        plane = _fitted(plane, centre_mm[used], way_mm[used])
        off_mm = np.abs(_ways(plane, centre_mm) - way_mm)
        if number >= ROUNDS // 2:
            used = off_mm <= max(OFF_MM, 2 * float(np.median(off_mm)))
        if used.sum() < LEAST_PINGS:
            return None
    used &= off_mm <= OFF_MM
    place_mm = plane.mirror_points(centre_mm[used])
    met = np.unique(ping[used])
    if met.size < LEAST_PINGS or np.median(off_mm[used]) > AGREES_MM or not _gentle(plane):
        return None
    if np.ptp(place_mm, axis=0).min() < LEAST_SPAN_MM:
        return None
    return Seed(plane, met, place_mm, 1.4826 * float(np.median(off_mm[used])))


def first_height_mm(found: Sounding, spoken: Heard) -> NDArray[np.float64]:
    """How high below the array the first echo of each ping comes from (pings,); far below where there is none."""
    out = np.full(len(found.apertures), -np.inf)
    ping, centre_mm, way_mm = _ways_from(found, spoken, np.arange(out.size))
    np.maximum.at(out, ping, centre_mm[:, 2] - way_mm)
    return out


def _ways_from(
    found: Sounding, spoken: Heard, which: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Which ping, midway between emitter and receiver (n, 3), and how far the surface is from there (n,).

    Of a plane this is exact; of what bends, to the second order in the distance between both.
    """
    elements_mm = np.array([found.apertures[int(k)].elements_mm for k in which])
    apart_mm = elements_mm[:, 1:] - elements_mm[:, :1]
    middle_mm = elements_mm[:, :1] + 0.5 * apart_mm
    square_mm2 = 0.25 * (spoken.path_mm[which] ** 2 - (apart_mm**2).sum(axis=2))
    known = square_mm2 > 0
    ping = np.broadcast_to(which[:, None], known.shape)
    return ping[known], middle_mm[known], np.sqrt(square_mm2[known])


def _ways(plane: Plane, centre_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Distance of each point (n, 3) to a surface."""
    x, y = plane.mirror_points(centre_mm).T
    return np.linalg.norm(centre_mm - np.column_stack((x, y, plane.at(x, y))), axis=1)


def _fitted(plane: Plane, centre_mm: NDArray[np.float64], way_mm: NDArray[np.float64]) -> Plane:
    """One step of Gauss and Newton; the derivatives are a parabola's, near enough where pings meet a surface."""
    x, y = plane.mirror_points(centre_mm).T
    off_mm = np.linalg.norm(centre_mm - np.column_stack((x, y, plane.at(x, y))), axis=1) - way_mm
    upright = 1 / np.sqrt(1 + sum(s * s for s in plane.slope_at(x, y)))
    dx, dy = x - plane.x_mm, y - plane.y_mm
    columns = upright[:, None] * np.column_stack((np.ones(x.size), dx, dy, dx**2 / 2, dx * dy, dy**2 / 2))
    size = np.linalg.norm(columns, axis=0)
    step = np.linalg.lstsq(columns / np.maximum(size, 1e-9), off_mm, rcond=1e-6)[0] / np.maximum(size, 1e-9)
    now = (plane.z_mm, plane.slope_x, plane.slope_y, plane.bend_xx, plane.bend_xy, plane.bend_yy)
    return Plane(plane.x_mm, plane.y_mm, *(float(a + b) for a, b in zip(now, step, strict=True)))


def _gentle(plane: Plane) -> bool:
    """Whether a surface bends neither like an edge nor like a bowl."""
    bends = np.linalg.eigvalsh([[plane.bend_xx, plane.bend_xy], [plane.bend_xy, plane.bend_yy]])
    return bool(bends.min() >= -SHARPEST_PER_MM and bends.max() <= HOLLOW_PER_MM)
