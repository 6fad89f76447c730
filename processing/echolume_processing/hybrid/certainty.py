"""How probable it is that a cell's label is right, from what speaks for it."""

from __future__ import annotations

from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from echolume_messages.types import Label
from echolume_processing.hybrid.scipy_typed import normal_tail


class Verdict(IntEnum):
    """What sound says of a cell's surface in the end."""

    NOTHING = 0
    """No ping reached it: what light saw is matte only because most things are."""
    AGREES = 1
    """The nearest ping returned what the surface predicts."""
    CONTRADICTS = 2
    """The nearest ping returned something else."""


RIM_SIGMA_MM = 0.85
"""Standard deviation of where the rim of a surface that sound found is put."""
TOO_WIDE_MM = 0.25
"""Such surfaces come out so much too wide."""
DARK_RIM_MM = 0.2
"""Light misses the edge of a plate: cells hidden from it beside a plate are so much nearer to being of the plate."""
MATTE_DOUBT = (0.15, 0.0005, 0.1)
"""That what light saw and sound left standing is not matte, by `Verdict`: the first is the share of glass among lit
cells where nobody asked sound."""
TRANSPARENT_DOUBT = (0.15, 0.002, 0.02)
OCCLUDED_DOUBT = (0.15, 0.002, 0.35)
LEFT_HALF, LEFT_POWER = 0.15, 5.0
"""A dark surface that leaves over the first share of the residual is as often absorbing as not; one that leaves less is
so more often, by the second power of it."""
CONFIRMED_ABSORBING_DOUBT = 0.95
"""Of dark cells that took the height of the ground beside them: most are shadows, or a plate's, all the same."""
BY_RULE = {Label.UNKNOWN: 0.0, Label.MATTE: 0.85, Label.TRANSPARENT: 0.85, Label.ABSORBING: 0.25, Label.OCCLUDED: 0.6}
"""Share of right labels of rules that only compare heights."""


def probability(
    label: NDArray[np.uint8], off_mm: NDArray[np.float64], left: NDArray[np.float64], verdict: NDArray[np.uint8]
) -> NDArray[np.float64]:
    """How probable each label is; 0 for cells that are unknown. All arrays of one shape.

    Parameters
    ----------
    label
        `Label` of each cell.
    off_mm
        Distance of each cell to the nearest rim of a surface that sound found, from within as from beside it.
    left
        Share of the residual that the cell's surface leaves over; nan where it is of none.
    verdict
        `Verdict` of each cell.

    Notes
    -----
    Two things can be wrong: the surface as a whole, and on which side of its rim a cell lies. They are taken as
    independent. The constants are fitted to scans with a known truth (docs/decisions/0021).
    """
    doubt = np.ones(label.shape)
    for kind, doubts in (
        (Label.MATTE, MATTE_DOUBT),
        (Label.TRANSPARENT, TRANSPARENT_DOUBT),
        (Label.OCCLUDED, OCCLUDED_DOUBT),
    ):
        doubt = np.where(label == kind, np.array(doubts)[verdict], doubt)
    doubt = np.where(label == Label.ABSORBING, absorbing_doubt(left), doubt)
    shift_mm = np.zeros(label.shape)
    for kind, by_mm in ((Label.MATTE, TOO_WIDE_MM), (Label.TRANSPARENT, -TOO_WIDE_MM), (Label.OCCLUDED, -DARK_RIM_MM)):
        shift_mm[label == kind] = by_mm
    return np.where(label == Label.UNKNOWN, 0.0, (1 - doubt) * (1 - other_side(off_mm + shift_mm)))


def other_side(off_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """How probable it is that a cell so far off a rim lies on its other side."""
    return normal_tail(off_mm / RIM_SIGMA_MM)


def absorbing_doubt(left: NDArray[np.float64]) -> NDArray[np.float64]:
    """That a dark surface is not absorbing, from the share of the residual that it leaves over; nan: it is of none."""
    power = np.power(np.nan_to_num(left) / LEFT_HALF, LEFT_POWER)
    return np.where(np.isnan(left), CONFIRMED_ABSORBING_DOUBT, power / (1 + power))


def by_rule(label: NDArray[np.uint8]) -> NDArray[np.float64]:
    """How probable each label is that a rule gave which only compares heights; 0 for cells that are unknown.

    Notes
    -----
    Such rules do not know how well a surface explains the echoes, nor where its rim is: they state for each kind of
    label what share of it was right on a few scans, and nothing of the single cell.
    """
    return np.array([BY_RULE[kind] for kind in Label])[label]
