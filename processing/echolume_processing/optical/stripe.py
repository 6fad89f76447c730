"""Laser-stripe extraction: sub-pixel columns of each image row, several candidates a row, in one compiled pass."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_messages.types import Frame

Candidates = NDArray[np.float64]
"""One value a row and candidate, shape (rows, candidates); nan where there is none."""

Row = NDArray[np.int16]

CANDIDATES = 3
"""Peaks kept a row, strongest response first; the other camera and the plane choose among them."""
FLANK_PX = 14
"""Distance at which a stripe must have faded; beyond it another peak may stand."""
SATURATED_DN = 250
RESPONSE_SIGMAS = 6.0
"""A response of the five-pixel box below this many of its standard deviations is noise."""
MIN_RESPONSE_DN = 25.0
FIR_PER_WIDTH = 0.8
"""Half length of the zero-crossing filter over the stripe's width at half maximum."""
MIN_FIR = 2
MAX_FIR = 8


@dataclass(frozen=True)
class Stripe:
    """What one frame holds of the laser line: candidates a row, strongest first.

    Attributes
    ----------
    column_px : (rows, candidates) float64
        Sub-pixel column; nan where there is no candidate.
    width_px : (rows, candidates) float64
        Width at half maximum.
    amplitude_dn : (rows, candidates) float64
        Height above the background beside the stripe, in digital numbers.
    saturated : (rows, candidates) bool
        The sensor clipped there.
    noise_dn : (rows,) float64
        Standard deviation of the row's noise.
    """

    column_px: Candidates
    width_px: Candidates
    amplitude_dn: Candidates
    saturated: NDArray[np.bool_]
    noise_dn: NDArray[np.float64]

    @property
    def sigma_px(self) -> Candidates:
        """Cramer-Rao bound of each column for additive noise, (rows, candidates); speckle comes on top."""
        spread_px = self.width_px / 2.3548
        return self.noise_dn[:, None] * np.sqrt(2 * spread_px / np.sqrt(np.pi)) / self.amplitude_dn


@njit(cache=True, nogil=True)
def _half_crossing(row: Row, start: int, level: float, direction: int, reach: int) -> float:
    """Distance from `start` to where the profile falls through `level`, at most `reach`."""
    for i in range(1, reach + 1):
        value = float(row[start + direction * i])
        if value < level:
            before = float(row[start + direction * (i - 1)])
            return i - 1 + (before - level) / max(before - value, 1e-9)
    return float(reach)


@njit(cache=True, nogil=True)
def _antisymmetric(row: Row, c: int, half: int) -> float:
    """Sum of the `half` samples left of c minus those right of it."""
    total = 0
    for i in range(1, half + 1):
        total += np.int64(row[c - i]) - np.int64(row[c + i])
    return float(total)


@njit(cache=True, nogil=True)
def _zero_crossing(row: Row, centre: int, half: int) -> float:
    """Column at which the antisymmetric filter rises through zero, nan if not within `half` of centre."""
    c = centre
    g = _antisymmetric(row, c, half)
    for _ in range(half + 1):
        if g > 0:
            before = _antisymmetric(row, c - 1, half)
            if before <= 0:
                return c - 1 + before / (before - g)
            c -= 1
            g = before
        else:
            after = _antisymmetric(row, c + 1, half)
            if after > 0:
                return c + g / (g - after)
            c += 1
            g = after
    return np.nan


@njit(cache=True, nogil=True)
def _measure(row: Row, box: Row, c: int, column: Candidates, width: Candidates, amplitude: Candidates) -> bool:
    """Fill (column, width, amplitude) of the peak near c in the padded row; returns whether it saturates."""
    top = c
    for i in range(c - 3, c + 4):
        if row[i] > row[top]:
            top = i
    background = 0.1 * (float(box[c - FLANK_PX]) + float(box[c + FLANK_PX]))
    peak = (float(row[top - 1]) + 2.0 * float(row[top]) + float(row[top + 1])) / 4.0
    level = 0.5 * (peak + background)
    left = _half_crossing(row, top, level, -1, FLANK_PX)
    right = _half_crossing(row, top, level, 1, FLANK_PX)
    width[0] = left + right
    amplitude[0] = peak - background
    half = min(max(int(FIR_PER_WIDTH * width[0] + 0.5), MIN_FIR), MAX_FIR)
    column[0] = _zero_crossing(row, int(np.floor(top + 0.5 * (right - left) + 0.5)), half)
    brightest = row[top]
    for i in range(top - int(left), top + int(right) + 1):
        brightest = max(brightest, row[i])
    return bool(brightest >= SATURATED_DN)


