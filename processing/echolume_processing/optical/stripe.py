"""Laser-stripe extraction: sub-pixel columns of each image row, several candidates a row, in one compiled pass."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any, Literal, cast

import cv2
import numpy as np
from numba import types
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_processing.optical import stripe_kernel as kernel
from echolume_processing.optical.stripe_filters import filters
from echolume_processing.optical.stripe_measure import AMPLITUDE, COLUMN, FLANK_PX, RESULTS, SATURATED, SIGMA, WIDTH

__all__ = ["CANDIDATES", "FLANK_PX", "Stripe", "extract", "speckle_sigma_px", "warm_up"]

Candidates = NDArray[np.float64]
"""One value a row and candidate, shape (rows, candidates); nan where there is none."""
AnyFrame = NDArray[np.uint8] | NDArray[np.uint16]

CANDIDATES = 3
"""Peaks kept a row, strongest response first; the other camera and the plane choose among them."""
SATURATED_PART = 250 / 255
"""A crest above this part of full scale counts as clipped."""
RESPONSE_SIGMAS = 3.5
"""A box of four pixels that stands out by fewer sigmas of the noise is noise."""
MIN_RESPONSE_PART = 5 / 255
"""Least response over full scale."""


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
    sigma_px : (rows, candidates) float64
        Standard deviation of each column: the Cramer-Rao bound for the row's noise, and speckle.
    """

    column_px: Candidates
    width_px: Candidates
    amplitude_dn: Candidates
    saturated: NDArray[np.bool_]
    noise_dn: NDArray[np.float64]
    sigma_px: Candidates


@cache
def _compiled(bits: int) -> Callable[..., None]:
    """The kernel for pixels of 8 or 16 bits; frames are handed over read-only, so that there is one kind of each."""
    pixel, word = (types.uint8, types.uint16) if bits == 8 else (types.uint16, types.uint32)
    rows = cast(Any, kernel.extract_rows)
    table, values = types.Array(types.int16, 2, "C"), types.Array(types.float64, 1, "C")
    rows.compile(
        (
            types.Array(pixel, 2, "C", readonly=True), types.Array(word, 2, "C", readonly=True),
            types.Array(pixel, 1, "C"), types.Array(word, 1, "C"),
            types.Array(types.uint32, 1, "C"), types.Array(types.int32, 1, "C"), values,
            types.float64, types.float64, types.float64,
            table, values, values, values, values, types.Array(types.float64, 3, "C"), values,
        )
    )  # fmt: skip
    return rows


def speckle_sigma_px(wavelength_mm: float, f_number: float, pixel_mm: float, contrast: float = 1.0) -> float:
    """Standard deviation of a stripe's column by speckle, which no averaging along the row removes.

    Parameters
    ----------
    wavelength_mm : float
        Of the laser.
    f_number : float
        Working f-number of the lens on the image side; its aperture angle is ``sin u = 1 / (2 f_number)``.
    pixel_mm : float
        Pixel pitch.
    contrast : float
        Speckle contrast C, 1 for a fully coherent laser on a rough surface.

    Returns
    -------
    float
        ``C wavelength / (2 pi sin u)`` over the pixel pitch.

    References
    ----------
    R. G. Dorsch, G. Haeusler and J. M. Herrmann, Applied Optics 33 (1994), doi:10.1364/AO.33.001306.
    """
    return contrast * wavelength_mm * 2.0 * f_number / (2.0 * np.pi) / pixel_mm


def extract(
    frame: AnyFrame,
    candidates: int = CANDIDATES,
    *,
    axis: Literal[0, 1] = 1,
    bits: int | None = None,
    speckle_px: float = 0.0,
) -> Stripe:
    """Find the laser stripe in each row of a frame.

    Parameters
    ----------
    frame : (rows, columns) uint8 or uint16
        A camera frame, not undistorted.
    candidates : int
        How many peaks a row to keep.
    axis : {1, 0}
        1 for a near-vertical stripe, one peak a row; 0 for a near-horizontal one, one peak a column: what is said
        of rows and columns then holds with the two exchanged.
    bits : int, optional
        Bits of a pixel that are used, which tells where it clips: 8 for uint8, 12 for uint16 if not given; at most 15.
    speckle_px : float
        Standard deviation by speckle (`speckle_sigma_px`), added to each candidate's sigma in quadrature.

    Returns
    -------
    Stripe
        Candidates a row in distorted pixel coordinates, strongest response first.

    Raises
    ------
    ValueError
        If the frame is of another type or shape, or `candidates`, `axis` or `bits` make no sense.

    Notes
    -----
    A peak is where a box of four pixels stands out from both flanks. The half-maximum width there chooses the
    antisymmetric filter (the Blais-Rioux family with length and taper as parameters) whose zero crossing is the
    column. Of a clipped stripe only the flanks are used, fitted by a Gaussian. A lone bright pixel is no peak; two
    stripes closer than `FLANK_PX` are one.

    References
    ----------
    F. Blais and M. Rioux, doi:10.1016/0165-1684(86)90033-2.
    """
    require_shape("frame", frame, (None, None))
    if frame.dtype.str not in ("|u1", "<u2"):
        raise ValueError(f"frame: expected uint8 or uint16, got {frame.dtype}")
    if candidates < 1:
        raise ValueError(f"candidates: expected at least 1, got {candidates}")
    if axis not in (0, 1):
        raise ValueError(f"axis: expected 0 or 1, got {axis}")
    used = bits if bits is not None else (8 if frame.dtype == np.uint8 else 12)
    if not 1 <= used <= min(8 * frame.itemsize, 15):
        raise ValueError(f"bits: expected 1 to {min(8 * frame.itemsize, 15)} for {frame.dtype}, got {used}")
    pixels, words = _words(frame if axis == 1 else cv2.transpose(frame))
    rows = len(frame) if axis == 1 else frame.shape[1]
    full = float((1 << used) - 1)
    table = filters()
    out = np.empty((RESULTS, rows, candidates))
    noise = np.full(rows, kernel.MIN_NOISE_DN)
    if not pixels.size:
        out.fill(np.nan)
    else:
        _compiled(8 * frame.itemsize)(
            pixels, words, *kernel.scratch(words, candidates),
            full * SATURATED_PART, RESPONSE_SIGMAS, full * MIN_RESPONSE_PART,
            *table, out, noise,
        )  # fmt: skip
    sigma = out[SIGMA]
    return Stripe(
        out[COLUMN],
        out[WIDTH],
        out[AMPLITUDE],
        out[SATURATED] == 1.0,
        noise,
        np.hypot(sigma, speckle_px) if speckle_px else sigma,
    )


def warm_up() -> None:
    """Compile or load the kernel, so that the first frame is not late."""
    extract(np.zeros((1, 2 * FLANK_PX), dtype=np.uint8), 1)


def _words(frame: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
    """A frame and the same memory as words of two pixels, both read-only; an odd last column is doubled."""
    if frame.shape[1] % 2:
        frame = np.concatenate([frame, frame[:, -1:]], axis=1)
    pixels = np.ascontiguousarray(frame).view()
    if pixels.ctypes.data % (2 * frame.itemsize):
        pixels = pixels.copy()
    pixels.flags.writeable = False
    return pixels, pixels.view(np.uint16 if frame.dtype == np.uint8 else np.uint32)
