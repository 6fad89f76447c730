"""What contact points say of each cell: the nearest one's height, without those that hear a rim from beside it."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.plan import MapField
from echolume_messages.types import NO_TRIGGER, EchoKind, Structured
from echolume_processing.hybrid.baselines import nearest_of, placing
from echolume_processing.hybrid.holes import BENCH_MM
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.rules.band import footprint_mm, narrow, wavelength_mm
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints
from echolume_processing.hybrid.witnesses import Triggers

DOUBTFUL_MM = 5.0
"""Standard deviation of a contact point that no surface explains, and that therefore states none."""
LEAST_SIGMA_MM = 0.01
LATE_RAD = 0.4
"""So far behind its neighbours' phase an echo comes from a rim that the array does not stand over."""
SAME_WAVES = 0.2
"""Contact points whose heights differ by less, in wavelengths, are of one surface; a quarter would be a slip."""
LATE_SHARE = 0.1
"""Of the neighbours on the same surface, so many must be ahead: one of them may err."""
NEIGHBOURS, EVERY = 32, 3
"""So many of every third contact point are asked; with the demo's raster they lie within 20 mm."""
CLEAN_MM = 0.05
"""What the covariance of a contact point on a plane leaves out: errors of the calibration, one for all pings."""
DEEP_MM = 20.0
"""A contact point so far below the bench heard a detour."""
RIMS_MM = (1.0, 2.0, 3.0, 4.0, 6.0, 8.0)
"""Distances in which a cell looks for another surface."""
RIM_SHARE, RIM_MM = 0.3, 0.8
"""Share of cells that belong to that other surface, and the distance over which it falls by e."""
SLACK = 0.5
"""A rim may be nearer than it looks, by this share of the distance to the cell's contact point."""


@dataclass(frozen=True)
class SoundImage:
    """What contact points say of each cell; images of the field's shape, nan beyond their reach."""

    height_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]
    """Of the cell: what its contact point states, and that it may lie on the other side of a rim."""
    stated_mm: NDArray[np.float64]
    """Of the contact point alone."""
    ping: Triggers
    """Trigger of the ping of the point that speaks; `NO_TRIGGER` where none does, or nobody told it."""


def late_mm(array: ArrayCalibration) -> float:
    """How much too low a contact point beside a rim is at least: half of `LATE_RAD` in path."""
    return LATE_RAD / (4 * np.pi) * wavelength_mm(array)


def beside(points: Structured, array: ArrayCalibration) -> Mask:
    """Which contact points hear a surface that they do not stand over.

    Parameters
    ----------
    points
        ``ULTRASONIC_POINT`` (n,), sorted: among equally far neighbours the order decides.
    array
        What they were heard with.

    Returns
    -------
    Mask
        (n,). Never those that a plane or a point explains.

    Notes
    -----
    Over a half plane an echo has half of its amplitude at the edge, and its phase falls behind from there on, because
    the nearest part of the surface lies aside; between two bars, two such halves add up to a whole. A contact point is
    beside a rim if a tenth of the neighbours of its own height are ahead of it by more than `late_mm`. Surfaces that
    curve more than that within a footprint lose the lower part of what no model explains.
    """
    out = np.zeros(points.size, dtype=np.bool_)
    asked = np.flatnonzero(points["kind"] == EchoKind.NONE)
    if not asked.size:
        return out
    place = np.column_stack((points["x_mm"], points["y_mm"])).astype(np.float64)
    near = NearestPoints(place[::EVERY]).some(place[asked], NEIGHBOURS, footprint_mm(array)[0])
    height_mm = points["z_mm"].astype(np.float64)
    ahead_mm = np.append(height_mm[::EVERY], np.nan)[near] - height_mm[asked, None]
    same = np.abs(ahead_mm) < SAME_WAVES * wavelength_mm(array)
    late = same & (ahead_mm > late_mm(array))
    out[asked] = late.sum(axis=1) > LATE_SHARE * same.sum(axis=1)
    return out


