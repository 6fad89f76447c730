"""Whether stated probabilities hold: of the labels said to be right with p, the share p should be."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from echolume.evaluation.images import NOT_ASKED, Claimed, Reference
from echolume_messages.types import Label

EDGES = (0.0, 0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9, 0.95, 0.98, 0.99, 0.995, 0.999, 1.0)
"""Of the bins: finer towards 1, where nearly all cells are; each holds its upper edge."""


class Bin(TypedDict):
    """Cells that state about the same probability."""

    low: float
    high: float
    cells: int
    stated: float
    """Mean of what they state."""
    right: float
    """Share of right labels among them."""


class Reliability(TypedDict):
    """Stated probabilities against right and wrong, over the cells whose label the truth knows."""

    cells: int
    label_brier: float
    """Mean of (stated - right)^2."""
    label_ece: float
    """Expected calibration error: mean distance of stated and right over the bins, by their cells."""
    right: float
    """Share of right labels in all."""
    bins: list[Bin]


def right(label: NDArray[np.int64], truth: NDArray[np.int64]) -> NDArray[np.bool_]:
    """Where a label is what the truth says, images.

    Notes
    -----
    Materials do not say that a cell is hidden from light. *Occluded* is right where the truth is matte: something that
    light comes back from, and did not.
    """
    plain = np.where(truth == Label.OCCLUDED, Label.MATTE, truth)
    return np.where(label == Label.OCCLUDED, Label.MATTE, label) == plain


def reliability(map_: Claimed, truth: Reference) -> Reliability | None:
    """Brier score, calibration error and bins of a map's labels; None if it states no probability of any."""
    if map_.label is None or map_.probability is None:
        return None
    asked = (map_.label != Label.UNKNOWN) & (truth.label != NOT_ASKED) & np.isfinite(map_.probability)
    if not asked.any():
        return None
    stated, hit = map_.probability[asked], right(map_.label, truth.label)[asked].astype(np.float64)
    bins = _bins(stated, hit)
    return Reliability(
        cells=stated.size,
        label_brier=float(np.mean((stated - hit) ** 2)),
        label_ece=sum(row["cells"] * abs(row["stated"] - row["right"]) for row in bins) / stated.size,
        right=float(hit.mean()),
        bins=bins,
    )


def _bins(stated: NDArray[np.float64], hit: NDArray[np.float64]) -> list[Bin]:
    number = np.clip(np.searchsorted(EDGES, stated) - 1, 0, len(EDGES) - 2)
    return [
        Bin(
            low=EDGES[k],
            high=EDGES[k + 1],
            cells=int((number == k).sum()),
            stated=float(stated[number == k].mean()),
            right=float(hit[number == k].mean()),
        )
        for k in np.unique(number).tolist()
    ]