@njit(cache=True, nogil=True)
def _extract(
    frame: Frame,
    column: Candidates,
    width: Candidates,
    amplitude: Candidates,
    saturated: NDArray[np.bool_],
    noise: NDArray[np.float64],
) -> None:
    rows, columns = frame.shape
    pad = 2 * FLANK_PX + MAX_FIR + 4
    padded = columns + 2 * pad
    row = np.empty(padded, np.int16)
    box = np.zeros(padded, np.int16)
    response = np.empty(columns, np.int16)
    first = pad - FLANK_PX
    last = pad + columns + FLANK_PX
    for y in range(rows):
        for c in range(columns):
            row[pad + c] = np.int16(frame[y, c])
        for c in range(pad):
            row[c] = row[pad]
            row[pad + columns + c] = row[pad + columns - 1]
        # Each partial sum is cast back to int16: the compiler then uses the short vector instructions.
        for c in range(first, last):
            box[c] = np.int16(np.int16(row[c - 2] + row[c - 1]) + np.int16(row[c + 1] + row[c + 2]))
        for c in range(first, last):
            box[c] = np.int16(box[c] + row[c])
        total = np.int32(0)
        for c in range(columns - 1):
            total += np.int32(abs(np.int16(row[pad + c + 1] - row[pad + c])))
        sigma = max(total / (columns - 1) / 1.1284, 0.3)  # mean |difference| of two normal samples is 1.1284 sigma
        noise[y] = sigma
        for c in range(columns):
            a = box[first + c]
            b = box[first + c + 2 * FLANK_PX]
            response[c] = np.int16(box[pad + c] - (a if a > b else b))
        threshold = max(RESPONSE_SIGMAS * sigma * 2.9, MIN_RESPONSE_DN)
        for k in range(column.shape[1]):
            best = np.int16(-32768)
            for c in range(columns):
                best = max(best, response[c])
            if best <= threshold:
                break
            at = 0
            while response[at] != best:
                at += 1
            saturated[y, k] = _measure(
                row, box, pad + at, column[y, k : k + 1], width[y, k : k + 1], amplitude[y, k : k + 1]
            )
            column[y, k] -= pad
            if not (0 <= column[y, k] <= columns - 1) or amplitude[y, k] <= 0:
                column[y, k] = np.nan
            for c in range(max(at - FLANK_PX, 0), min(at + FLANK_PX + 1, columns)):
                response[c] = np.int16(-32768)


def extract(frame: Frame, candidates: int = CANDIDATES) -> Stripe:
    """Find the laser stripe in each row of a frame.

    Parameters
    ----------
    frame : (rows, columns) uint8
        A camera frame with a near-vertical stripe, not undistorted.
    candidates : int
        How many peaks a row to keep.

    Returns
    -------
    Stripe
        Candidates a row in distorted pixel coordinates, strongest response first.

    Notes
    -----
    A peak is where a box of five pixels stands out from both flanks. The half-maximum width there sets the length
    of an antisymmetric filter (the Blais-Rioux family with the length as a parameter) whose zero crossing is the
    column. Saturated plateaus keep their centre; two stripes closer than `FLANK_PX` are one.

    References
    ----------
    F. Blais and M. Rioux, doi:10.1016/0165-1684(86)90033-2.
    """
    require_shape("frame", frame, (None, None))
    if frame.dtype != np.uint8:
        raise ValueError(f"frame: expected uint8, got {frame.dtype}")
    shape = (frame.shape[0], candidates)
    column, width, amplitude = (np.full(shape, np.nan) for _ in range(3))
    saturated = np.zeros(shape, dtype=np.bool_)
    noise = np.zeros(frame.shape[0])
    _extract(frame, column, width, amplitude, saturated, noise)
    return Stripe(column, width, amplitude, saturated, noise)
