"""Light's cells, kept up to date stripe by stripe: at any time the bits that `accumulate` gives for all of them."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from echolume_messages.plan import MapField
from echolume_messages.types import OPTICAL_POINT, Structured
from echolume_processing.hybrid.grid import OpticalGrid, cell_index, centred, gather
from echolume_processing.hybrid.witnesses import Witnesses, tabled

IMAGES = ("height_mm", "sigma_mm", "count", "provenance")


class LightCells:
    """Optical points by the column of cells that they fall into, and the cells that they make."""

    def __init__(self, field: MapField) -> None:
        self._field = field
        self._columns: list[dict[int, Structured]] = [{} for _ in range(field.shape[1])]
        self._touched: dict[int, tuple[int, ...]] = {}
        self._stripes: Witnesses | None = None
        self._gathered = gather(np.zeros(0, dtype=OPTICAL_POINT), field)

    @property
    def grid(self) -> OpticalGrid:
        """Of all stripes so far; good until the next stripe, which changes some of its images."""
        if self._stripes is None:
            self._stripes = self._witnesses()
        return replace(centred(self._gathered), stripes=self._stripes)

    def put(self, trigger: int, points: Structured) -> None:
        """Take a stripe; of a trigger that was acquired twice the later points replace the earlier.

        Parameters
        ----------
        trigger
            Of the stripe.
        points
            ``OPTICAL_POINT`` (n,) in any order.
        """
        self._stripes = None
        before = self._touched.pop(trigger, ())
        for column in before:
            del self._columns[column][trigger]
        cell = cell_index(self._field, points["x_mm"], points["y_mm"])
        inside = (cell >= 0) & np.isfinite(points["z_mm"])
        column, used = cell[inside] % self._field.shape[1], points[inside]
        order = np.argsort(column, kind="stable")
        names, starts = np.unique(column[order], return_index=True)
        for name, part in zip(names.tolist(), np.split(used[order], starts[1:]), strict=True) if names.size else ():
            self._columns[name][trigger] = part
        self._touched[trigger] = tuple(names.tolist())
        self._renew(sorted({*before, *names.tolist()}))

    def _renew(self, columns: list[int]) -> None:
        """Make the cells of some columns again from the points in them."""
        parts = [part for column in columns for part in self._columns[column].values()]
        fresh = gather(np.concatenate(parts) if parts else np.zeros(0, dtype=OPTICAL_POINT), self._field)
        for name in IMAGES:
            getattr(self._gathered.grid, name)[:, columns] = getattr(fresh.grid, name)[:, columns]
        self._gathered.aside_mm[:, :, columns] = fresh.aside_mm[:, :, columns]

    def _witnesses(self) -> Witnesses:
        """Stripes of each cell."""
        parts = [(trigger, part) for column in self._columns for trigger, part in column.items()]
        size = self._field.shape[0] * self._field.shape[1]
        nothing = np.zeros(0, dtype=np.int64)
        if not parts:
            return tabled(nothing, nothing, size)
        cell = [cell_index(self._field, part["x_mm"], part["y_mm"]) for _, part in parts]
        trigger = np.repeat(np.array([t for t, _ in parts], dtype=np.uint32), [each.size for each in cell])
        return tabled(np.concatenate(cell), trigger, size)
