"""What the stripe kernel does to pixels and pairs of pixels, in the narrowest type that holds the answer.

The compiler gives a vector register's lanes to the widest type that it meets; numba's own rule, 64 bits for every
integer sum, would leave an eighth of the speed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ParamSpec, TypeVar, cast

import numpy as np
from numba import njit, types
from numba.core.registry import cpu_target
from numba.extending import overload

P = ParamSpec("P")
R = TypeVar("R")

# Numba readies itself at the first compiled call, for a quarter of a second: here it does so at import.
cast(Any, cpu_target.typing_context).refresh()
cast(Any, cpu_target.target_context).refresh()


def compiled(function: Callable[P, R]) -> Callable[P, R]:
    """Compile a function of the kernel, into its caller.

    Views of arrays are not counted, so it can neither allocate nor return any.
    """
    options = {"cache": True, "nogil": True, "error_model": "numpy", "_nrt": False, "forceinline": True}
    return cast(Any, njit)(**options)(function)


def mean_of_two(word: Any) -> Any:
    """Mean of the two pixels of a word."""
    raise NotImplementedError("compiled only")


@overload(mean_of_two, strict=False)
def _mean_of_two_of(word: types.Type) -> Any:
    def of_16(word: Any) -> Any:
        low, high = np.uint16(word & np.uint16(255)), np.uint16(word >> np.uint16(8))
        return np.uint8(np.uint16(low + high + np.uint16(1)) >> np.uint16(1))

    def of_32(word: Any) -> Any:
        low, high = np.uint32(word & np.uint32(65535)), np.uint32(word >> np.uint32(16))
        return np.uint16(np.uint32(low + high + np.uint32(1)) >> np.uint32(1))

    return of_16 if word == types.uint16 else of_32


def mean(a: Any, b: Any) -> Any:
    """Mean of two pixels, rounded up."""
    raise NotImplementedError("compiled only")


@overload(mean, strict=False)
def _mean_of(a: types.Type, b: types.Type) -> Any:
    del b

    def of_8(a: Any, b: Any) -> Any:
        return np.uint8(np.uint16(np.uint16(a) + np.uint16(b) + np.uint16(1)) >> np.uint16(1))

    def of_16(a: Any, b: Any) -> Any:
        return np.uint16(np.uint32(np.uint32(a) + np.uint32(b) + np.uint32(1)) >> np.uint32(1))

    return of_8 if a == types.uint8 else of_16


def placed(value: Any, place: int) -> Any:
    """A response above its place: value << 8 | place."""
    raise NotImplementedError("compiled only")


@overload(placed, strict=False)
def _placed_of(value: types.Type, place: types.Type) -> Any:
    del place

    def of_8(value: Any, place: Any) -> Any:
        return np.uint16(np.uint16(np.uint16(value) << np.uint16(8)) | np.uint16(place))

    def of_16(value: Any, place: Any) -> Any:
        return np.uint32(np.uint32(np.uint32(value) << np.uint32(8)) | np.uint32(place))

    return of_8 if value == types.uint8 else of_16
