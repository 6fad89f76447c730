"""The compiled median that the kernels share; compiled once, it is short to compile."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

ENOUGH = 200
"""A median over more values than twice this takes every second, third, ... of them."""


@njit(cache=True, nogil=True)
def median(values: NDArray[np.float64], count: int) -> float:
    """Median of the first `count` values, or of evenly chosen ones of them; nan of none."""
    if count == 0:
        return np.nan
    step = max(count // ENOUGH, 1)
    few = np.empty((count + step - 1) // step)
    for i in range(len(few)):
        few[i] = values[i * step]
    few.sort()
    half = len(few) // 2
    return few[half] if len(few) % 2 else 0.5 * (few[half - 1] + few[half])
