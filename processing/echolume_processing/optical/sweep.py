"""The agreement of both cameras over a sweep of stripes, the plane or timing error that it implies, and the alarm."""

from __future__ import annotations

import logging
from itertools import pairwise

import numpy as np

from echolume_processing.optical.agreement import Agreement, of_sweep

FEW_STRIPES = 3
LEAST_SPEED_MMPS = 1.0


class Sweep:
    """Follows one sweep after the other, and logs once in each when the cameras stop agreeing.

    Parameters
    ----------
    log
        Where the alarm is raised.
    """

    def __init__(self, log: logging.Logger) -> None:
        self._log = log
        self._name = ("", "")
        self._limit_mm = float("nan")
        self._stripes: list[Agreement] = []
        self._guide: list[tuple[float, int]] = []
        self._alarm = False

    def add(self, name: tuple[str, str], limit_mm: float, found: Agreement, x_mm: float, t_ns: int) -> None:
        """Take one stripe.

        Parameters
        ----------
        name : (str, str)
            Scan and pass; a new name begins a new sweep.
        limit_mm : float
            A larger error of the laser plane raises the alarm.
        found : Agreement
            Of the stripe.
        x_mm, t_ns : float, int
            The guide's position, and the time of the frames.
        """
        if name != self._name:
            self._name, self._stripes, self._guide, self._alarm = name, [], [], False
        self._limit_mm = limit_mm
        if not found.points:
            return
        self._stripes.append(found)
        self._guide.append((x_mm, t_ns))
        sweep = self.agreement
        alarm = len(self._stripes) >= FEW_STRIPES and sweep.error_mm > limit_mm
        if alarm and not self._alarm:
            self._log.warning(
                "scan %s, pass %s: AT-left and AT-right differ by %.3f mm (median of %d stripes), noise explains "
                "%.3f mm: the laser plane is off by %.3f mm (at most %.3f mm is stated)%s; calibrate the laser, or "
                "check that frames and guide positions belong together",
                *name, sweep.median_mm, len(self._stripes), sweep.noise_mm, sweep.error_mm, limit_mm, self._in_time(),
            )  # fmt: skip
        self._alarm = alarm

    @property
    def agreement(self) -> Agreement:
        """Of the stripes of the sweep so far."""
        return of_sweep(self._stripes)

    @property
    def alarm(self) -> bool:
        """Whether the laser plane's error exceeds what noise and its stated sigma explain."""
        return self._alarm

    @property
    def sync_ms(self) -> float | None:
        """By how much frames and guide positions would be out of step to explain the error; None at rest."""
        steps = [(b[0] - a[0], 1e-9 * (b[1] - a[1])) for a, b in pairwise(self._guide)]
        speeds_mmps = [dx_mm / dt_s for dx_mm, dt_s in steps if dt_s > 0]
        if not speeds_mmps or abs(float(np.median(speeds_mmps))) < LEAST_SPEED_MMPS:
            return None
        return 1e3 * self.agreement.plane_mm / float(np.median(speeds_mmps))

    def report(self) -> dict[str, object]:
        """What is published of the sweep."""
        sweep = self.agreement
        if not sweep.points:
            return {"stripes": 0, "alarm": False}
        sync_ms = self.sync_ms
        return {
            "scan": self._name[0],
            "pass": self._name[1],
            "stripes": len(self._stripes),
            "points": sweep.points,
            "median_mm": round(sweep.median_mm, 4),
            "noise_mm": round(sweep.noise_mm, 4),
            "amplification": round(sweep.amplification, 2),
            "plane_mm": round(sweep.plane_mm, 4),
            "error_mm": round(sweep.error_mm, 4),
            "limit_mm": round(self._limit_mm, 4),
            "sync_ms": None if sync_ms is None else round(sync_ms, 2),
            "alarm": self._alarm,
        }

    def _in_time(self) -> str:
        sync_ms = self.sync_ms
        return "" if sync_ms is None else f", or {sync_ms:.1f} ms at the sweep's speed"
