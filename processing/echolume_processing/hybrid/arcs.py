"""Circular arcs: what a bent surface does along each of its main directions, beyond where a parabola is near enough."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

STEEPEST_SINE = 0.98
"""Where the arc is as steep as this it goes on straight, so that there is a height everywhere."""

STEEP_SINE = 0.9
"""Up to here Newton finds the way to the nearest place from."""

FLAT_PER_MM = 1e-12
"""What bends less is steep nowhere in reach."""

Values = NDArray[np.float64]


@dataclass(frozen=True)
class Arc:
    """The arc through 0 that has a slope and a second derivative (1/mm) there; a straight line if that is 0."""

    slope: float
    bend: float

    def at(self, along_mm: Values) -> tuple[Values, Values, Values]:
        """Height (mm), slope and second derivative (1/mm) so far along."""
        cosine_here, sine_here, per_mm = self._here()
        whole = sine_here + along_mm * per_mm
        low, high = min(-STEEPEST_SINE, sine_here), max(STEEPEST_SINE, sine_here)
        sine = np.clip(whole, low, high)  # of the angle that the surface has there
        beyond = sine != whole
        arc_mm = along_mm.copy()
        arc_mm[beyond] = (sine[beyond] - sine_here) / per_mm if per_mm else 0.0
        cosine = np.sqrt(1.0 - sine**2)
        slope = sine / cosine
        height_mm = arc_mm * (sine + sine_here) / (cosine + cosine_here) + (along_mm - arc_mm) * slope
        return height_mm, slope, np.where(beyond, 0.0, per_mm / cosine**3)

    def short_of(self, along_mm: Values) -> Values:
        """The same places, drawn to where the arc is not as steep as `STEEP_SINE`."""
        _, sine_here, per_mm = self._here()
        if abs(per_mm) < FLAT_PER_MM:
            return along_mm
        ends_mm = (np.array([-STEEP_SINE, STEEP_SINE]) - sine_here) / per_mm
        return np.clip(along_mm, ends_mm.min(), ends_mm.max())

    def _here(self) -> tuple[float, float, float]:
        """Cosine and sine of the arc's angle at 0, and its curvature (1/mm)."""
        cosine = float(1.0 / np.hypot(1.0, self.slope))
        return cosine, self.slope * cosine, self.bend * cosine**3
