"""Which stripe candidate of one camera is which of the other: the plane predicts, the epipolar line decides."""

from __future__ import annotations

from echolume_messages.geometry import Matrix, require_shape
from echolume_processing.optical import epipolar
from echolume_processing.optical.candidates import Candidates
from echolume_processing.optical.epipolar import Match

__all__ = ["TOLERANCE_PX", "Match", "walk"]

TOLERANCE_PX = 2.5
"""How far the other camera's stripe may lie from where the laser plane predicts it."""


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
    return epipolar.walk(side, other, f, tolerance_px)
