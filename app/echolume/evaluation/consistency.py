"""Whether the sigmas that a map states are those of its errors."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray
from scipy.stats import chi2

from echolume.evaluation.images import Claimed, Reference
from echolume.evaluation.sensors import BITS

TWO_SIDED_95 = 1.959963984540054
MEDIAN_OF_ONE = 0.454936423119572
"""Median of a squared standard normal deviate."""


class Consistency(TypedDict):
    """Errors over stated sigmas; None where no cell states one."""

    cells: int
    nees: float | None
    """Mean of squared error over variance; 1 if the sigmas are right."""
    nees_interval95: tuple[float, float] | None
    """Where it lies in 95 % of cases if they are, and the cells are independent."""
    nees_median: float | None
    """The same from the median, which a few gross errors do not move."""
    coverage95: float | None
    """Share of the cells whose error is within 1.96 sigmas."""


def consistency(map_: Claimed, truth: Reference, among: NDArray[np.bool_]) -> Consistency:
    """Errors over sigmas of the chosen cells (rows, columns); a truth's own sigmas are added to the map's."""
    if map_.sigma_mm is None:
        return Consistency(cells=0, nees=None, nees_interval95=None, nees_median=None, coverage95=None)
    error_mm = map_.front_mm - truth.front_mm
    with np.errstate(invalid="ignore"):
        there = among & np.isfinite(error_mm) & np.isfinite(map_.sigma_mm) & (map_.sigma_mm > 0)
    variance = map_.sigma_mm[there] ** 2 + truth.sigma_mm[there] ** 2
    squared = error_mm[there] ** 2 / variance
    if not squared.size:
        return Consistency(cells=0, nees=None, nees_interval95=None, nees_median=None, coverage95=None)
    low, high = (float(chi2.ppf(share, squared.size)) / squared.size for share in (0.025, 0.975))
    return Consistency(
        cells=squared.size,
        nees=float(squared.mean()),
        nees_interval95=(low, high),
        nees_median=float(np.median(squared)) / MEDIAN_OF_ONE,
        coverage95=float((squared <= TWO_SIDED_95**2).mean()),
    )


def by_sensor(map_: Claimed, truth: Reference, among: NDArray[np.bool_]) -> dict[str, Consistency] | None:
    """The same for the cells that rest, among others, on each sensor."""
    if map_.provenance is None:
        return None
    bits = map_.provenance
    return {name: consistency(map_, truth, among & ((bits & value) != 0)) for name, value in BITS.items()}
