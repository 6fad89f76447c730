"""Which stripe candidate of one camera is which of the other: the plane predicts, the epipolar line decides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, require_shape
from echolume_processing.optical import epipolar
from echolume_processing.optical.candidates import Candidates

Values = NDArray[np.float64]
Indices = NDArray[np.int64]

TOLERANCE_PX = 2.5
"""How far the other camera's stripe may lie from where the laser plane predicts it."""


@dataclass(frozen=True)
class Match:
    """What the other camera says to each of n candidates.

    Attributes
    ----------
    partner : (n,) int64
        Matched candidate of the other camera, -1 where there is none.
    points_px : (2, n) float64
        The other camera's undistorted point on the epipolar line, between two rows of its stripe.
    off_px : (n,) float64
        Distance of that point from the column that the laser plane predicts.
    gain : (n,) float64
        Variance of that point along the line, over the variance of the partner's column.
    """

    partner: Indices
    points_px: Values
    off_px: Values
    gain: Values


def walk(side: Candidates, other: Candidates, f: Matrix, tolerance_px: float = TOLERANCE_PX) -> Match:
    """Match each candidate to the other camera's stripe by an epipolar walk with linear interpolation.

    Parameters
    ----------
    side, other : Candidates
        Of this camera and of the other one.
    f : (3, 3)
        Fundamental matrix, ``other_h^T f this_h = 0``.
    tolerance_px : float
        How far the crossing may lie from where the laser plane predicts it.
    """
    require_shape("f", f, (3, 3))
    n = len(side.row)
    found = Match(np.empty(n, dtype=np.int64), np.empty((2, n)), np.empty(n), np.empty(n))
    epipolar.walk(
        side.points_px, side.expected_px, other.start, other.points_px, f, tolerance_px,
        found.partner, found.points_px, found.off_px, found.gain,
    )  # fmt: skip
    return found
