"""The rim of a plate where light sees it: a line of cells at the plate's own height."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints, depth_inside, distance_to, opened
from echolume_processing.hybrid.state import State

OFF_MM = 1.0
"""A lit cell this near to a plate's plane may be its rim."""
NEAR_MM = 4.0
"""So far from the outline as sound finds it."""
BROAD_CELLS = 3
"""Where so many lie side by side they are a surface."""
LEAST_RISE_MM = 4.0
"""Light sees the ground below a plate too high by a millimetre or two: a lower plate's rim is not told from it."""
BENT_MM = (0.3, 4.0)
"""Through a plate a camera sees the ground too high by so much,"""
SAME_MM = 0.7
"""and beside its rim, where it looks through it aslant, as much as inside, but for this."""
LEAST_CELLS = 20
SHARES = (0.3, 0.9)
"""Between these lies the occupancy that is told from a rim."""
EVEN = 0.5


@dataclass(frozen=True)
class LitRim:
    """Cells at a plate's rim that light sees, and the state in which they are ground."""

    lit: Mask
    bent: Mask
    """Cells beside it where light sees the ground through it."""
    state: State

    def share_at(self, share: NDArray[np.float64]) -> float:
        """Occupancy at which to cut an outline so that it agrees with the rim that light sees; one half without one.

        Notes
        -----
        Beside a plate the ground's echo is weak, bent around the edge, which a prediction with sharp shadows takes for
        more plate: it comes out too wide all around, by the same on each side.
        """
        if self.lit.sum() < LEAST_CELLS:
            return EVEN
        return float(np.clip(share[self.lit].mean(), *SHARES))


def lit_rim(state: State, mask: Mask, plane: Plane, seen: Mask) -> LitRim:
    """What light sees of a plate's rim, and the ground there without it.

    Parameters
    ----------
    mask
        The plate as sound finds it.
    seen
        Cells that light saw.
    """
    field, height_mm = state.scene.field, state.scene.height_mm
    plate_mm = plane.image(field)
    around = distance_to(mask) * field.cell_mm
    as_high = seen & (np.abs(height_mm - plate_mm) <= OFF_MM)
    lit = as_high & ~opened(as_high, BROAD_CELLS) & (around <= NEAR_MM)
    low = ~lit & (height_mm < plate_mm - LEAST_RISE_MM)
    ground = low & (around > NEAR_MM) & (around <= 3 * NEAR_MM)
    nothing = np.zeros_like(mask)
    if not ground.any():
        return LitRim(nothing, nothing, state)
    ground_mm = np.where(lit, _nearest(height_mm, ground, lit), height_mm)
    inner = depth_inside(mask) * field.cell_mm
    beside = seen & low & (around <= NEAR_MM) & (inner <= NEAR_MM)
    bent = beside & _bent(height_mm, ground, low & seen & (inner > 0), beside)
    if not (lit | bent).any():
        return LitRim(nothing, nothing, state)
    ground_mm = np.where(bent, _nearest(height_mm, ground, bent), ground_mm)
    return LitRim(lit, bent, state.with_heights(ground_mm, lit | bent))


def _bent(height_mm: NDArray[np.float64], ground: Mask, inside: Mask, beside: Mask) -> Mask:
    """Cells beside a rim that light sees as it sees what lies below the plate, too high by a little."""
    if not inside.any():
        return np.zeros_like(beside)
    rise_mm = height_mm - _nearest(height_mm, ground, beside)
    like_inside = np.abs(height_mm - _nearest(height_mm, inside, beside)) <= SAME_MM
    return beside & like_inside & (rise_mm > BENT_MM[0]) & (rise_mm < BENT_MM[1])


def _nearest(height_mm: NDArray[np.float64], among: Mask, where: Mask) -> NDArray[np.float64]:
    """Of the cells of a mask, the height of the nearest cell of another; elsewhere their own."""
    out = height_mm.copy()
    if where.any():
        known = NearestPoints(np.argwhere(among).astype(np.float64))
        _, nearest = known.nearest(np.argwhere(where).astype(np.float64))
        out[where] = height_mm[among][nearest]
    return out
