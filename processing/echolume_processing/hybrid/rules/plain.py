"""Rules that compare nothing: each sense alone, the union of the points, the mean by variance."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_messages.types import Provenance, Structured
from echolume_processing.hybrid.baselines import union as union_mm
from echolume_processing.hybrid.grid import STEPS_PER_MM, cell_index
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.rules.cells import Cells
from echolume_processing.hybrid.rules.scan import Scan
from echolume_processing.hybrid.rules.sound import LEAST_SIGMA_MM, sigma_of
from echolume_processing.hybrid.scipy_typed import Mask
from echolume_processing.hybrid.witnesses import Witnesses, tabled

BLIND = "says nothing of glass or black: no sense is asked about the other"


def optical(scan: Scan) -> HybridMap:
    """Light alone."""
    cells = Cells(scan.field, scan.light.stripes, Witnesses())
    cells.light(scan.light, np.isfinite(scan.light.height_mm))
    return cells.finish(f"light alone {BLIND}")


def ultrasonic(scan: Scan) -> HybridMap:
    """Sound alone: heights without a label."""
    cells = Cells(scan.field, Witnesses(), scan.sound.ping)
    cells.sound(scan.sound.height_mm, scan.sound.sigma_mm, np.isfinite(scan.sound.height_mm))
    return cells.finish(f"sound alone {BLIND}")


def union(scan: Scan) -> HybridMap:
    """Mean of all points of a cell (the paper's Fig. 13); its sigma is what the points' own would make it.

    Notes
    -----
    Over glass it lies between the two layers, and its sigma does not know.
    """
    places = _Places(scan)
    light, sound = places.number(places.light), places.number(places.sound)
    variance = places.squares(places.light, scan.optical["sigma_z_mm"]) + places.squares(
        places.sound, sigma_of(scan.ultrasonic)
    )
    number = light + sound
    sigma_mm = np.sqrt(variance) / np.maximum(number, 1)
    provenance = scan.light.provenance | np.where(sound > 0, np.uint8(Provenance.ULTRASONIC), np.uint8(0))
    cells = Cells(scan.field, scan.light.stripes, places.pings(scan))
    height_mm = union_mm(scan.optical, scan.ultrasonic, scan.field)
    cells.mixed(height_mm, np.maximum(sigma_mm, LEAST_SIGMA_MM), provenance, number > 0)
    cells.counts(light, sound)
    return cells.finish(f"the union of the points {BLIND}")


def inverse_variance(scan: Scan) -> HybridMap:
    """Light and the nearest contact point, weighted by what they state.

    Notes
    -----
    Light behind glass is not noisy but wrong, and states a hundredth of a millimetre: no weight finds glass.
    """
    light, sound = scan.light, scan.sound
    lit, heard = np.isfinite(light.height_mm), np.isfinite(sound.height_mm)
    cells = Cells(scan.field, light.stripes, sound.ping)
    cells.light(light, lit & ~heard)
    cells.sound(sound.height_mm, sound.sigma_mm, heard & ~lit)
    cells.both(light, *weighted(light.height_mm, light.sigma_mm, sound.height_mm, sound.sigma_mm), lit & heard)
    return cells.finish(f"the mean by variance {BLIND}")


def weighted(
    one_mm: NDArray[np.float64],
    one_sigma_mm: NDArray[np.float64],
    other_mm: NDArray[np.float64],
    other_sigma_mm: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Mean of two heights by their variances, and its standard deviation."""
    share = one_sigma_mm**2 / (one_sigma_mm**2 + other_sigma_mm**2)
    return one_mm + share * (other_mm - one_mm), one_sigma_mm * np.sqrt(1 - share)


class _Places:
    """In which cell each point lies; sums over cells in whole micrometres, which no order changes."""

    def __init__(self, scan: Scan) -> None:
        self._shape = scan.field.shape
        self._size = self._shape[0] * self._shape[1]
        self.light = self._of(scan.optical, scan)
        self.sound = self._of(scan.ultrasonic, scan)

    @staticmethod
    def _of(points: Structured, scan: Scan) -> NDArray[np.int64]:
        x_mm, y_mm = (np.where(np.isfinite(points[name]), points[name], np.float32(1e9)) for name in ("x_mm", "y_mm"))
        cell = cell_index(scan.field, x_mm, y_mm)
        return np.where(np.isfinite(points["z_mm"]), cell, -1)

    def pings(self, scan: Scan) -> Witnesses:
        """Pings whose contact points lie in each cell; no table where their triggers are not known."""
        if scan.soundings is None:
            return Witnesses()
        there = self.sound >= 0
        return tabled(self.sound[there], scan.soundings[there], self._size)

    def number(self, cell: NDArray[np.int64]) -> NDArray[np.int64]:
        return np.bincount(cell[cell >= 0], minlength=self._size).reshape(self._shape)

    def squares(self, cell: NDArray[np.int64], sigma_mm: NDArray[np.floating]) -> NDArray[np.float64]:
        """Sum of the squared sigmas, mm2."""
        there: Mask = cell >= 0
        steps = np.round(sigma_mm[there].astype(np.float64) * STEPS_PER_MM)
        total = np.bincount(cell[there], weights=steps**2, minlength=self._size)
        return total.reshape(self._shape) / STEPS_PER_MM**2
