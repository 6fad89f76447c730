"""Heights of steps, plane to plane, where the truth has two level flats beside each other."""

from __future__ import annotations

from itertools import combinations
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from echolume.evaluation.images import Claimed, Reference
from echolume.evaluation.regions import Region, distance_mm, points_of
from echolume.evaluation.sensors import Sense, sense_of
from echolume_messages.plan import MapField

WIDEST_MM = 30.0
"""No more of a flat than this is used beside a step."""
SHORTEST = 10
"""Cells that two flats must have side by side."""
FEWEST = 20
"""Measured cells that each side needs."""


class Step(TypedDict):
    """One step of the truth, as measured."""

    x_mm: float
    y_mm: float
    nominal_mm: float
    measured_mm: float
    error_mm: float
    sigma_mm: float
    """Of the height, taking the residual for noise; large where the two sides tell little of their tilt."""
    residual_mm: float
    """RMS distance of the cells from the two planes."""
    cells: int
    sense: Sense


class StepSummary(TypedDict):
    """All steps of one sense."""

    count: int
    rms_mm: float
    worst_mm: float


def steps(map_: Claimed, truth: Reference, found: list[Region], field: MapField) -> list[Step]:
    """Every step between two level flats of the truth, in the manner of ISO 5436-1 (type A).

    Notes
    -----
    Both sides share one tilt: z = a x + b y + c + h d is fitted with d = 1 on the upper side and 0 on the lower. With w
    the width of the narrower flat (at most 30 mm), a third of it next to any edge is left out, and cells further than w
    from the other flat; so of a ridge its middle third counts, and of the ground as much beside it.

    References
    ----------
    ISO 5436-1:2000 (now in ISO 25178-70:2014) has this fit for profiles over grooves; here it is made over areas.
    """
    level = [region for region in found if region.shape == "level"]
    made = (_step(map_, truth, one, other, field) for one, other in combinations(level, 2))
    return sorted((step for step in made if step is not None), key=lambda step: (step["x_mm"], step["y_mm"]))


def summary(found: list[Step]) -> dict[str, StepSummary]:
    """Errors of the steps by sense."""
    rows: dict[str, StepSummary] = {}
    for sense in sorted({step["sense"] for step in found}):
        error_mm = np.array([step["error_mm"] for step in found if step["sense"] == sense])
        rows[sense] = StepSummary(
            count=error_mm.size,
            rms_mm=float(np.sqrt(np.mean(error_mm**2))),
            worst_mm=float(np.abs(error_mm).max()),
        )
    return rows


def _step(map_: Claimed, truth: Reference, one: Region, other: Region, field: MapField) -> Step | None:
    if _beside(one.cells, other.cells) < SHORTEST:
        return None
    if truth.front_mm[one.cells][0] > truth.front_mm[other.cells][0]:
        one, other = other, one
    width_mm = min(one.width_mm, other.width_mm, WIDEST_MM)
    sides: list[NDArray[np.bool_]] = []
    for side, far in ((one, other), (other, one)):
        near = (side.inside_mm >= width_mm / 3) & (distance_mm(far.cells, field) <= width_mm)
        sides.append(side.cells & near & np.isfinite(map_.front_mm))
    if min(int(side.sum()) for side in sides) < FEWEST:
        return None
    used = sides[0] | sides[1]
    measured_mm, sigma_mm, residual_mm = height_of_step(points_of(used, map_.front_mm, field), sides[1][used])
    nominal_mm, *_ = height_of_step(points_of(used, truth.front_mm, field), sides[1][used])
    edge = points_of(one.cells & (distance_mm(other.cells, field) < field.cell_mm), truth.front_mm, field)
    return Step(
        x_mm=float(edge[:, 0].mean()),
        y_mm=float(edge[:, 1].mean()),
        nominal_mm=nominal_mm,
        measured_mm=measured_mm,
        error_mm=measured_mm - nominal_mm,
        sigma_mm=sigma_mm,
        residual_mm=residual_mm,
        cells=int(used.sum()),
        sense=sense_of(map_, used),
    )


def height_of_step(points_mm: NDArray[np.float64], upper: NDArray[np.bool_]) -> tuple[float, float, float]:
    """Distance in z of two parallel planes through points (n, 3), its sigma, and the RMS of what is left."""
    x, y, z = (points_mm - points_mm.mean(axis=0)).T
    design = np.column_stack([x, y, np.ones_like(x), upper.astype(np.float64)])
    solved, *_ = np.linalg.lstsq(design, z, rcond=None)
    residual_mm = float(np.sqrt(np.sum((z - design @ solved) ** 2) / max(1, z.size - 4)))
    return float(solved[3]), residual_mm * float(np.sqrt(np.linalg.pinv(design.T @ design)[3, 3])), residual_mm


def _beside(one: NDArray[np.bool_], other: NDArray[np.bool_]) -> int:
    """How many cells of the two are neighbours."""
    along_x = int((one[:, 1:] & other[:, :-1]).sum() + (one[:, :-1] & other[:, 1:]).sum())
    return along_x + int((one[1:] & other[:-1]).sum() + (one[:-1] & other[1:]).sum())
