"""The emulated image sensor: speckled laser light, blooming, shot and read noise, hot pixels, 8 bits."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cache, lru_cache
from statistics import NormalDist

import numba
import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated import speckle

READ_NOISE_DN = 1.8
SHOT_DN = 0.03
"""Digital numbers per electron: the variance of the shot noise is SHOT_DN times the signal."""

_BITS = 12
_STEP_DN = 0.25
"""Even light is told apart in such steps."""


@dataclass(frozen=True)
class Sensor:
    """What a camera adds to the light of one exposure; the default adds nothing.

    Attributes
    ----------
    tile
        Relative brightness of speckled light, see `speckle.speckle_tile`; None: none.
    blooming, full_well_dn
        Share of the light above the full well that leaks to the four neighbours.
    hot
        Row, column and dark signal in DN of the hot pixels, shape (n, 3).
    """

    tile: NDArray[np.float32] | None = None
    blooming: float = 0.0
    full_well_dn: float = 255.0
    hot: NDArray[np.float64] | None = None


PLAIN = Sensor()


@cache
def _quantiles() -> NDArray[np.float32]:
    """4096 equally likely values of a standard normal variable."""
    normal, n = NormalDist(), 1 << _BITS
    values = np.array([normal.inv_cdf((k + 0.5) / n) for k in range(n)])
    return (values / values.std()).astype(np.float32)


@lru_cache(maxsize=8)
def _even_light(low: int, high: int) -> NDArray[np.uint8]:
    """Equally likely readings (levels, 4096) of light of low, low + 1, ... high steps."""
    lamp_dn = np.arange(low, high + 1, dtype=np.float32)[:, None] * np.float32(_STEP_DN)
    noisy = lamp_dn + _quantiles() * np.sqrt(np.float32(READ_NOISE_DN**2) + np.float32(SHOT_DN) * lamp_dn)
    return np.clip(np.rint(noisy), 0, 255).astype(np.uint8)


def expose(
    rng: np.random.Generator,
    lamp_dn: NDArray[np.float32] | float,
    laser_dn: NDArray[np.float32],
    touched: NDArray[np.int64],
    sensor: Sensor = PLAIN,
    slope_dn: tuple[float, float] = (0.0, 0.0),
) -> NDArray[np.uint8]:
    """Turn light into a noisy 8-bit frame.

    Parameters
    ----------
    rng
        Source of the noise; the same state gives the same frame.
    lamp_dn
        Incoherent light in digital numbers: an image (rows, columns), or the mean level of even light.
    laser_dn
        Laser light (rows, columns); speckle and blooming are worked into it.
    touched
        Columns [first, last) of each row that hold laser light, shape (rows, 2); they widen with blooming.
    sensor
        Disturbances.
    slope_dn
        Change of even light over the image's width and height.
    """
    seed = np.uint64(rng.integers(0, 2**63, dtype=np.int64))
    if sensor.tile is not None:
        row0, column0 = (int(v) for v in rng.integers(0, sensor.tile.shape))
        speckle.grain(laser_dn, touched, sensor.tile, row0, column0)
    if sensor.blooming > 0:
        _bloom(laser_dn, touched, sensor.full_well_dn, sensor.blooming)
    out = np.empty(laser_dn.shape, dtype=np.uint8)
    table = _quantiles()
    if isinstance(lamp_dn, np.ndarray):
        _develop(seed, table, lamp_dn, laser_dn, touched, READ_NOISE_DN**2, SHOT_DN, out)
    else:
        rows, columns = laser_dn.shape
        tilt = slope_dn[0] / columns, slope_dn[1] / rows
        corner_dn = lamp_dn - 0.5 * (tilt[0] * (columns - 1) + tilt[1] * (rows - 1))
        spread_dn = 0.5 * (abs(slope_dn[0]) + abs(slope_dn[1]))
        low = max(0, round((lamp_dn - spread_dn) / _STEP_DN))
        levels = _even_light(low, max(low, round((lamp_dn + spread_dn) / _STEP_DN)))
        light = np.array([corner_dn, tilt[0], tilt[1], low, _STEP_DN])
        _develop_even(seed, table, levels, light, laser_dn, touched, READ_NOISE_DN**2, SHOT_DN, out)
    if sensor.hot is not None and len(sensor.hot):
        _add_hot(rng, sensor.hot, out)
    return out


def _add_hot(rng: np.random.Generator, hot: NDArray[np.float64], out: NDArray[np.uint8]) -> None:
    row, column = hot[:, 0].astype(np.int64), hot[:, 1].astype(np.int64)
    dark_dn = hot[:, 2] + rng.standard_normal(len(hot)) * np.sqrt(SHOT_DN * hot[:, 2])
    out[row, column] = np.clip(np.rint(out[row, column] + dark_dn), 0, 255).astype(np.uint8)


@numba.njit(cache=True, nogil=True)
def _mix(state: np.uint64) -> np.uint64:
    """SplitMix64's output function (Steele, Lea and Flood 2014)."""
    z = (state ^ (state >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@numba.njit(cache=True, nogil=True)
def _pixel(
    bits: np.uint64, table: NDArray[np.float32], light: np.float32, read2: np.float32, shot: np.float32
) -> np.uint8:
    noise = table[np.int64(bits & np.uint64(4095))] * np.float32(math.sqrt(read2 + shot * light))
    value = light + noise + np.float32(0.5)
    if value <= np.float32(0):
        return np.uint8(0)
    if value >= np.float32(255):
        return np.uint8(255)
    return np.uint8(value)


@numba.njit(cache=True, nogil=True)
def _bloom(laser: NDArray[np.float32], touched: NDArray[np.int64], full_well: float, share: float) -> None:
    """Leak `share` of the light above `full_well` to the four neighbours, in equal parts."""
    rows, columns = laser.shape
    well, part = np.float32(full_well), np.float32(0.25 * share)
    count = 0
    for row in range(rows):
        for column in range(touched[row, 0], touched[row, 1]):
            if laser[row, column] > well:
                count += 1
    if count == 0:
        return
    where = np.empty((count, 2), dtype=np.int64)
    leak = np.empty(count, dtype=np.float32)
    n = 0
    for row in range(rows):
        for column in range(touched[row, 0], touched[row, 1]):
            if laser[row, column] > well:
                where[n, 0], where[n, 1] = row, column
                leak[n] = part * (laser[row, column] - well)
                n += 1
    for i in range(count):
        for dr, dc in ((-1, 0), (1, 0), (0, -1), (0, 1)):
            row, column = where[i, 0] + dr, where[i, 1] + dc
            if 0 <= row < rows and 0 <= column < columns:
                laser[row, column] += leak[i]
                touched[row, 0] = min(touched[row, 0], column)
                touched[row, 1] = max(touched[row, 1], column + 1)


@numba.njit(cache=True, nogil=True)
def _develop(
    seed: np.uint64,
    table: NDArray[np.float32],
    lamp: NDArray[np.float32],
    laser: NDArray[np.float32],
    touched: NDArray[np.int64],
    read2: float,
    shot: float,
    out: NDArray[np.uint8],
) -> None:
    rows, columns = out.shape
    r2, s = np.float32(read2), np.float32(shot)
    state = seed
    for row in range(rows):
        lo, hi = touched[row, 0], touched[row, 1]
        bits, left = np.uint64(0), 0
        for column in range(columns):
            if left == 0:
                state += np.uint64(0x9E3779B97F4A7C15)
                bits, left = _mix(state), 5
            light = laser[row, column] if lo <= column < hi else np.float32(0)
            out[row, column] = _pixel(bits, table, lamp[row, column] + light, r2, s)
            bits >>= np.uint64(12)
            left -= 1


@numba.njit(cache=True, nogil=True)
def _develop_even(
    seed: np.uint64,
    table: NDArray[np.float32],
    levels: NDArray[np.uint8],
    light: NDArray[np.float64],
    laser: NDArray[np.float32],
    touched: NDArray[np.int64],
    read2: float,
    shot: float,
    out: NDArray[np.uint8],
) -> None:
    """`light` is the level of the first pixel, its rise a column and a row, the first of `levels`, and their step.

    Five pixels at a time share one random number and one level.
    """
    rows, columns = out.shape
    r2, s = np.float32(read2), np.float32(shot)
    mask, golden = np.uint64(4095), np.uint64(0x9E3779B97F4A7C15)
    state = seed
    last = levels.shape[0] - 1
    for row in range(rows):
        level = light[0] + light[2] * row
        at, rise = level / light[4] - light[3] + 0.5, light[1] / light[4]
        for start in range(0, columns - 4, 5):
            state += golden
            bits = _mix(state)
            readings = levels[min(max(np.int64(at + rise * (start + 2)), 0), last)]
            for k in range(5):
                out[row, start + k] = readings[np.int64(bits & mask)]
                bits >>= np.uint64(12)
        state += golden
        bits = _mix(state)
        readings = levels[min(max(np.int64(at + rise * (columns - 1)), 0), last)]
        for column in range(columns - columns % 5, columns):
            out[row, column] = readings[np.int64(bits & mask)]
            bits >>= np.uint64(12)
        for column in range(touched[row, 0], touched[row, 1]):
            state += golden
            lamp = np.float32(level + light[1] * column)
            out[row, column] = _pixel(_mix(state), table, lamp + laser[row, column], r2, s)
