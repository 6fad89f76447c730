"""Which triggers each cell of a map rests on: all of them, as one compressed table."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from echolume_messages.types import NO_TRIGGER, Structured

Triggers = NDArray[np.uint32]
PAIR = np.dtype([("cell", "<u4"), ("trigger", "<u4")])
"""A line of a table as a file holds it."""


def _no_start() -> NDArray[np.int64]:
    return np.zeros(1, dtype=np.int64)


def _no_triggers() -> Triggers:
    return np.zeros(0, dtype=np.uint32)


@dataclass(frozen=True)
class Witnesses:
    """Triggers by cell; cells count row by row, as in a map. Without any cells: nobody kept a table."""

    start: NDArray[np.int64] = field(default_factory=_no_start)
    """Where those of each cell begin in `which`, and where the last one's end, shape (cells + 1,)."""
    which: Triggers = field(default_factory=_no_triggers)
    """Triggers, sorted within each cell, each once (n,)."""

    @property
    def known(self) -> bool:
        """Whether there is a table at all."""
        return self.start.size > 1

    @property
    def count(self) -> NDArray[np.int64]:
        """How many triggers each cell has, shape (cells,)."""
        return np.diff(self.start)

    @property
    def cell(self) -> NDArray[np.int64]:
        """The cell of each entry of `which`, shape (n,)."""
        return np.repeat(np.arange(self.start.size - 1), self.count)

    @property
    def first(self) -> Triggers:
        """Lowest trigger of each cell, shape (cells,); `NO_TRIGGER` where there is none."""
        return self._picked(self.start[:-1])

    @property
    def last(self) -> Triggers:
        """Highest trigger of each cell, shape (cells,); `NO_TRIGGER` where there is none."""
        return self._picked(self.start[1:] - 1)

    def of(self, cell: int) -> Triggers:
        """Triggers of one cell; none where nobody kept a table."""
        if not self.known:
            return self.which
        return self.which[self.start[cell] : self.start[cell + 1]]

    def taken(self, cells: NDArray[np.int64]) -> Witnesses:
        """The table of some cells (m,) in their own order; no table stays none."""
        if not self.known:
            return self
        count = self.count[cells]
        start = _started(count)
        within = np.arange(start[-1]) - np.repeat(start[:-1], count)
        return Witnesses(start, self.which[np.repeat(self.start[cells], count) + within])

    def only(self, cells: NDArray[np.bool_]) -> Witnesses:
        """The same table, emptied for all but some cells, shape (cells,); no table stays none."""
        if not self.known:
            return self
        return Witnesses(_started(np.where(cells, self.count, 0)), self.which[np.repeat(cells, self.count)])

    def _picked(self, at: NDArray[np.int64]) -> Triggers:
        there = self.count > 0
        out = np.full(there.size, NO_TRIGGER, dtype=np.uint32)
        out[there] = self.which[at[there]]
        return out

    def pairs(self) -> Structured:
        """The table line by line: `PAIR` (n,)."""
        lines = np.zeros(self.which.size, dtype=PAIR)
        lines["cell"], lines["trigger"] = self.cell, self.which
        return lines


def tabled(cell: NDArray[np.integer], trigger: NDArray[np.integer], cells: int) -> Witnesses:
    """The table of some cells from pairs of cell and trigger, in any order and however often each.

    Parameters
    ----------
    cell
        Flat index of each pair's cell, 0 to ``cells - 1``, shape (n,).
    trigger
        Its trigger, shape (n,).
    cells
        How many cells there are.
    """
    key = np.sort((cell.astype(np.uint64) << np.uint64(32)) | trigger.astype(np.uint64))
    key = key[np.append(True, key[1:] != key[:-1])] if key.size else key
    count = np.bincount((key >> np.uint64(32)).astype(np.int64), minlength=cells)
    return Witnesses(_started(count), (key & np.uint64(NO_TRIGGER)).astype(np.uint32))


def _started(count: NDArray[np.int64]) -> NDArray[np.int64]:
    start = np.zeros(count.size + 1, dtype=np.int64)
    np.cumsum(count, out=start[1:])
    return start
