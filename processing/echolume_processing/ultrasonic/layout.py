"""What an array's layout can determine: one emitter and any number of receivers, anywhere."""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, require_shape

APART = 1e-6
"""Share of the layout's size below which receivers count as in one place, or on one line."""


@dataclass(frozen=True)
class Layout:
    """Receivers relative to the emitter, and what their paths to a surface determine."""

    receivers_mm: Points3
    rank: int
    """1: range only (one transducer, or emitter + receiver). 2: range and the tilt along the receivers' line (R-E-R).
    3: range and both tilts."""
    undetermined: NDArray[np.float64]
    """Unit directions in which the surface's tilt stays unknown, (3 - rank, 3); it is taken as none there."""
    columns: NDArray[np.float64]
    """The kernel's: x, y, z, squared length, and x, y less their parts along `undetermined`; (receivers, 6)."""
    ridge: NDArray[np.float64]
    """The kernel's: what keeps the undetermined directions at no tilt, (6,)."""
    deep: bool
    """Whether a receiver lies outside the plane z = 0 of the emitter."""


@lru_cache(maxsize=256)
def _analysed(data: bytes) -> Layout:
    receivers = np.frombuffer(data, dtype=np.float64).reshape(-1, 3)
    if not np.isfinite(receivers).all():
        raise ValueError("receivers_mm: expected finite positions relative to the emitter; calibrate the array")
    flat = receivers[:, :2]
    size = float(np.abs(flat).max(initial=0.0)) or 1.0
    _, spreads, directions = np.linalg.svd(flat - flat.mean(axis=0))
    rank = int(np.count_nonzero(spreads > APART * size))
    if rank == 0 and np.ptp(receivers[:, 2]) > APART * size:
        raise ValueError(
            "receivers_mm: they lie one behind the other along z, the axis; turn the frame towards the scene"
        )
    # exact directions where the layout is one place or the plane, so that zeros stay zeros
    open_ways = (np.eye(2), directions[1:], np.zeros((0, 2)))[rank]
    kept = flat - (flat @ open_ways.T) @ open_ways
    away = open_ways.T @ open_ways
    upper = away[[0, 0, 1], [0, 1, 1]]
    columns = np.column_stack([receivers, np.sum(receivers**2, axis=1), kept])
    undetermined = np.column_stack([open_ways, np.zeros(len(open_ways))])
    return Layout(
        receivers,
        1 + rank,
        undetermined,
        columns,
        np.concatenate([size**2 * upper, upper]),
        bool(np.any(receivers[:, 2])),
    )


def layout_of(receivers_mm: Points3) -> Layout:
    """Analyse receivers (n, 3) relative to the emitter, z towards the scene; the last layouts are remembered.

    Raises
    ------
    ValueError
        If they lie one behind the other along z, which determines a cone, or are not finite.

    Notes
    -----
    The echo's image seen by a line of receivers may turn about that line: R-E-R measures in its own plane only.
    Receivers need not be coplanar, nor the emitter in their plane; of two mirror images in a plane of receivers the
    one in front (larger z) is meant.
    """
    require_shape("receivers_mm", receivers_mm, (None, 3))
    if not len(receivers_mm):
        raise ValueError("receivers_mm: expected one receiver at least, got none")
    return _analysed(np.asarray(receivers_mm, dtype=np.float64).tobytes())
