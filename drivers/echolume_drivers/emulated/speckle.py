"""Speckle of laser light on the sensor: grain from the aperture, contrast from what is averaged in a pixel."""

from __future__ import annotations

import math
from functools import cache

import numba
import numpy as np
from numpy.typing import NDArray

ROWS, COLUMNS = 1024, 64
"""A tile, in pixels; it repeats without a seam."""
REUSE = 4
"""Looks taken from each pattern, shifted far apart: they are as good as independent."""


@cache
def speckle_tile(grain_px: float, looks: int) -> NDArray[np.float32]:
    """Relative brightness of speckled light, shape (ROWS, COLUMNS), mean 1.

    Parameters
    ----------
    grain_px
        wavelength * f-number * (1 + magnification) over the pixel's pitch.
    looks
        Independent patterns that add up.

    Notes
    -----
    Random phases fill a round pupil, the field is its Fourier transform, the intensity is integrated over each
    pixel: the grain follows the aperture's diffraction disc, and pixels larger than the grain see less contrast.

    References
    ----------
    J. W. Goodman, Speckle Phenomena in Optics, 2nd ed., SPIE 2020, doi:10.1117/3.2548484.
    """
    # The intensity's highest frequency is 1 / grain; it needs two samples, and the pixel's integral three.
    per_pixel = max(3, math.ceil(2 / grain_px))
    shape = (ROWS * per_pixel, COLUMNS * per_pixel)
    v, u = np.fft.fftfreq(shape[0], 1 / per_pixel), np.fft.fftfreq(shape[1], 1 / per_pixel)
    pupil = np.flatnonzero(np.hypot(v[:, None], u) < 0.5 / grain_px)
    rng = np.random.default_rng([0x59EC, looks])
    tile = np.zeros((ROWS, COLUMNS))
    for first in range(0, looks, REUSE):
        spectrum = np.zeros(shape[0] * shape[1], dtype=np.complex64)
        spectrum[pupil] = np.exp(2j * np.pi * rng.random(len(pupil)))
        field = np.fft.ifft2(spectrum.reshape(shape))
        intensity = field.real**2 + field.imag**2
        seen = intensity.reshape(ROWS, per_pixel, COLUMNS, per_pixel).mean(axis=(1, 3))
        for _ in range(min(REUSE, looks - first)):
            down, right = rng.integers(0, (ROWS, COLUMNS)).tolist()
            tile += np.roll(seen, (down, right), axis=(0, 1))
    return (tile / tile.mean()).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def grain(
    laser: NDArray[np.float32], touched: NDArray[np.int64], tile: NDArray[np.float32], row0: int, column0: int
) -> None:
    """Multiply laser light (rows, columns), where there is any, by the tile laid with its origin at (row0, column0)."""
    for row in range(laser.shape[0]):
        line = tile[(row + row0) % tile.shape[0]]
        for column in range(touched[row, 0], touched[row, 1]):
            laser[row, column] *= line[(column + column0) % tile.shape[1]]
