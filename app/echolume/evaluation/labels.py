"""Labels against the truth's: recall, precision, who is taken for whom; and the glass, plate by plate."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from echolume.evaluation.images import NOT_ASKED, Claimed, Reference
from echolume.evaluation.regions import components
from echolume_messages.plan import MapField
from echolume_messages.types import Label

SMALLEST_PLATE = 4
"""Cells."""


class LabelScore(TypedDict):
    """How one label fares; None where there is nothing to divide by."""

    truth: int
    """Cells that should have it."""
    named: int
    """Cells that have it, among those whose label the truth knows."""
    recall: float | None
    precision: float | None


class Plate(TypedDict):
    """One piece of glass of the truth."""

    x_mm: float
    y_mm: float
    cells: int
    height_mm: float
    recall: float
    error_mm: float | None
    """Median of height minus truth, over its cells that the map calls transparent."""


class Glass(TypedDict):
    """Heights on glass, over the cells where truth and map agree that it is glass."""

    cells: int
    median_mm: float | None
    """Median of height minus truth."""
    median_abs_mm: float | None
    behind_rmse_mm: float | None
    plates: list[Plate]


def label_scores(label: NDArray[np.int64], truth: NDArray[np.int64]) -> dict[str, LabelScore]:
    """Recall and precision of every label, over the cells (rows, columns) whose label the truth knows.

    Notes
    -----
    Materials do not say of any cell that it should be occluded or unknown: against them these two have neither recall
    nor precision.
    """
    asked = truth != NOT_ASKED
    known = {int(v) for v in np.unique(truth[asked])}
    scores: dict[str, LabelScore] = {}
    for kind in Label:
        real, named = asked & (truth == kind), asked & (label == kind)
        hit, has = int((real & named).sum()), kind.value in known
        scores[kind.name.lower()] = LabelScore(
            truth=int(real.sum()),
            named=int(named.sum()),
            recall=hit / int(real.sum()) if has else None,
            precision=hit / int(named.sum()) if named.any() and (has or _is_material(kind)) else None,
        )
    return scores


def _is_material(kind: Label) -> bool:
    return kind in (Label.MATTE, Label.TRANSPARENT, Label.ABSORBING)


def confusion(label: NDArray[np.int64], truth: NDArray[np.int64]) -> dict[str, dict[str, int]]:
    """Cells by the truth's label, then by the map's; ``any`` are those of which the truth asks no label."""
    names = {NOT_ASKED: "any", **{kind.value: kind.name.lower() for kind in Label}}
    return {
        names[code]: {kind.name.lower(): int(((truth == code) & (label == kind)).sum()) for kind in Label}
        for code in sorted({int(v) for v in np.unique(truth)})
    }


def glass(map_: Claimed, truth: Reference, field: MapField) -> Glass | None:
    """Heights on glass; None if the truth has none or the map does not label."""
    real = truth.label == Label.TRANSPARENT
    if map_.label is None or not real.any():
        return None
    error_mm = map_.front_mm - truth.front_mm
    hit = real & (map_.label == Label.TRANSPARENT) & np.isfinite(error_mm)
    seen = np.full(hit.shape, np.nan) if map_.behind_mm is None else map_.behind_mm - truth.behind_mm
    behind_mm = seen[hit & np.isfinite(seen)]
    return Glass(
        cells=int(hit.sum()),
        median_mm=_median(error_mm[hit]),
        median_abs_mm=_median(np.abs(error_mm[hit])),
        behind_rmse_mm=float(np.sqrt(np.mean(behind_mm**2))) if behind_mm.size else None,
        plates=_plates(real, hit, error_mm, truth.front_mm, field),
    )


def _plates(
    real: NDArray[np.bool_],
    hit: NDArray[np.bool_],
    error_mm: NDArray[np.float64],
    front_mm: NDArray[np.float64],
    field: MapField,
) -> list[Plate]:
    number, count = components(real[:, 1:] & real[:, :-1], real[1:] & real[:-1])
    plates: list[Plate] = []
    for k in np.flatnonzero(np.bincount(number[real], minlength=count) >= SMALLEST_PLATE):
        at = (number == k) & real
        iy, ix = np.nonzero(at)
        plates.append(
            Plate(
                x_mm=field.x_mm[0] + (float(ix.mean()) + 0.5) * field.cell_mm,
                y_mm=field.y_mm[0] + (float(iy.mean()) + 0.5) * field.cell_mm,
                cells=int(at.sum()),
                height_mm=float(np.median(front_mm[at])),
                recall=int((at & hit).sum()) / int(at.sum()),
                error_mm=_median(error_mm[at & hit]),
            )
        )
    return plates


def _median(values: NDArray[np.float64]) -> float | None:
    return float(np.median(values)) if values.size else None
