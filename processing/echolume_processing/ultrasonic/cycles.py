"""Cycles of the carrier, settled by all channels of a ping together: one surface, whole wavelengths."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, require_shape
from echolume_processing.ultrasonic.cycle_kernels import settle
from echolume_processing.ultrasonic.flight import LEAST_NOISE, Arrivals

ENVELOPE_FLOOR_MM = 0.2
"""What the model leaves unexplained of a path by its envelope alone."""
MAX_CHI_SQUARED = 6.0
MIN_MARGIN = 9.0
"""Cycles that all channels agree on: how well they fit a surface, and how much worse the next choice is."""
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


def settled(
    found: Arrivals,
    paths_mm: NDArray[np.float64],
    receivers_mm: Points3,
    period_s: NDArray[np.float64],
    speed_mm_per_s: float,
    floor_mm: float,
) -> tuple[Arrivals, NDArray[np.float64]]:
    """Arrivals and paths after all channels have settled their cycles together; unchanged where no surface fits.

    Parameters
    ----------
    found : Arrivals
    paths_mm : (receivers,) float64
    receivers_mm : (receivers, 3) float64
        Relative to the emitter.
    period_s : (receivers,) float64
        Of each channel's compressed pulse.
    speed_mm_per_s : float
    floor_mm : float
        What a smooth surface leaves unexplained of a path.
    """
    envelope_mm = paths_mm + (found.envelope_s - found.time_s) * speed_mm_per_s
    envelope_sigma_mm = np.hypot(found.envelope_sigma_s * speed_mm_per_s, ENVELOPE_FLOOR_MM)
    doubtful = found.doubtful
    turned_s = np.where(doubtful, -found.phase_rad / (2 * np.pi) * period_s, 0.0)
    wavelength_mm = float(period_s.mean()) * speed_mm_per_s
    agreed = settle_cycles(
        receivers_mm, envelope_mm, envelope_sigma_mm, paths_mm + turned_s * speed_mm_per_s, floor_mm, wavelength_mm
    )
    if agreed.chi_squared > MAX_CHI_SQUARED or agreed.margin < MIN_MARGIN:
        return found, paths_mm
    relative = np.maximum(found.noise / np.where(found.found, found.amplitude, 1.0), LEAST_NOISE)
    after = replace(
        found,
        time_s=found.time_s + (agreed.paths_mm - paths_mm) / speed_mm_per_s,
        phase_rad=np.where(doubtful, 0.0, found.phase_rad),
        sigma_s=np.where(doubtful, relative * period_s / (2 * np.pi), found.sigma_s),
    )
    return after, agreed.paths_mm
