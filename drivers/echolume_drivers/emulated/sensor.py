"""The emulated image sensor: shot noise, read noise, speckle of laser light, saturation to 8 bits."""

from __future__ import annotations

import math
from functools import cache
from statistics import NormalDist

import numba
import numpy as np
from numpy.typing import NDArray

READ_NOISE_DN = 1.8
SHOT_DN = 0.03
"""Digital numbers per electron: the variance of the shot noise is SHOT_DN times the signal."""
SPECKLE = 0.15
"""Relative grain of laser light that is left after one pixel's aperture."""

_BITS = 12
_DRAWS = 5
"""Five draws of twelve bits from each 64-bit random number."""


@cache
def _quantiles() -> NDArray[np.float32]:
    """4096 equally likely values of a standard normal variable."""
    normal, n = NormalDist(), 1 << _BITS
    values = np.array([normal.inv_cdf((k + 0.5) / n) for k in range(n)])
    return (values / values.std()).astype(np.float32)


def expose(
    rng: np.random.Generator,
    lamp_dn: NDArray[np.float32] | float,
    laser_dn: NDArray[np.float32],
    touched: NDArray[np.int64],
) -> NDArray[np.uint8]:
    """Turn light into a noisy 8-bit frame.

    Parameters
    ----------
    rng
        Source of the noise; the same state gives the same frame.
    lamp_dn
        Incoherent light in digital numbers: an image (rows, columns), or one level for all of it.
    laser_dn
        Laser light (rows, columns); it carries speckle.
    touched
        Columns [first, last) of each row that hold laser light, shape (rows, 2).
    """
    seed = np.uint64(rng.integers(0, 2**63, dtype=np.int64))
    out = np.empty(laser_dn.shape, dtype=np.uint8)
    table = _quantiles()
    if isinstance(lamp_dn, np.ndarray):
        _develop(seed, table, lamp_dn, laser_dn, touched, READ_NOISE_DN**2, SHOT_DN, SPECKLE, out)
        return out
    noisy = lamp_dn + table * np.float32(math.sqrt(READ_NOISE_DN**2 + SHOT_DN * lamp_dn))
    levels = np.clip(np.rint(noisy), 0, 255).astype(np.uint8)
    _develop_flat(seed, table, levels, lamp_dn, laser_dn, touched, READ_NOISE_DN**2, SHOT_DN, SPECKLE, out)
    return out


@numba.njit(cache=True, nogil=True)
def _mix(state: np.uint64) -> np.uint64:
    """SplitMix64's output function (Steele, Lea and Flood 2014)."""
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def _pixel(
    bits: np.uint64,
    table: NDArray[np.float32],
    lamp: np.float32,
    laser: np.float32,
    read2: np.float32,
    shot: np.float32,
    speckle: np.float32,
) -> np.uint8:
    total = lamp + laser
    grain = speckle * laser
    noise = table[np.int64(bits & np.uint64(4095))] * np.float32(math.sqrt(read2 + shot * total + grain * grain))
    value = total + noise + np.float32(0.5)
    if value <= np.float32(0):
        return np.uint8(0)
    if value >= np.float32(255):
        return np.uint8(255)
    return np.uint8(value)


@numba.njit(cache=True, nogil=True)
def _develop(
    seed: np.uint64,
    table: NDArray[np.float32],
    lamp: NDArray[np.float32],
    laser: NDArray[np.float32],
    touched: NDArray[np.int64],
    read2: float,
    shot: float,
    speckle: float,
    out: NDArray[np.uint8],
) -> None:
    rows, columns = out.shape
    r2, s, g = np.float32(read2), np.float32(shot), np.float32(speckle)
    state = seed
    for row in range(rows):
        lo, hi = touched[row, 0], touched[row, 1]
        bits, left = np.uint64(0), 0
        for column in range(columns):
            if left == 0:
                state += np.uint64(0x9E3779B97F4A7C15)
                bits, left = _mix(state), 5
            light = laser[row, column] if lo <= column < hi else np.float32(0)
            out[row, column] = _pixel(bits, table, lamp[row, column], light, r2, s, g)
            bits >>= np.uint64(12)
            left -= 1


@numba.njit(cache=True, nogil=True)
def _develop_flat(
    seed: np.uint64,
    table: NDArray[np.float32],
    levels: NDArray[np.uint8],
    lamp: float,
    laser: NDArray[np.float32],
    touched: NDArray[np.int64],
    read2: float,
    shot: float,
    speckle: float,
    out: NDArray[np.uint8],
) -> None:
    rows, columns = out.shape
    r2, s, g, level = np.float32(read2), np.float32(shot), np.float32(speckle), np.float32(lamp)
    mask, golden = np.uint64(4095), np.uint64(0x9E3779B97F4A7C15)
    state = seed
    for row in range(rows):
        for start in range(0, columns - 4, 5):
            state += golden
            bits = _mix(state)
            for k in range(5):
                out[row, start + k] = levels[np.int64(bits & mask)]
                bits >>= np.uint64(12)
        state += golden
        bits = _mix(state)
        for column in range(columns - columns % 5, columns):
            out[row, column] = levels[np.int64(bits & mask)]
            bits >>= np.uint64(12)
        for column in range(touched[row, 0], touched[row, 1]):
            state += golden
            out[row, column] = _pixel(_mix(state), table, level, laser[row, column], r2, s, g)