def sound_image(
    points: Structured, array: ArrayCalibration, field: MapField, triggers: Triggers | None = None
) -> SoundImage:
    """The nearest contact point of each cell that is not `beside` its surface.

    Notes
    -----
    A point that a plane explains gives the height of that plane at the cell. One that nothing explains states no
    sigma; having passed, it counts with `late_mm`, or with `DOUBTFUL_MM` if the band is narrow.
    """
    order = placing(points, triggers)
    points = points[order]
    kept = (points["z_mm"] > BENCH_MM - DEEP_MM) & ~beside(points, array)
    points, order = points[kept], order[kept]
    index, away_mm = nearest_of(points, field)
    found = index < points.size
    height_mm, stated_mm = np.full(field.shape, np.nan), np.full(field.shape, np.nan)
    ping = np.full(field.shape, NO_TRIGGER, dtype=np.uint32)
    if not found.any():
        return SoundImage(height_mm, stated_mm, stated_mm, ping)
    nearest = index[found]
    height_mm[found] = carried_mm(points.take(nearest), *(axis[found] for axis in np.meshgrid(*cell_centres_mm(field))))
    unexplained_mm = DOUBTFUL_MM if narrow(array) else late_mm(array)
    stated_mm[found] = np.hypot(sigma_of(points, unexplained_mm), CLEAN_MM)[nearest]
    sigma_mm = np.sqrt(stated_mm**2 + rim_mm2(height_mm, away_mm, field.cell_mm))
    if triggers is not None:
        ping[found] = triggers[order[nearest]]
    return SoundImage(height_mm, sigma_mm, stated_mm, ping)


def carried_mm(points: Structured, x_mm: NDArray[np.float64], y_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Height of each contact point (n,) at another place (n,), along its plane where one explains it."""
    along_mm = points["nx"] * (x_mm - points["x_mm"]) + points["ny"] * (y_mm - points["y_mm"])
    rise_mm = np.zeros(points.size)
    np.divide(along_mm, -points["nz"], out=rise_mm, where=points["kind"] == EchoKind.PLANE)
    return points["z_mm"] + rise_mm


def sigma_of(points: Structured, unexplained_mm: float = DOUBTFUL_MM) -> NDArray[np.float64]:
    """Standard deviation of the height of contact points (n,), mm; `unexplained_mm` where they state none."""
    variance = points["zz_mm2"].astype(np.float64)
    stated = np.isfinite(variance) & (variance > 0)
    sigma_mm = np.sqrt(np.where(stated, variance, unexplained_mm**2))
    return np.asarray(np.clip(sigma_mm, LEAST_SIGMA_MM, DOUBTFUL_MM), dtype=np.float64)


def rim_mm2(height_mm: NDArray[np.float64], away_mm: NDArray[np.float64], cell_mm: float) -> NDArray[np.float64]:
    """Variance of cells (rows, columns) that may belong to the other side of a rim nearby.

    Parameters
    ----------
    height_mm
        Heights of the nearest contact points; nan where there is none.
    away_mm
        Distance to that point.
    cell_mm
        Of the raster.

    Returns
    -------
    In mm2; nan where there is no point.

    Notes
    -----
    P relief^2, the largest over `RIMS_MM`, with P = 0.3 exp(-distance / 0.8 mm), the distance less half of that to the
    contact point. Set on the errors of six scans; for cells away from the truth's edges.
    """
    known = np.isfinite(height_mm)
    variance = np.zeros(height_mm.shape)
    lowest = np.where(known, height_mm, np.nanmax(height_mm))
    highest = np.where(known, height_mm, np.nanmin(height_mm))  # what is unknown makes no rim
    within_mm = 0.0
    for reach_mm in RIMS_MM:
        around = disk(reach_mm, cell_mm)
        rise_mm = cv2.dilate(highest, around) - cv2.erode(lowest, around)
        off_mm = np.maximum(0.0, within_mm - SLACK * np.where(known, away_mm, 0.0))
        share = RIM_SHARE * np.exp(-off_mm / RIM_MM)
        variance = np.maximum(variance, share * rise_mm**2)
        within_mm = reach_mm
    return np.where(known, variance, np.nan)


def disk(radius_mm: float, cell_mm: float) -> NDArray[np.uint8]:
    """Cells within a radius of the middle one, which always is, as a square image of 0 and 1."""
    reach = max(1, round(radius_mm / cell_mm))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    out = ((x**2 + y**2) * cell_mm**2 <= radius_mm**2).astype(np.uint8)
    out[reach, reach] = 1
    return out
