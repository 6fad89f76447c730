"""The speed of sound in air."""

from __future__ import annotations

import math

ZERO_CELSIUS_K = 273.15
SPEED_AT_ZERO_CELSIUS_MPS = 331.3


def speed_of_sound_mps(temperature_c: float) -> float:
    """Speed of sound in dry air, an ideal gas."""
    return SPEED_AT_ZERO_CELSIUS_MPS * math.sqrt(1 + temperature_c / ZERO_CELSIUS_K)


def carried_mps(speed_mps: float, from_c: float, to_c: float) -> float:
    """A measured speed of sound, carried from the temperature of its measurement to another one."""
    return speed_mps * math.sqrt((to_c + ZERO_CELSIUS_K) / (from_c + ZERO_CELSIUS_K))
