"""How well a localiser does on recordings that its calibration did not see."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .localise import Places, grid_around, localise
from .localise_calibrate import calibrate
from .recordings import Recordings

CHI2_90 = 6.251
"""90 % point of chi-squared with three degrees of freedom."""


@dataclass(frozen=True)
class Score:
    """3D error over the recordings that the calibration did not see, in mm."""

    calibrated_on: int
    scored_on: int
    median_mm: float
    mean_mm: float
    p90_mm: float
    sigma_median_mm: float
    """Median of the stated 3D standard deviation."""
    covered_90: float
    """Share of the targets inside their stated 90 % ellipsoid."""
    channels_heard: float
    """Mean number of channels that hear the target."""
    setups: int
    delays: list[list[float]]
    """In samples, a row per set-up."""
    offset_mm: list[float]


def score(recordings: Recordings) -> Score:
    """Calibrate on even-numbered recordings, localise in the odd ones."""
    even = np.arange(len(recordings.frames)) % 2 == 0
    seen = recordings.chosen(even)
    localiser = calibrate(seen)
    unseen = recordings.chosen(~even)
    found = localise(localiser, unseen.frames, unseen.backgrounds, grid_around(seen.target_mm))
    away = found.place_mm - unseen.target_mm
    error = np.linalg.norm(away, axis=1)
    return Score(
        int(np.count_nonzero(even)),
        len(error),
        float(np.median(error)),
        float(np.mean(error)),
        float(np.percentile(error, 90)),
        float(np.median(sigma_mm(found))),
        float(np.mean(np.einsum("ri,rij,rj->r", away, np.linalg.inv(found.covariance_mm2), away) < CHI2_90)),
        float(np.mean(np.count_nonzero(found.heard, axis=1))),
        len(localiser.setups),
        localiser.delays.tolist(),
        localiser.offset_mm.tolist(),
    )


def sigma_mm(places: Places) -> NDArray[np.float64]:
    """Stated 3D standard deviation of each place, (recordings,)."""
    return np.sqrt(np.trace(places.covariance_mm2, axis1=1, axis2=2))
