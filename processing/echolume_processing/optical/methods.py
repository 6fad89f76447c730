"""The usual ways to find a stripe in a row, by name: what the literature and other scanners do, for comparison."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_processing.optical.blais_rioux import blais_rioux_peaks

Columns = NDArray[np.float64]
"""Sub-pixel column of each row, (rows,); nan where there is none."""
AnyFrame = NDArray[Any]
Method = Callable[[AnyFrame], Columns]

STEGER_SIGMA_PX = 2.0
THRESHOLD_PART = 0.15
"""Pixels below this part of the frame's maximum weigh nothing in a centre of mass."""


def argmax(frame: AnyFrame) -> Columns:
    """Column of the brightest pixel of each row of `frame` (rows, columns)."""
    require_shape("frame", frame, (None, None))
    return np.argmax(frame, axis=1).astype(np.float64)


def _three(frame: AnyFrame) -> tuple[NDArray[np.int64], Columns, Columns, Columns]:
    """Column of each row's brightest pixel inside the frame, and it and its neighbours."""
    require_shape("frame", frame, (None, None))
    rows = np.arange(len(frame))
    column = np.clip(np.argmax(frame, axis=1), 1, frame.shape[1] - 2)
    left, top, right = (frame[rows, column + d].astype(np.float64) for d in (-1, 0, 1))
    return column, left, top, right


def _vertex(column: NDArray[np.int64], left: Columns, top: Columns, right: Columns) -> Columns:
    bend = left - 2 * top + right
    shift = np.divide(0.5 * (left - right), bend, out=np.full(len(top), np.nan), where=bend < 0)
    return np.where(np.abs(shift) <= 1, column + shift, np.nan)


def parabola(frame: AnyFrame) -> Columns:
    """Vertex of the parabola through the brightest pixel of each row and its two neighbours."""
    return _vertex(*_three(frame))


def gauss(frame: AnyFrame) -> Columns:
    """Crest of the Gaussian through the brightest pixel of each row and its two neighbours."""
    column, left, top, right = _three(frame)
    return _vertex(column, np.log(left + 1), np.log(top + 1), np.log(right + 1))


def centre_of_mass(frame: AnyFrame) -> Columns:
    """Centre of mass of each whole row in a float64 weight image above a threshold, as in the scanner Horus."""
    require_shape("frame", frame, (None, None))
    weight = np.where(frame > THRESHOLD_PART * frame.max(), frame, 0).astype(np.float64)
    columns = np.arange(frame.shape[1], dtype=np.float64)
    total = weight.sum(axis=1)
    return np.divide((weight * columns).sum(axis=1), total, out=np.full(len(frame), np.nan), where=total > 0)


def steger(frame: AnyFrame, sigma_px: float = STEGER_SIGMA_PX) -> Columns:
    """Ridge point of the strongest curvature of each row, from the Hessian of the smoothed frame.

    Parameters
    ----------
    frame : (rows, columns)
        With a near-vertical stripe.
    sigma_px : float
        Of the smoothing Gaussian, about the stripe's.

    Returns
    -------
    (rows,) float64
        Where the ridge crosses the row; nan where no ridge lies within a pixel.

    References
    ----------
    C. Steger, "An unbiased detector of curvilinear structures", doi:10.1109/34.659930.
    """
    require_shape("frame", frame, (None, None))
    smooth = cv2.GaussianBlur(frame.astype(np.float32), (0, 0), sigma_px, borderType=cv2.BORDER_REPLICATE)
    rx = cv2.Sobel(smooth, cv2.CV_32F, 1, 0, ksize=1, scale=0.5)
    ry = cv2.Sobel(smooth, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    rxx = cv2.Sobel(smooth, cv2.CV_32F, 2, 0, ksize=1)
    ryy = cv2.Sobel(smooth, cv2.CV_32F, 0, 2, ksize=1)
    rxy = cv2.Sobel(rx, cv2.CV_32F, 0, 1, ksize=1, scale=0.5)
    half = 0.5 * (rxx - ryy)
    bend = 0.5 * (rxx + ryy) - np.hypot(half, rxy)  # the most negative eigenvalue of the Hessian
    rows = np.arange(len(frame))
    column = np.argmin(bend, axis=1)
    at = (rows, column)
    angle = 0.5 * np.arctan2(rxy[at], half[at])  # of the other eigenvector
    nx, ny = -np.sin(angle), np.cos(angle)
    across = rxx[at] * nx**2 + 2 * rxy[at] * nx * ny + ryy[at] * ny**2
    along = rx[at] * nx + ry[at] * ny
    t = np.divide(-along, across, out=np.full(len(frame), np.nan), where=across < 0)
    slant = np.divide(1.0, nx, out=np.full(len(frame), np.nan), where=np.abs(nx) > 0.1)
    shift = t * slant  # from the pixel along the row to the ridge line
    return np.where(np.abs(shift) <= 1, column + shift, np.nan).astype(np.float64)


METHODS: dict[str, Method] = {
    "argmax": argmax,
    "parabola": parabola,
    "gauss": gauss,
    "blais-rioux-2": lambda frame: blais_rioux_peaks(frame, 2),
    "blais-rioux-4": lambda frame: blais_rioux_peaks(frame, 4),
    "blais-rioux-8": lambda frame: blais_rioux_peaks(frame, 8),
    "centre of mass": centre_of_mass,
    "steger": steger,
}
"""One peak a row each; all but the last two take the row's brightest pixel."""
