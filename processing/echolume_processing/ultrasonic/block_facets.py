"""The calibration block as light sees it, cut into horizontal facets for sound."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Points3, require_shape

FACET_MM = 2.0
RAISED_MM = 3.0
"""Optical points lower than this are the plate."""


def raised_facets(points_mm: Points3, facet_mm: float = FACET_MM) -> tuple[Points3, NDArray[np.float64]]:
    """Horizontal facets wherever the nearest optical points are raised above the plate.

    Parameters
    ----------
    points_mm : (n, 3) float64
        Optical points of the block and some plate around it, rig frame.

    Returns
    -------
    centres_mm : (facets, 3) float64
    area_mm2 : (facets,) float64
        Facets at the block's edges are smaller than those inside.
    """
    require_shape("points_mm", points_mm, (None, 3))
    raised = points_mm[points_mm[:, 2] > RAISED_MM]
    if len(raised) < 50:
        raise CalibrationRejectedError(
            f"array calibration: light sees no block on the plate ({len(raised)} points above {RAISED_MM} mm); put the "
            "block on the bench for the passes 'block-light' and 'block-sound'"
        )
    fine_mm = facet_mm / 8
    low, high = raised[:, :2].min(axis=0) - 2 * facet_mm, raised[:, :2].max(axis=0) + 2 * facet_mm
    x, y = (np.arange(low[k] + 0.5 * fine_mm, high[k], fine_mm) for k in (0, 1))
    grid = np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2)
    inside = np.all((points_mm[:, :2] > low - 2) & (points_mm[:, :2] < high + 2), axis=1)
    near = points_mm[inside]
    query = KDTree(near[:, :2]).query(grid)
    apart, nearest = np.asarray(query[0], dtype=np.float64), np.asarray(query[1], dtype=np.int64)
    # Light leaves holes at the foot of a wall only: what lies further from a point than is usual on the block itself
    # (half the pitch of the stripes) belongs to the plate.
    inner = np.all((grid > low + 4 * facet_mm) & (grid < high - 4 * facet_mm), axis=1)
    reach_mm = 1.2 * float(np.percentile(apart[inner], 99)) if inner.any() else facet_mm
    on_top = (near[nearest, 2] > RAISED_MM) & (apart <= reach_mm)
    cell = np.floor((grid[on_top] - low) / facet_mm).astype(np.int64)
    _, group, count = np.unique(cell, axis=0, return_inverse=True, return_counts=True)
    group = group.ravel()
    columns = [grid[on_top, 0], grid[on_top, 1], near[nearest[on_top], 2]]
    centres = np.column_stack([np.bincount(group, c) / count for c in columns])
    return centres, (count * fine_mm**2).astype(np.float64)
