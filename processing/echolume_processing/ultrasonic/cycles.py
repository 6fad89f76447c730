"""Cycles of the carrier, settled by all channels of a ping together: one surface, whole wavelengths."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, require_shape
from echolume_processing.ultrasonic.cycle_kernels import settle

MIN_CHANNELS = 5
"""Three unknowns, and two more to contradict a wrong cycle."""


@dataclass(frozen=True)
class Settled:
    """Paths of one ping, all on the same surface."""

    paths_mm: NDArray[np.float64]
    """(receivers,); not a number where there was none."""
    chi_squared: float
    """Of the paths about the surface, per degree of freedom; infinite where there were too few."""
    margin: float
    """How much worse, in chi-squared, the next choice of cycles is."""


def settle_cycles(
    receivers_mm: Points3,
    envelope_mm: NDArray[np.float64],
    envelope_sigma_mm: NDArray[np.float64],
    phase_mm: NDArray[np.float64],
    phase_sigma_mm: float,
    wavelength_mm: float,
) -> Settled:
    """Choose the cycles of all channels at once.

    Parameters
    ----------
    receivers_mm : (receivers, 3) float64
        Relative to the emitter.
    envelope_mm, envelope_sigma_mm : (receivers,) float64
        Paths that the envelopes tell, without cycles; not a number where there is no echo.
    phase_mm : (receivers,) float64
        Paths that the phases tell, up to whole wavelengths.
    phase_sigma_mm : float
        Of `phase_mm`, what a smooth surface leaves unexplained included.
    wavelength_mm : float
        Of the compressed pulse's centre.

    Notes
    -----
    A plane (or a point, whichever fits) through all envelopes predicts each path better than the channel's own
    envelope: to sqrt(3 / receivers) of its error. A cycle that all channels miss together is told by the mean envelope.
    Wrong where the paths belong to no common plane or point; `chi_squared` then says so.

    References
    ----------
    Teunissen, The least-squares ambiguity decorrelation adjustment, Journal of Geodesy 70, 65-82 (1995),
    doi:10.1007/BF00863419: whole cycles by integer least squares.
    """
    require_shape("receivers_mm", receivers_mm, (None, 3))
    require_shape("phase_mm", phase_mm, (len(receivers_mm),))
    known = np.isfinite(envelope_mm) & np.isfinite(phase_mm)
    count = int(np.count_nonzero(known))
    paths = np.where(known, phase_mm, np.nan)
    if count < MIN_CHANNELS:
        return Settled(paths, np.inf, 0.0)
    best, scores = phase_mm[known].copy(), np.empty(3)
    settle(
        receivers_mm[known],
        envelope_mm[known],
        envelope_sigma_mm[known],
        phase_mm[known],
        phase_sigma_mm,
        wavelength_mm,
        best,
        scores,
    )
    paths[known] = best
    chi_squared = float(scores[0]) / (count - 3)
    return Settled(paths, chi_squared, float(scores[2] - scores[1]) if np.isfinite(chi_squared) else 0.0)
