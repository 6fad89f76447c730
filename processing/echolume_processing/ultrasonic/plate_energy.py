"""Energy of a plate's echo over the plate's angle, with a receiver on each side of the emitter (R-E-R).

Lengths are in mm, angles in rad. All transducers are disks of the same radius and look along the same axis.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from echolume_messages.geometry import require_shape
from echolume_processing.ultrasonic.acoustics import directivity
from echolume_processing.ultrasonic.cross_talk import CrossTalk

SIDES = (-0.5, 0.5)


@dataclass(frozen=True)
class PlateEchoes:
    """Echo of a plate at each of its angles and both receivers, (2, n)."""

    amplitudes: NDArray[np.float64]
    """Directivity both ways over path, 1/mm."""
    paths_mm: NDArray[np.float64]


def plate_echoes(
    angle_rad: NDArray[np.float64], distance_mm: float, separation_mm: float, wavenumber_radius: float
) -> PlateEchoes:
    """Amplitudes and paths of the echoes of a wide plate that turns about the emitter's foot.

    Parameters
    ----------
    angle_rad : (n,) float64
        Of the plate, 0: perpendicular to the emitter's axis.
    distance_mm : float
        Emitter to plate along the axis.
    separation_mm : float
        Between the two receivers.
    wavenumber_radius : float
        k R of all transducers.

    Notes
    -----
    Image source, directivity both ways, spherical spreading.
    """
    require_shape("angle_rad", angle_rad, (None,))
    normal = np.column_stack([-np.sin(angle_rad), np.cos(angle_rad)])  # (n, 2): along the array, along its axis
    # Plate through (0, distance): the emitter's image is 2 (n . p) n.
    image = 2 * (distance_mm * normal[:, 1])[:, None] * normal
    amplitudes, paths = np.zeros((2, len(angle_rad))), np.zeros((2, len(angle_rad)))
    for k, side in enumerate(SIDES):
        way = np.array([side * separation_mm, 0.0]) - image
        paths[k] = np.linalg.norm(way, axis=1)
        unit = way / paths[k][:, None]
        leaving = unit - 2 * np.sum(unit * normal, axis=1)[:, None] * normal
        arrive = directivity(wavenumber_radius * unit[:, 0])
        leave = directivity(wavenumber_radius * leaving[:, 0])
        forward = (leaving[:, 1] > 0) & (unit[:, 1] < 0)
        amplitudes[k] = np.where(forward, np.abs(arrive * leave) / paths[k], 0.0)
    return PlateEchoes(amplitudes, paths)


def plate_energy(
    angle_rad: NDArray[np.float64],
    distance_mm: float,
    separation_mm: float,
    wavenumber_radius: float,
    cross_talk: CrossTalk | None = None,
) -> NDArray[np.float64]:
    """Energy that both receivers get back together, (n,), normalised to 1 at its largest; `plate_echoes` says of what.

    Parameters
    ----------
    cross_talk : CrossTalk, optional
        Sound that reaches the receivers without the plate.

    References
    ----------
    The paper, section 3.2 and figure 6.
    """
    echoes = plate_echoes(angle_rad, distance_mm, separation_mm, wavenumber_radius)
    energy = echoes.amplitudes**2
    if cross_talk is not None:
        energy = cross_talk.energy(echoes.amplitudes, echoes.paths_mm, 0.5 * separation_mm)
    total = energy.sum(axis=0)
    return total / total.max()


@dataclass(frozen=True)
class GaussianFit:
    """a exp(-(angle - b)^2 / c^2); b and c in rad."""

    a: float
    b_rad: float
    c_rad: float

    def __call__(self, angle_rad: NDArray[np.float64]) -> NDArray[np.float64]:
        """The curve, any shape."""
        return self.a * np.exp(-(((angle_rad - self.b_rad) / self.c_rad) ** 2))


def fit_gaussian(angle_rad: NDArray[np.float64], energy: NDArray[np.float64]) -> GaussianFit:
    """Fit the paper's Gaussian to energy over the plate's angle, both (n,).

    References
    ----------
    The paper, equation 9.
    """
    require_shape("energy", energy, angle_rad.shape)

    def residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return p[0] * np.exp(-(((angle_rad - p[1]) / p[2]) ** 2)) - energy

    start = np.array([float(energy.max()), float(angle_rad[np.argmax(energy)]), 0.3])
    a, b, c = (float(v) for v in least_squares(residuals, start).x)
    return GaussianFit(a, b, abs(c))


def angle_from_energy(energy: float, fit: GaussianFit) -> float:
    """Magnitude of the plate's angle off its best one (rad) from its normalised energy: equation 9 turned round."""
    return fit.c_rad * float(np.sqrt(np.log(fit.a / min(energy, fit.a))))
