"""Where the laser plane of one stripe really was: its stereo points tell the carriage's error."""

from __future__ import annotations

import numpy as np
from numba import njit
from numpy.typing import NDArray

from echolume_processing.optical.agreement import FEW_POINTS, LAG_ROWS
from echolume_processing.optical.middle import ENOUGH

Values = NDArray[np.float64]

EXPLAINED = 3.0
"""A shift of so many sigmas is still the carriage's."""
MEDIAN_X_MEAN = 0.5 * np.pi
"""Variance of a median over that of a mean, of normal noise."""


@njit(cache=True, nogil=True)
def shift(
    count: int, noise_mm: float, per_mm: float, middle_mm: float, y_mm: float, z_mm: float, camera_mm: float,
    plane_mm2: Values,
) -> tuple[float, Values]:  # fmt: skip
    """How far along its normal the laser plane lies beyond its calibrated place, and what variance that leaves.

    Parameters
    ----------
    count
        Points that both cameras see.
    noise_mm, per_mm, middle_mm
        Of `agreement.summary`: noise and median of AT-left minus AT-right, and its change by the plane's position.
    y_mm, z_mm
        Middle of those points.
    camera_mm
        What the cameras' own errors, which all of a stripe shares, do to the plane's position as they see it.
    plane_mm2 : (6,)
        What multiplies 1, y, z, y^2, y z, z^2 in the variance of the plane's position as calibrated.

    Returns
    -------
    float
        0 if both cameras see too little.
    (6,)
        The variance then, in the same form.

    Notes
    -----
    The guide's error moves the plane as a whole. Both cameras see the same stripe on it, so the shift that makes
    AT-left and AT-right agree is one measurement of that, weighed against the calibration by Kalman's gain. The
    noise of neighbouring rows is the same speckle, so that only every `LAG_ROWS` of them counts, or every one that the
    median takes if those are further apart. Tilts are known better for it, but not moved. A shift that neither
    calibration nor noise explains may be a camera's error as well: what exceeds `EXPLAINED` sigmas stays in the
    variance. Errors of the cameras are in the stereo points and in the shift; that they go together is left out.
    """
    if count < FEW_POINTS or per_mm == 0.0:
        return 0.0, plane_mm2
    apart = max(LAG_ROWS, count // ENOUGH)
    told = MEDIAN_X_MEAN * noise_mm * noise_mm * apart / (count * per_mm * per_mm)
    told += camera_mm * camera_mm
    c01, c02, c12 = 0.5 * plane_mm2[1], 0.5 * plane_mm2[2], 0.5 * plane_mm2[4]
    h0 = plane_mm2[0] + c01 * y_mm + c02 * z_mm
    h1 = c01 + plane_mm2[3] * y_mm + c12 * z_mm
    h2 = c02 + c12 * y_mm + plane_mm2[5] * z_mm
    expected = h0 + h1 * y_mm + h2 * z_mm
    if expected + told <= 0.0:
        return 0.0, plane_mm2
    scale = 1.0 / (expected + told)
    shift_mm = -middle_mm / per_mm
    excess_mm2 = max(shift_mm * shift_mm - EXPLAINED * EXPLAINED * (expected + told), 0.0)
    left = np.array([h0 * h0, 2.0 * h0 * h1, 2.0 * h0 * h2, h1 * h1, 2.0 * h1 * h2, h2 * h2])
    after_mm2 = plane_mm2 - left * scale
    after_mm2[0] = max(after_mm2[0], 0.0) + excess_mm2
    return shift_mm * expected * scale, after_mm2
