"""The disk-shaped transducer: Rayleigh integral, pressure on its axis, directivity, and energy over a turned plate.

Wavenumbers are in rad/mm, lengths in mm, angles in rad.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares
from scipy.special import j1

from echolume_messages.geometry import Points3, require_shape


def directivity(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Far-field directivity 2 J1(x) / x of a disk, x = k R sin(angle); 1 at x = 0; any shape.

    References
    ----------
    The paper, equation 7 (printed there without the factor 2, so that its maximum is 1/2).
    """
    safe = np.where(np.abs(x) < 1e-9, 1.0, x)
    return np.where(np.abs(x) < 1e-9, 1.0, 2 * j1(safe) / safe)


def rayleigh_pressure(
    points_mm: Points3, wavenumber: float, radius_mm: float, rings: int = 96, spokes: int = 192
) -> NDArray[np.complex128]:
    """Complex pressure of a disk in a baffle, in units of rho c U0, by the Rayleigh integral.

    Parameters
    ----------
    points_mm : (n, 3) float64
        The disk lies in the plane z = 0, its centre at the origin.
    wavenumber : float
        rad/mm.
    radius_mm : float
    rings, spokes : int
        Gauss-Legendre nodes along the radius (in its square) and evenly spaced ones around.

    Returns
    -------
    (n,) complex128
        j k / (2 pi) times the integral of exp(-j k r') / r' over the disk, time factor left out.

    References
    ----------
    The paper, equation 5; Rayleigh, The Theory of Sound, section 278.
    """
    require_shape("points_mm", points_mm, (None, 3))
    nodes, weights = np.polynomial.legendre.leggauss(rings)
    radii = radius_mm * np.sqrt(0.5 * (nodes + 1))
    angles = 2 * np.pi * (np.arange(spokes) + 0.5) / spokes
    x = (radii[:, None] * np.cos(angles)).ravel()
    y = (radii[:, None] * np.sin(angles)).ravel()
    area = np.repeat(0.25 * radius_mm**2 * weights, spokes) * (2 * np.pi / spokes)
    out = np.empty(len(points_mm), dtype=np.complex128)
    for k, (px, py, pz) in enumerate(points_mm):
        distance = np.sqrt((px - x) ** 2 + (py - y) ** 2 + pz**2)
        out[k] = np.sum(np.exp(-1j * wavenumber * distance) / distance * area)
    return 1j * wavenumber / (2 * np.pi) * out


def axial_pressure(distance_mm: NDArray[np.float64], wavenumber: float, radius_mm: float) -> NDArray[np.float64]:
    """Magnitude of the pressure on the disk's axis, in units of rho c U0, any shape.

    References
    ----------
    The paper, equation 6.
    """
    root = np.sqrt(1 + (radius_mm / distance_mm) ** 2) - 1
    return 2 * np.abs(np.sin(0.5 * wavenumber * distance_mm * root))


def near_field_mm(wavenumber: float, radius_mm: float) -> float:
    """Distance of the last maximum on the axis, where the far field begins: R^2 / wavelength - wavelength / 4."""
    wavelength_mm = 2 * np.pi / wavenumber
    return radius_mm**2 / wavelength_mm - 0.25 * wavelength_mm


