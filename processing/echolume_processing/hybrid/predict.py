"""Which echoes a surface would return: a Kirchhoff facet predictor in the array's band."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.special import j1

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.geometry import apply, robot_from_flange
from echolume_processing.hybrid.kernels import ANGLES, lay_facets, lay_walls
from echolume_processing.hybrid.scipy_typed import rfft
from echolume_processing.hybrid.surface import Surface

NODES = 4
"""Frequencies at which directivity is tabulated; between them it is interpolated."""
OVERSAMPLING = 4
REACH_MM = 100.0
"""Facets further than this from the foot of the array's axis are left out."""


@dataclass(frozen=True)
class Aperture:
    """Where the array stood: emitter first, then the receivers, shape (1 + n, 3), and its axis, rig frame."""

    elements_mm: NDArray[np.float64]
    axis: NDArray[np.float64]


def aperture(calibration: ArrayCalibration, robot_pose: NDArray[np.float64]) -> Aperture:
    """The calibrated array at a pose of the robot (6,)."""
    rig_from_array = calibration.robot_pose @ robot_from_flange(robot_pose) @ calibration.array_pose
    elements = np.array([calibration.emitter_mm, *calibration.receivers_mm], dtype=np.float64)
    return Aperture(np.ascontiguousarray(apply(rig_from_array, elements)), np.ascontiguousarray(rig_from_array[:3, 2]))


@dataclass(frozen=True)
class Band:
    """The frequencies in which echoes are compared: bins of an FFT of `length` samples."""

    sample_rate_hz: float
    length: int
    low_hz: float
    high_hz: float

    @cached_property
    def bins(self) -> NDArray[np.int64]:
        """Indices of the band's bins in ``rfft``."""
        step_hz = self.sample_rate_hz / self.length
        return np.arange(int(np.ceil(self.low_hz / step_hz)), int(np.floor(self.high_hz / step_hz)) + 1)

    @cached_property
    def frequency_hz(self) -> NDArray[np.float64]:
        """Frequency of each bin of the band."""
        return np.asarray(self.bins * (self.sample_rate_hz / self.length), dtype=np.float64)

    @cached_property
    def nodes_hz(self) -> NDArray[np.float64]:
        """Chebyshev nodes of the band."""
        k = np.arange(NODES)
        middle, half = 0.5 * (self.low_hz + self.high_hz), 0.5 * (self.high_hz - self.low_hz)
        return np.asarray(middle - half * np.cos(np.pi * (k + 0.5) / NODES), dtype=np.float64)

    @cached_property
    def weights(self) -> NDArray[np.float64]:
        """Lagrange weights of each node at each bin, shape (nodes, bins)."""
        nodes = self.nodes_hz
        out = np.ones((NODES, self.bins.size))
        for m in range(NODES):
            for n in range(NODES):
                if n != m:
                    out[m] *= (self.frequency_hz - nodes[n]) / (nodes[m] - nodes[n])
        return out


def directivity(radius_mm: float, frequency_hz: NDArray[np.float64], speed_mps: float) -> NDArray[np.float32]:
    """Piston directivity 2 J1(x) / x over sin^2 of the angle, shape (ANGLES, frequencies); the paper's eq. 7."""
    sine = np.sqrt(np.linspace(0.0, 1.0, ANGLES))
    x = 2 * np.pi * frequency_hz[None, :] / (speed_mps * 1e3) * radius_mm * sine[:, None]
    safe = np.where(x > 1e-9, x, 1.0)
    return np.where(x > 1e-9, 2 * j1(safe) / safe, 1.0).astype(np.float32)


class Predictor:
    """Predicts the band spectra of a ping, for elements that emit and receive a perfect impulse.

    Notes
    -----
    Single scattering with shadow, and the double bounce between each wall and the floor at its foot. Not in it:
    edge diffraction beyond Kirchhoff's, bounces between two objects, roughness. It fails under overhangs, which a
    heightfield cannot hold.
    """

    def __init__(self, radius_mm: float, speed_mps: float, band: Band) -> None:
        self.radius_mm = radius_mm
        self._band = band
        self._speed_mm_per_s = speed_mps * 1e3
        self._table = directivity(radius_mm, band.nodes_hz, speed_mps)
        self._rate_hz = band.sample_rate_hz * OVERSAMPLING
        wave = 2j * np.pi * band.frequency_hz / self._speed_mm_per_s
        # two-point laying acts as a triangular smoothing in time
        smoothing = np.sinc(band.frequency_hz / self._rate_hz) ** 2
        self._factor = (band.weights * (wave / smoothing)).astype(np.complex64)  # (nodes, bins)

    def spectra(self, scene: Surface, where: Aperture) -> NDArray[np.complex64]:
        """Band spectra (receivers, bins) of a ping over a surface; time zero is the emission."""
        laid = np.zeros((where.elements_mm.shape[0] - 1, NODES, self._band.length * OVERSAMPLING), dtype=np.float32)
        bins_per_mm = self._rate_hz / self._speed_mm_per_s
        field = scene.field
        lay_facets(
            laid, scene.height_mm, scene.slope, scene.horizon, field.x_mm[0], field.y_mm[0], field.cell_mm,
            where.elements_mm, where.axis, self._table, bins_per_mm, 0.0, REACH_MM,
        )  # fmt: skip
        lay_walls(
            laid, scene.walls, field.cell_mm, where.elements_mm, where.axis, self._table, bins_per_mm, 0.0, REACH_MM
        )
        return self._to_band(laid)

    def _to_band(self, laid: NDArray[np.float32]) -> NDArray[np.complex64]:
        """Sum over the nodes of each histogram's spectrum, weighted: (receivers, bins)."""
        spectrum = rfft(laid)[..., self._band.bins]
        return np.einsum("cmf,mf->cf", spectrum, self._factor)
