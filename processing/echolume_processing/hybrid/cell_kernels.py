"""The loops over cells: medians of the points in each, and the lower ground beside each hole."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

FEW = 40
"""So many values are sorted faster by insertion."""


def warm_up() -> None:
    """Compile or load the kernels of this module."""
    _, number, slot = occupied(np.zeros(1, dtype=np.int64), 1)
    twice_medians(slot, number, slot, slot)
    place = np.zeros((1, 2), dtype=np.int64)
    lower_ground(place, np.ones(1), 1.0, 1.0, place, np.zeros(1), np.array([0, 1]))


@njit(cache=True, nogil=True)
def occupied(cell: NDArray[np.int64], size: int) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Cells that some points lie in, sorted (m,), how many lie in each (m,), and which of them each lies in (n,).

    Parameters
    ----------
    cell
        The cell of each point, 0 to ``size - 1``, shape (n,).
    size
        How many cells there are.
    """
    count = np.zeros(size, dtype=np.int64)
    for c in cell:
        count[c] += 1
    cells = np.flatnonzero(count)
    number = count[cells]
    for m in range(cells.size):
        count[cells[m]] = m
    return cells, number, count[cell]


@njit(cache=True, nogil=True)
def twice_medians(
    slot: NDArray[np.int64], number: NDArray[np.int64], value: NDArray[np.int64], other: NDArray[np.int64]
) -> tuple[NDArray[np.int64], NDArray[np.int64], NDArray[np.int64]]:
    """Medians of the values in each cell, twice what they are, so that they are whole numbers.

    Parameters
    ----------
    slot, number
        Which cell each point lies in (n,), and how many do (m,), of `occupied`.
    value, other
        Two values of each point, shape (n,).

    Returns
    -------
    Twice the median of `value`; twice that of how far twice the values lie from the former, rounded as a double is;
    twice that of `other`. All of shape (m,).
    """
    end = np.cumsum(number) - number  # moves from the first value of each cell behind the last one
    grouped, grouped_other = np.empty_like(value), np.empty_like(other)
    for k in range(slot.size):
        at = end[slot[k]]
        grouped[at], grouped_other[at] = value[k], other[k]
        end[slot[k]] = at + 1
    middle, spread, middle_other = np.empty_like(number), np.empty_like(number), np.empty_like(number)
    for m in range(number.size):
        part = grouped[end[m] - number[m] : end[m]]
        middle[m] = _twice_median(part)
        centre = np.uint64(np.int64(np.float64(middle[m])))
        for k in range(part.size):  # without signs, because absurd heights wrap around, which signs must not
            part[k] = abs(np.int64(np.uint64(2) * np.uint64(part[k]) - centre))
        spread[m] = _twice_median(part)
        middle_other[m] = _twice_median(grouped_other[end[m] - number[m] : end[m]])
    return middle, spread, middle_other


@njit(cache=True, nogil=True)
def _twice_median(values: NDArray[np.int64]) -> int:
    """Twice the median of some values, which are sorted in place."""
    if values.size > FEW:
        values.sort()
    else:
        for k in range(1, values.size):
            value, at = values[k], k
            while at > 0 and values[at - 1] > value:
                values[at] = values[at - 1]
                at -= 1
            values[at] = value
    return values[(values.size - 1) // 2] + values[values.size // 2]


@njit(cache=True, nogil=True)
def lower_ground(
    cells: NDArray[np.int64],
    nearest: NDArray[np.float64],
    looked: float,
    across: float,
    rim: NDArray[np.int64],
    rim_mm: NDArray[np.float64],
    row_start: NDArray[np.int64],
) -> NDArray[np.float64]:
    """Height of the nearest rim cell among the low ones around each cell of a hole; of equally near ones, the first's.

    Parameters
    ----------
    cells
        Row and column of each cell of the hole, shape (n, 2).
    nearest
        Its distance to the nearest rim cell, in cells, shape (n,).
    looked, across
        The rim is looked at within twice that distance and `looked`, and at least within `across`.
    rim, rim_mm
        Row and column of the rim cells, sorted, shape (m, 2), and their heights (m,).
    row_start
        Where each row begins in them, and where the last one ends, shape (rows + 1,).
    """
    out = np.empty(nearest.size)
    last = row_start.size - 1
    for n in range(nearest.size):
        j, i = cells[n]
        reach = max(2 * nearest[n] + looked, across)
        rows = int(reach) + 1
        low, high = row_start[max(0, j - rows)], row_start[min(last, j + rows + 1)]
        lowest_mm = np.inf
        for k in range(low, high):
            if (rim[k, 0] - j) ** 2 + (rim[k, 1] - i) ** 2 <= reach * reach:
                lowest_mm = min(lowest_mm, rim_mm[k])
        best = reach * reach + 1
        for k in range(low, high):
            away = (rim[k, 0] - j) ** 2 + (rim[k, 1] - i) ** 2
            if away < best and away <= reach * reach and rim_mm[k] <= lowest_mm + 1.0:
                best, out[n] = away, rim_mm[k]
    return out
