"""The ``$n=value`` settings of the emulated Grbl board."""

from __future__ import annotations

import math
from typing import Final

from echolume_drivers.emulated.grbl_parser import GrblError

SOFT_HALF_MM: Final = 155.0
"""Travel that the controller allows, to either side of the guide's middle."""

DEFAULTS: Final[dict[int, float]] = {
    10: 1,  # status report: machine position
    13: 0,  # report in millimetres
    20: 1,  # soft limits
    21: 1,  # hard limits
    22: 1,  # homing
    23: 0,  # homing towards positive x
    24: 100.0,  # homing feed, mm/min
    25: 6000.0,  # homing seek, mm/min
    26: 25,  # homing debounce, ms
    27: 6.0,  # homing pull-off, mm
    30: 1000,  # S of full power
    31: 0,  # S of no power
    32: 1,  # laser mode
    100: 250.0,  # steps/mm
    110: 30000.0,  # fastest feed, mm/min
    120: 4000.0,  # acceleration, mm/s^2
    130: 2 * SOFT_HALF_MM,  # travel, mm
}


def listing(settings: dict[int, float]) -> list[str]:
    """The answer to ``$$``."""
    return [
        f"${key}={value:.3f}" if value % 1 or key >= 100 else f"${key}={value:.0f}"
        for key, value in sorted(settings.items())
    ]


def change(text: str, settings: dict[int, float]) -> None:
    """Obey ``$n=value``.

    Raises
    ------
    GrblError
        With the code that Grbl answers.
    """
    key, equals, value = text[1:].partition("=")
    if not equals or not key.isdigit() or int(key) not in settings:
        raise GrblError(3)
    try:
        number = float(value)
    except ValueError:
        raise GrblError(2) from None
    if not math.isfinite(number):
        raise GrblError(2)
    if number < 0:
        raise GrblError(4)
    if int(key) == 20 and number and not settings[22]:
        raise GrblError(10)
    settings[int(key)] = number
