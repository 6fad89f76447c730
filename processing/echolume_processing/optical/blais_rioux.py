"""The paper's stripe peaks: Blais-Rioux operators and the linear zero crossing."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape

Image = NDArray[np.float64]


def blais_rioux(profiles: NDArray[np.generic], order: int = 4) -> Image:
    """Response of the Blais-Rioux operator of the given order along each row.

    Parameters
    ----------
    profiles : (rows, columns)
        Intensity profiles, one a row.
    order : {2, 4, 8}
        Number of taps; half of them on each side of the centre.

    Returns
    -------
    (rows, columns) float64
        Sum of the ``order / 2`` samples to the left minus those to the right; zero in the margins. It rises
        through zero at a peak.

    References
    ----------
    F. Blais and M. Rioux, "Real-time numerical peak detector", Signal Processing 11 (1986),
    doi:10.1016/0165-1684(86)90033-2; the paper's [17] applies it to laser stripes.
    """
    require_shape("profiles", profiles, (None, None))
    if order not in (2, 4, 8):
        raise ValueError(f"order: expected 2, 4 or 8, got {order}")
    half = order // 2
    image = profiles.astype(np.float64)
    columns = image.shape[1]
    out = np.zeros_like(image)
    if columns > 2 * half:
        inner = slice(half, columns - half)
        for i in range(1, half + 1):
            out[:, inner] += image[:, half - i : columns - half - i] - image[:, half + i : columns - half + i]
    return out


def blais_rioux_peaks(profiles: NDArray[np.generic], order: int = 4) -> NDArray[np.float64]:
    """Sub-pixel column of the brightest peak of each row (paper 2.2.2).

    Parameters
    ----------
    profiles : (rows, columns)
        Intensity profiles, one a row.
    order : {2, 4, 8}
        Order of the operator; 4 is the paper's choice.

    Returns
    -------
    (rows,) float64
        Column of the zero crossing beside the brightest sample, in pixels; nan where none lies next to it.

    Notes
    -----
    Fails on saturated stripes wider than the operator and on rows whose brightest sample is not the stripe.
    """
    response = blais_rioux(profiles, order)
    rows = np.arange(len(response))
    column = np.clip(np.argmax(profiles, axis=1), 1, response.shape[1] - 2)  # (rows,)
    column = np.where(response[rows, column] > 0, column - 1, column)
    before, after = response[rows, column], response[rows, column + 1]
    crosses = (before <= 0) & (after > 0)
    step = np.where(crosses, after - before, 1.0)
    return np.where(crosses, column - before / step, np.nan)
