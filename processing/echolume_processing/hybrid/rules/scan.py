"""What every rule is given, and the two images that most of them compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration
from echolume_messages.plan import MapField
from echolume_messages.types import Structured
from echolume_processing.hybrid.baselines import nearest_points
from echolume_processing.hybrid.grid import OpticalGrid, accumulate
from echolume_processing.ping import Ping

DOUBTFUL_MM = 5.0
"""Standard deviation of a contact point that no surface explains, and that therefore states none."""
LEAST_SIGMA_MM = 0.01


@dataclass(frozen=True)
class SoundImage:
    """What contact points say of each cell; images of the field's shape, nan beyond their reach."""

    height_mm: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]


@dataclass(frozen=True)
class Scan:
    """The evidence of a scan, in any order."""

    optical: Structured
    """``OPTICAL_POINT`` (n,)."""
    ultrasonic: Structured
    """``ULTRASONIC_POINT`` (m,)."""
    pings: Sequence[Ping]
    calibration: Calibration
    field: MapField

    @cached_property
    def light(self) -> OpticalGrid:
        """Light's cells."""
        return accumulate(self.optical, self.field)

    @cached_property
    def sound(self) -> SoundImage:
        """The nearest contact point of each cell."""
        return sound_image(self.ultrasonic, self.field)


def sigma_of(points: Structured) -> NDArray[np.float64]:
    """Standard deviation of the height of contact points (n,), mm; `DOUBTFUL_MM` where they state none."""
    variance = points["zz_mm2"].astype(np.float64)
    stated = np.isfinite(variance) & (variance > 0)
    sigma_mm = np.sqrt(np.where(stated, variance, DOUBTFUL_MM**2))
    return np.asarray(np.clip(sigma_mm, LEAST_SIGMA_MM, DOUBTFUL_MM), dtype=np.float64)


def sound_image(points: Structured, field: MapField) -> SoundImage:
    """Height and standard deviation of the nearest contact point of each cell."""
    height_mm, sigma_mm = np.full(field.shape, np.nan), np.full(field.shape, np.nan)
    ordered, index = nearest_points(points, field)
    found = index < ordered.size
    height_mm[found] = ordered["z_mm"][index[found]]
    sigma_mm[found] = sigma_of(ordered)[index[found]]
    return SoundImage(height_mm, sigma_mm)
