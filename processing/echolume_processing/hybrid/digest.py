"""The digest of a hybrid map: the same evidence gives the same sixteen hex digits."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence

import numpy as np

from echolume_processing.hybrid.model import HybridMap


def digest(found: HybridMap, names: Sequence[str] | None = None) -> str:
    """SHA-256 over the field, the sorted cells and the triggers that they rest on; first 16 hex digits.

    Parameters
    ----------
    found
        The map; its notes, registration and origin do not count.
    names
        Fields that count, as in a file of an earlier format; all if not given.

    Notes
    -----
    Every nan is written as the same nan. The digest holds for the same machine and versions: other versions of
    the numeric libraries may round differently.
    """
    cells = found.cells
    place = cells["iy"].astype(np.int64) * (1 << 16) + cells["ix"]
    if (np.diff(place) < 0).any():  # sorting records is slow, and maps come sorted
        cells = cells[np.argsort(place, kind="stable")]
    state = hashlib.sha256()
    state.update(np.array([*found.field.x_mm, *found.field.y_mm, found.field.cell_mm], dtype="<f8").tobytes())
    for name in names or cells.dtype.names or ():
        column = np.ascontiguousarray(cells[name])
        if column.dtype.kind == "f":
            column = np.where(np.isnan(column), np.float32(np.nan), column + np.float32(0.0))
        state.update(name.encode())
        state.update(column.tobytes())
    for name, table in (("stripes", found.stripes), ("pings", found.pings)):
        if table.which.size:
            state.update(name.encode())
            state.update(table.start.tobytes())
            state.update(table.which.tobytes())
    return state.hexdigest()[:16]
