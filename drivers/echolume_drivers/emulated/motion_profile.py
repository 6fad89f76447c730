"""Trapezoidal motion of one axis as a pure function of time."""

from __future__ import annotations

import math
from dataclasses import dataclass, field


@dataclass(frozen=True)
class Trapezoid:
    """A move of one axis: accelerate, cruise, decelerate.

    Positions are in the axis's own unit, speeds in that unit per second, and time counts from the start of the move.
    Entry and exit speeds that the distance cannot reconcile are lowered until they fit.

    Parameters
    ----------
    start, end
        Where the move begins and ends.
    cruise
        Highest speed, > 0.
    acceleration
        Of both ramps, > 0.
    entry, exit
        Speed along the direction of the move at its two ends.
    """

    start: float
    end: float
    cruise: float
    acceleration: float
    entry: float = 0.0
    exit: float = 0.0
    _ramps: tuple[float, float, float, float, float, float] = field(init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        length, a = abs(self.end - self.start), self.acceleration
        reach = 2 * a * length
        entry = min(self.entry, self.cruise, math.sqrt(reach + self.exit**2))
        leave = min(self.exit, self.cruise, math.sqrt(reach + entry**2))
        peak = min(self.cruise, math.sqrt((reach + entry**2 + leave**2) / 2))
        up_s, down_s = (peak - entry) / a, (peak - leave) / a
        ramps = (peak + entry) / 2 * up_s + (peak + leave) / 2 * down_s
        flat_s = max(0.0, length - ramps) / peak if peak > 0 else 0.0
        object.__setattr__(self, "_ramps", (entry, peak, leave, up_s, flat_s, down_s))

    @property
    def duration_s(self) -> float:
        """How long the move takes."""
        return self._ramps[3] + self._ramps[4] + self._ramps[5]

    @property
    def direction(self) -> float:
        """+1.0 or -1.0."""
        return 1.0 if self.end >= self.start else -1.0

    def position(self, t_s: float) -> float:
        """Where the axis is `t_s` after the start; the ends outside the move."""
        entry, peak, leave, up_s, flat_s, down_s = self._ramps
        if t_s <= 0:
            return self.start
        if t_s >= up_s + flat_s + down_s:
            return self.end
        if t_s < up_s:
            return self.start + self.direction * (entry * t_s + 0.5 * self.acceleration * t_s**2)
        if t_s < up_s + flat_s:
            return self.start + self.direction * ((entry + peak) / 2 * up_s + peak * (t_s - up_s))
        left_s = up_s + flat_s + down_s - t_s
        return self.end - self.direction * (leave * left_s + 0.5 * self.acceleration * left_s**2)

    def speed(self, t_s: float) -> float:
        """How fast it moves `t_s` after the start, along its direction."""
        entry, peak, leave, up_s, flat_s, down_s = self._ramps
        if t_s < 0 or t_s >= up_s + flat_s + down_s:
            return 0.0
        if t_s < up_s:
            return entry + self.acceleration * t_s
        if t_s < up_s + flat_s:
            return peak
        return leave + self.acceleration * (up_s + flat_s + down_s - t_s)

    def time_at(self, position: float) -> float | None:
        """When the axis passes `position`; None if it never does."""
        low_s, high_s = 0.0, self.duration_s
        if (position - self.start) * (position - self.end) > 0:
            return None
        for _ in range(60):
            middle_s = (low_s + high_s) / 2
            if (self.position(middle_s) - position) * self.direction < 0:
                low_s = middle_s
            else:
                high_s = middle_s
        return high_s
