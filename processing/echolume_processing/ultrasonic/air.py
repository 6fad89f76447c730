"""The speed of sound in air."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape

ZERO_CELSIUS_K = 273.15
SPEED_AT_ZERO_CELSIUS_MPS = 331.3
SEA_LEVEL_HPA = 1013.25
CARBON_DIOXIDE = 420e-6
"""Mole fraction of carbon dioxide outdoors; a closed room may hold three times as much, for 0.03 % less speed."""


def speed_of_sound_mps(temperature_c: float) -> float:
    """Speed of sound in dry air, an ideal gas."""
    return SPEED_AT_ZERO_CELSIUS_MPS * math.sqrt(1 + temperature_c / ZERO_CELSIUS_K)


def carried_mps(speed_mps: float, from_c: float, to_c: float) -> float:
    """A measured speed of sound, carried from the temperature of its measurement to another one."""
    return speed_mps * math.sqrt((to_c + ZERO_CELSIUS_K) / (from_c + ZERO_CELSIUS_K))


@dataclass(frozen=True)
class Air:
    """Air as instruments in a room tell it."""

    temperature_c: float
    humidity: float = 0.5
    """Relative, 0 to 1."""
    pressure_hpa: float = SEA_LEVEL_HPA
    carbon_dioxide: float = CARBON_DIOXIDE
    """Mole fraction."""


def water_mole_fraction(air: Air) -> float:
    """Mole fraction of water vapour.

    References
    ----------
    Davis, Equation for the determination of the density of moist air (1981/91), Metrologia 29, 67-70 (1992),
    doi:10.1088/0026-1394/29/1/008.
    """
    kelvin = air.temperature_c + ZERO_CELSIUS_K
    pressure_pa = 100 * air.pressure_hpa
    saturated_pa = math.exp(1.2378847e-5 * kelvin**2 - 1.9121316e-2 * kelvin + 33.93711047 - 6.3431645e3 / kelvin)
    enhancement = 1.00062 + 3.14e-8 * pressure_pa + 5.6e-7 * air.temperature_c**2
    return air.humidity * enhancement * saturated_pa / pressure_pa


def humid_mps(air: Air) -> float:
    """Speed of sound in humid air.

    Raises
    ------
    ValueError
        Outside of the formula's range: 0 to 30 degrees, 750 to 1050 hPa, up to 1 % of carbon dioxide.

    Notes
    -----
    The formula's own error is given as 300 ppm, 0.1 mm of range at 400 mm. It holds for low frequencies; at
    40 kHz, above the relaxation of oxygen and nitrogen, sound is some 0.1 m/s faster.

    References
    ----------
    Cramer, The variation of the specific heat ratio and the speed of sound in air with temperature, pressure, humidity,
    and CO2 concentration, J. Acoust. Soc. Am. 93, 2510-2516 (1993), doi:10.1121/1.405827.
    """
    t, p, c = air.temperature_c, 100 * air.pressure_hpa, air.carbon_dioxide
    if not (0 <= t <= 30 and 7.5e4 <= p <= 1.05e5 and 0 <= c <= 0.01 and 0 <= air.humidity <= 1):
        raise ValueError(
            f"the speed of sound is known for 0 to 30 degrees, humidity 0 to 1, 750 to 1050 hPa and at most 0.01 of "
            f"carbon dioxide; this air is {air}"
        )
    w = water_mole_fraction(air)
    dry = 331.5024 + 0.603055 * t - 0.000528 * t**2
    wet = (51.471935 + 0.1495874 * t - 0.000782 * t**2) * w - 2.835149 * w**2
    pressed = (-1.82e-7 + 3.73e-8 * t - 2.93e-10 * t**2) * p - 2.15e-13 * p**2
    carbonic = (-85.20931 - 0.228525 * t + 5.91e-5 * t**2) * c + 29.179762 * c**2
    return dry + wet + pressed + carbonic + 0.000486 * w * p * c


@dataclass(frozen=True)
class Speed:
    """A speed of sound that was measured."""

    mps: float
    sigma_mps: float
    chi_squared: float
    """Of the times about it, per degree of freedom; not a number where there is none left."""


def speed_from_paths(
    times_s: NDArray[np.float64],
    paths_mm: NDArray[np.float64],
    time_sigma_s: NDArray[np.float64],
    path_sigma_mm: NDArray[np.float64],
    *,
    common_delay: bool = False,
) -> Speed:
    """Speed of sound from known paths: direct sound between elements, or a reference plate at a known distance.

    Parameters
    ----------
    times_s, time_sigma_s : (n,) float64
        Arrivals after the emission, known delays taken off; not a number where there is none.
    paths_mm, path_sigma_mm : (n,) float64
    common_delay : bool
        Whether all times share one more unknown delay; then paths of different lengths are needed.

    Raises
    ------
    ValueError
        If there are fewer known paths than unknowns, or all of one length where a delay is sought.
    """
    require_shape("times_s", times_s, (None,))
    require_shape("paths_mm", paths_mm, (len(times_s),))
    known = np.isfinite(times_s) & np.isfinite(paths_mm)
    columns = [paths_mm[known], np.ones(int(np.count_nonzero(known)))][: 1 + common_delay]
    if not known.any() or (common_delay and np.ptp(columns[0]) == 0.0):
        raise ValueError(
            f"the speed of sound needs {1 + common_delay} known path(s) of different lengths, there are "
            f"{int(np.count_nonzero(known))}; give the direct sound or a plate at a known distance"
        )
    model = np.stack(columns, axis=1)
    slowness = float(np.median(times_s[known] / paths_mm[known]))
    sigma = np.hypot(time_sigma_s[known], path_sigma_mm[known] * slowness)
    covariance = np.linalg.inv((model / sigma[:, None] ** 2).T @ model)
    found = covariance @ (model.T @ (times_s[known] / sigma**2))
    left = (times_s[known] - model @ found) / sigma
    freedom = len(left) - len(found)
    speed_mps = 1e-3 / float(found[0])
    sigma_mps = speed_mps * float(np.sqrt(covariance[0, 0])) / float(found[0])
    return Speed(speed_mps, sigma_mps, float(left @ left) / freedom if freedom else float("nan"))
