"""The filters of the stripe kernel: matched to the width at half maximum that a row shows, and to a part of a pixel."""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

PER_PX = 4
"""Filters stand a quarter of a pixel of measured width apart."""
WIDTHS = 72
PHASE_BITS = 3
PHASES = 1 << PHASE_BITS
"""Filters of each width stand this part of a pixel apart, so that one answer next to zero gives the column."""
HALF = 32
"""Samples on each side of a filter's centre: enough for the widest, and what fills a vector register."""
TAPS = 2 * HALF
SCALE = 2047.0
"""Largest weight: sums of 15-bit samples stay within 32 bits."""
MIN_SIGMA_PX = 0.6
SMOOTHING = 0.5
"""Variance of (1, 2, 1) / 4."""
FWHM = 2.3548


class Filters(NamedTuple):
    """Tables by measured width, one row every 1 / PER_PX pixel.

    Attributes
    ----------
    weights : (widths * phases, taps) int16
        Antisymmetric filter around tap ``HALF + phase / PHASES``; it rises through zero at a peak.
    slope : (widths * phases,) float64
        What the filter answers for each pixel that a Gaussian of unit crest lies to its right.
    sigma_px : (widths,) float64
        Sigma of the Gaussian that shows this width.
    gain : (widths,) float64
        Crest of that Gaussian over its smoothed crest, where that lies on a pixel.
    spread_px : (widths,) float64
        Cramer-Rao bound of its place for noise of the crest's height.
    """

    weights: NDArray[np.int16]
    slope: NDArray[np.float64]
    sigma_px: NDArray[np.float64]
    gain: NDArray[np.float64]
    spread_px: NDArray[np.float64]


@cache
def filters() -> Filters:
    """The tables of the kernel.

    Notes
    -----
    The weights are the derivative of a Gaussian, which for additive noise reaches the Cramer-Rao bound where the box of
    the Blais-Rioux operators stays 8 % above it. The crest is measured after smoothing by (1, 2, 1) / 4, so it is too
    low, and the profile too wide at half of it.
    """
    grid_px = np.geomspace(0.3, 12.0, 400)
    crests = 0.5 * (1 + np.exp(-0.5 / grid_px**2))  # (1, 2, 1) / 4 on the middle of a unit Gaussian
    usual = crests * (1 - 1 / (24 * (grid_px**2 + SMOOTHING)))  # the middle is seldom a pixel's
    shown_px = 2 * grid_px * np.sqrt(2 * np.log(2 / usual))
    width_px = np.arange(WIDTHS) / PER_PX
    sigma_px = np.interp(width_px, shown_px, grid_px)
    gain = np.interp(width_px, shown_px, 1 / crests)
    variance = np.maximum(sigma_px, MIN_SIGMA_PX)[:, None, None] ** 2  # (widths, 1, 1)
    tap = np.arange(TAPS) - HALF - np.arange(PHASES)[:, None] / PHASES  # (phases, taps)
    bell = np.exp(-(tap**2) / (2 * variance))  # (widths, phases, taps)
    shape = tap * bell
    shape -= bell * (shape.sum(axis=2) / bell.sum(axis=2))[..., None]  # the background must not answer
    weights = np.rint(SCALE * shape / np.abs(shape).max(axis=2, keepdims=True)).astype(np.int16)
    slope = np.sum(weights * tap * bell / variance, axis=2)
    spread_px = np.sqrt(2 * sigma_px / np.sqrt(np.pi))
    return Filters(weights.reshape(-1, TAPS), slope.reshape(-1), sigma_px, gain, spread_px)