def plate_energy(
    angle_rad: NDArray[np.float64], distance_mm: float, separation_mm: float, wavenumber_radius: float
) -> NDArray[np.float64]:
    """Energy that two receivers beside an emitter (R-E-R) get back from a wide plate turned about the emitter's foot.

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

    Returns
    -------
    (n,) float64
        Normalised to 1 at its largest.

    Notes
    -----
    Image source, directivity both ways, spherical spreading, squared.

    References
    ----------
    The paper, section 3.2 and figure 6.
    """
    require_shape("angle_rad", angle_rad, (None,))
    normal = np.column_stack([-np.sin(angle_rad), np.cos(angle_rad)])  # (n, 2): along the array, along its axis
    # Plate through (0, distance): the emitter's image is 2 (n . p) n.
    image = 2 * (distance_mm * normal[:, 1])[:, None] * normal
    total = np.zeros(len(angle_rad))
    for side in (-0.5, 0.5):
        way = np.array([side * separation_mm, 0.0]) - image
        path = np.linalg.norm(way, axis=1)
        unit = way / path[:, None]
        leaving = unit - 2 * np.sum(unit * normal, axis=1)[:, None] * normal
        arrive = directivity(wavenumber_radius * unit[:, 0])
        leave = directivity(wavenumber_radius * leaving[:, 0])
        forward = (leaving[:, 1] > 0) & (unit[:, 1] < 0)
        total += np.where(forward, (arrive * leave / path) ** 2, 0.0)
    return total / total.max()


@dataclass(frozen=True)
class GaussianFit:
    """a exp(-(angle - b)^2 / c^2); b and c in rad."""

    a: float
    b_rad: float
    c_rad: float


def fit_gaussian(angle_rad: NDArray[np.float64], energy: NDArray[np.float64]) -> GaussianFit:
    """Fit the paper's Gaussian to energy over the plate's angle, both (n,).

    References
    ----------
    The paper, equation 9.
    """
    require_shape("energy", energy, angle_rad.shape)

    def residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return p[0] * np.exp(-((angle_rad - p[1]) ** 2) / p[2] ** 2) - energy

    start = np.array([float(energy.max()), float(angle_rad[np.argmax(energy)]), 0.3])
    a, b, c = (float(v) for v in least_squares(residuals, start).x)
    return GaussianFit(a, b, abs(c))


def angle_from_energy(energy: float, fit: GaussianFit) -> float:
    """Magnitude of the plate's angle off its best one (rad) from its normalised energy: equation 9 turned round."""
    return fit.c_rad * float(np.sqrt(np.log(fit.a / min(energy, fit.a))))


TABLE_I: tuple[tuple[float, float, float, float, float], ...] = (
    (200.0, 30.0, 1.00, 0.56, 21.2),
    (200.0, 100.0, 1.02, 2.18, 18.7),
    (200.0, 150.0, 0.95, 0.39, 18.27),
    (400.0, 30.0, 0.99, -2.11, 17.81),
    (400.0, 100.0, 0.97, -1.86, 18.02),
    (400.0, 150.0, 0.99, -2.13, 18.03),
    (600.0, 30.0, 0.97, 3.74, 17.84),
    (600.0, 100.0, 0.98, 2.54, 18.15),
    (600.0, 150.0, 0.96, 3.22, 17.61),
    (800.0, 30.0, 0.98, 5.05, 17.96),
    (800.0, 100.0, 0.97, 3.61, 19.5),
    (800.0, 150.0, 0.95, 2.28, 18.6),
)
"""The paper's Table I: distance_mm, separation_mm, a, b in deg, c in deg."""


def table_widths_deg(wavenumber_radius: float) -> NDArray[np.float64]:
    """Widths c (deg) of Table I's twelve rows as one physical k R predicts them, (12,)."""
    angle_rad = np.radians(np.linspace(-45, 45, 91))
    fits = [fit_gaussian(angle_rad, plate_energy(angle_rad, row[0], row[1], wavenumber_radius)) for row in TABLE_I]
    return np.degrees(np.array([fit.c_rad for fit in fits]))


def fit_table() -> tuple[float, float]:
    """The k R that reproduces Table I best, and the RMS (deg) of its c over the twelve rows."""
    measured = np.array([row[4] for row in TABLE_I])

    def rms(wavenumber_radius: float) -> float:
        return float(np.sqrt(np.mean((table_widths_deg(wavenumber_radius) - measured) ** 2)))

    low, high = 3.0, 7.0
    for _ in range(24):
        third = (high - low) / 3
        if rms(low + third) < rms(high - third):
            high -= third
        else:
            low += third
    middle = 0.5 * (low + high)
    return middle, rms(middle)
