"""Measurement of one peak in a window of its row: column, width, amplitude, sigma, and whether it is clipped."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echolume_processing.optical.stripe_filters import FWHM, HALF, PER_PX, PHASE_BITS, PHASES, SMOOTHING, WIDTHS
from echolume_processing.optical.stripe_words import compiled

Pixels = NDArray[Any]
"""uint8 or uint16."""
Values = NDArray[np.float64]

FLANK_PX = 14
"""Distance at which a stripe must have faded; beyond it another peak may stand."""
WINDOW = 112
MIDDLE = WINDOW // 2
NEAR_PX = 0.3
"""A filter answers in proportion as long as its centre is off by less."""
FAR_PX = 3.0
HOT = 0.25
"""A lone pixel's neighbours are below this part of it."""
CLIP_MARGIN = 2.0
"""Pixels closer to clipping than so many sigmas of the noise are left to the clipped ones."""
# Columns of the table of results.
COLUMN, WIDTH, AMPLITUDE, SIGMA, SATURATED, RESULTS = 0, 1, 2, 3, 4, 5


@compiled
def _fall(window: Pixels, start: int, level: float, direction: int) -> float:
    """Distance from `start` to where the profile falls through `level`, at most to the window's end."""
    before = float(window[start])
    for i in range(1, MIDDLE - 8):
        value = float(window[start + direction * i])
        if value < level:
            return i - 1 + (before - level) / max(before - value, 1e-9)
        before = value
    return float(MIDDLE - 8)


@compiled
def _filtered(window: Pixels, centre: int, weights: NDArray[np.int16]) -> float:
    """Antisymmetric filter around `centre`; positive where the peak lies to the right."""
    w = window[centre - HALF : centre + HALF]
    total = np.int32(0)
    for i in range(len(weights)):  # a length known too early would be unrolled, not vectorised
        total = np.int32(total + np.int32(np.int32(w[i]) * np.int32(weights[i])))
    return float(total)


@compiled
def _refine(
    window: Pixels, start: float, at: int, sigma: float, height: float, weights: NDArray[np.int16], slope: Values
) -> float:
    """Zero crossing of the filter of width `at` from an estimate of it; nan if it runs away."""
    x = start
    for _ in range(4):
        place = int(x * PHASES + 0.5)
        centre = place >> PHASE_BITS
        if centre < HALF or centre > WINDOW - HALF:
            break
        chosen = at * PHASES + (place & (PHASES - 1))
        d = _filtered(window, centre, weights[chosen]) / (slope[chosen] * height)
        d *= 1 + min(0.25 * d * d / (sigma * sigma), 1.0)
        x = place / PHASES + d
        if abs(d) < NEAR_PX:
            return x
        if abs(x - start) > FAR_PX:
            break
    return math.nan


@compiled
def _clipped(
    window: Pixels, middle: float, half_width: float, background: float, full: float, noise: float, out: Values
) -> bool:
    """Fit the flanks of a clipped Gaussian, which alone know where it stands; False if they say nothing.

    The logarithm is a parabola, found by least squares with the profile as weight; from the second round on weights
    and residuals are the fit's own, which makes it a Gauss-Newton step on the profile itself.
    """
    centre = int(middle + 0.5)
    reach = min(int(1.7 * half_width) + 3, MIDDLE - 8)
    limit = full - background - CLIP_MARGIN * noise
    p0, p1, p2 = 0.0, 0.0, 0.0
    for step in range(4):
        s0, s1, s2, s3, s4, t0, t1, t2 = 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 0.0
        for i in range(max(-reach, -centre), min(reach, WINDOW - 1 - centre) + 1):
            height = float(window[centre + i]) - background
            if height + background >= full:
                continue
            if step == 0:
                if height < 4 * noise:
                    continue
                model, z = height, math.log(height)
            else:
                log = p0 + i * (p1 + i * p2)
                model = math.exp(min(log, 12.0))
                if model > limit:
                    continue
                z = log + (height - model) / max(model, 0.1)
            w = model * model
            s0 += w
            s1 += w * i
            s2 += w * i * i
            s3 += w * i * i * i
            s4 += w * i * i * i * i
            t0 += w * z
            t1 += w * z * i
            t2 += w * z * i * i
        d0, d1, d2 = s2 * s4 - s3 * s3, s1 * s4 - s2 * s3, s1 * s3 - s2 * s2
        determinant = s0 * d0 - s1 * d1 + s2 * d2
        if not determinant > 0:
            return False
        p0 = (t0 * d0 - s1 * (t1 * s4 - t2 * s3) + s2 * (t1 * s3 - t2 * s2)) / determinant
        p1 = (s0 * (t1 * s4 - t2 * s3) - t0 * d1 + s2 * (s1 * t2 - t1 * s2)) / determinant
        p2 = (s0 * (s2 * t2 - s3 * t1) - s1 * (s1 * t2 - s2 * t1) + t0 * d2) / determinant
        if not p2 < 0:
            return False
    x = -0.5 * p1 / p2
    information = 1e-12
    for i in range(-reach, reach + 1):
        model = math.exp(min(p0 + i * (p1 + i * p2), 12.0))
        if model <= limit:
            information += (2 * p2 * (i - x) * model) ** 2
    out[COLUMN] = centre + x
    out[SIGMA] = noise / math.sqrt(information)
    return abs(centre + x - middle) < FAR_PX


@compiled
def measure(
    window: Pixels,
    noise: float,
    full: float,
    weights: NDArray[np.int16],
    slope: Values,
    sigmas: Values,
    gains: Values,
    spreads: Values,
    out: Values,
) -> bool:
    """Measure the peak in the middle of a window; False if it is none."""
    best = np.int64(0)
    for i in range(MIDDLE - 3, MIDDLE + 4):
        smooth = np.int64(window[i - 1]) + 2 * np.int64(window[i]) + np.int64(window[i + 1])
        best = max(best, (smooth << 8) | i)
    top = int(best & 255)
    beside = np.int64(0)
    for i in range(4):
        beside += np.int64(window[MIDDLE - FLANK_PX - 2 + i]) + np.int64(window[MIDDLE + FLANK_PX - 1 + i])
    background = 0.125 * float(beside)
    crest = 0.25 * float(best >> 8)
    height = crest - background
    alone = float(window[top]) - background
    neighbour = max(float(window[top - 1]), float(window[top + 1])) - background
    if height <= 0 or neighbour < HOT * alone:
        return False
    level = background + 0.5 * height
    left = _fall(window, top, level, -1)
    right = _fall(window, top, level, 1)
    width = left + right
    out[SATURATED] = 1.0 if crest >= full else 0.0
    if crest >= full:
        out[WIDTH] = width
        out[AMPLITUDE] = height
        return _clipped(window, top + 0.5 * (right - left), 0.5 * width, background, full, noise, out)
    at = min(int(PER_PX * width + 0.5), WIDTHS - 1)
    sigma = sigmas[at]
    start = 0.5 * (right - left)
    missed = 0.5 * start * start / (sigma * sigma + SMOOTHING)  # the highest pixel is beside the crest
    amplitude = height * gains[at] * (1 + missed * (1 + 0.5 * missed))
    column = _refine(window, top + start, at, sigma, amplitude, weights, slope)
    out[COLUMN] = column
    out[WIDTH] = FWHM * sigma + width - at / PER_PX
    out[AMPLITUDE] = amplitude
    out[SIGMA] = noise * spreads[at] / amplitude
    return not math.isnan(column)
