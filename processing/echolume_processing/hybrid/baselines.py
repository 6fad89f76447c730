"""The maps that the hybrid map has to beat: each sense alone, and the plain union of their points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_messages.types import Structured
from echolume_processing.hybrid.grid import STEPS_PER_MM, accumulate, cell_index
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.scipy_typed import NearestPoints
from echolume_processing.hybrid.witnesses import Triggers

NEAREST_MM = 20.0
"""A cell further than this from any ultrasonic point is not claimed by sound."""


@dataclass(frozen=True)
class Baselines:
    """Height images (rows, columns) in mm; nan where a map claims nothing."""

    optical_mm: NDArray[np.float64]
    ultrasonic_mm: NDArray[np.float64]
    union_mm: NDArray[np.float64]


def baselines(optical: Structured, ultrasonic: Structured, field: MapField) -> Baselines:
    """Maps of light alone, of sound alone (nearest contact point, the paper's Fig. 12) and of all points mixed.

    Parameters
    ----------
    optical
        ``OPTICAL_POINT`` (n,).
    ultrasonic
        ``ULTRASONIC_POINT`` (m,).
    field
        The raster of cells.
    """
    return Baselines(
        accumulate(optical, field).height_mm,
        nearest(ultrasonic, field),
        union(optical, ultrasonic, field),
    )


def nearest(points: Structured, field: MapField) -> NDArray[np.float64]:
    """Height of the nearest ultrasonic contact point at each cell within `NEAREST_MM`, else nan."""
    out = np.full(field.shape, np.nan)
    ordered = placed(points)
    index, _ = nearest_of(ordered, field)
    found = index < ordered.size
    out[found] = ordered["z_mm"][index[found]]
    return out


def placing(points: Structured, triggers: Triggers | None = None) -> NDArray[np.int64]:
    """Which contact points (n,) have a place, in an order of their own that no order of arrival changes."""
    with_place = np.isfinite(points["z_mm"]) & np.isfinite(points["x_mm"]) & np.isfinite(points["y_mm"])
    told = () if triggers is None else (triggers,)
    order = np.lexsort([*told, *(points[name] for name in ("zz_mm2", "z_mm", "y_mm", "x_mm"))])
    return order[with_place[order]]


def placed(points: Structured) -> Structured:
    """The contact points that have a place, in an order of their own that no order of arrival changes."""
    return points[placing(points)]


def nearest_of(points: Structured, field: MapField) -> tuple[NDArray[np.int64], NDArray[np.float64]]:
    """Which of some `placed` points is the nearest to each cell (rows, columns), and how far away it is, mm.

    The index is that behind the last point, and the distance infinite, where none is within `NEAREST_MM`.
    """
    if not points.size:
        return np.zeros(field.shape, dtype=np.int64), np.full(field.shape, np.inf)
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(field))
    known = NearestPoints(np.column_stack((points["x_mm"], points["y_mm"])).astype(np.float64))
    away_mm, index = known.nearest(np.column_stack((x_mm.ravel(), y_mm.ravel())), NEAREST_MM)
    return index.reshape(field.shape), away_mm.reshape(field.shape)


def union(optical: Structured, ultrasonic: Structured, field: MapField) -> NDArray[np.float64]:
    """Mean of all points in a cell, whichever sense they come from (the paper's hybrid image)."""
    cell = np.concatenate([cell_index(field, p["x_mm"], p["y_mm"]) for p in (optical, ultrasonic)])
    z_mm = np.concatenate([p["z_mm"].astype(np.float64) for p in (optical, ultrasonic)])
    good = (cell >= 0) & np.isfinite(z_mm)
    steps = np.round(z_mm[good] * STEPS_PER_MM)  # whole numbers: their sum does not depend on the order
    size = field.shape[0] * field.shape[1]
    number = np.bincount(cell[good], minlength=size)
    total = np.bincount(cell[good], weights=steps, minlength=size)
    mean = np.full(size, np.nan)
    np.divide(total, number * STEPS_PER_MM, out=mean, where=number > 0)
    return mean.reshape(field.shape)
