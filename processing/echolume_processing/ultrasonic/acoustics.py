"""The disk-shaped transducer: Rayleigh integral, pressure on its axis, near and far field, directivity, beam angles.

Wavenumbers are in rad/mm, lengths in mm, angles in rad. Pressures are in units of rho c U0.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import root_scalar
from scipy.special import j1, jn_zeros

from echolume_messages.geometry import Points3, require_shape

FAR_WITHIN = 0.01
"""The far field begins where the pressure on the axis has come this close to its far law k R^2 / (2 r)."""
FIRST_NODES, MOST_NODES = 32, 65_536
AGREED = 1e-12
"""Twice as many nodes change a pressure by less than this share of the largest it can have at its distance."""
CHUNK = 1 << 20


def directivity(x: NDArray[np.float64]) -> NDArray[np.float64]:
    """Far-field directivity 2 J1(x) / x of a disk, x = k R sin(angle); 1 at x = 0; any shape.

    References
    ----------
    The paper, equation 7 (printed there without the factor 2, so that its maximum is 1/2).
    """
    safe = np.where(np.abs(x) < 1e-9, 1.0, x)
    return np.where(np.abs(x) < 1e-9, 1.0, 2 * j1(safe) / safe)


def rayleigh_pressure(points_mm: Points3, wavenumber: float, radius_mm: float) -> NDArray[np.complex128]:
    """Complex pressure of a disk in a baffle by the Rayleigh integral: j k / (2 pi) times that of exp(-j k r') / r'.

    Parameters
    ----------
    points_mm : (n, 3) float64
        The disk lies in the plane z = 0, its centre at the origin; z >= 0.
    wavenumber : float
        rad/mm.
    radius_mm : float

    Returns
    -------
    (n,) complex128
        Time factor left out.

    Raises
    ------
    ValueError
        If a point lies behind the baffle, or so close to the disk's edge that 65536 nodes do not settle its pressure.

    Notes
    -----
    The integral over the disk is done by hand along the lines from the point's foot to the edge (Schoch's way). What
    is left runs around the edge; with D the squared distance from the foot to the edge and z + d = sqrt(z^2 + D),

        p = exp(-j k z) * mean over phi of (1 - exp(-j k d)) R (R - r cos phi) / D,

    which has no pole, as d vanishes with D. The integrand is periodic and analytic, so evenly spaced nodes converge
    geometrically; their number is doubled until nothing changes by more than 1e-12. 32 do from a radius away on.

    References
    ----------
    The paper, equation 5; Rayleigh, The Theory of Sound, section 278; A. Schoch, Akustische Zeitschrift 6 (1941), 318.
    """
    require_shape("points_mm", points_mm, (None, 3))
    if np.any(points_mm[:, 2] < 0):
        raise ValueError(f"points_mm: expected z >= 0, got {points_mm[:, 2].min()} mm: that is behind the baffle")
    out = np.empty(len(points_mm), dtype=np.complex128)
    open_ = np.arange(len(points_mm))
    nodes = FIRST_NODES
    coarse = _edge_mean(points_mm, wavenumber, radius_mm, nodes)
    away_mm = np.linalg.norm(points_mm, axis=1)
    largest = np.minimum(2.0, wavenumber * radius_mm**2 / np.maximum(away_mm, 1e-9))
    while open_.size:
        if nodes >= MOST_NODES:
            raise ValueError(
                f"points_mm: {open_.size} points, the first at {points_mm[open_[0]]} mm, lie too close to the edge of "
                f"the disk of {radius_mm} mm; move them {radius_mm / 500:.2g} mm away"
            )
        nodes *= 2
        fine = _edge_mean(points_mm[open_], wavenumber, radius_mm, nodes)
        settled = np.abs(fine - coarse) <= AGREED * largest[open_]
        out[open_[settled]] = fine[settled]
        open_, coarse = open_[~settled], fine[~settled]
    return out


def _edge_mean(points_mm: Points3, wavenumber: float, radius_mm: float, nodes: int) -> NDArray[np.complex128]:
    """The mean around the edge by evenly spaced nodes; symmetric, so half the edge is enough."""
    cosine = np.cos(np.pi * (np.arange(nodes) + 0.5) / nodes)
    out = np.empty(len(points_mm), dtype=np.complex128)
    rows = max(1, CHUNK // nodes)
    for first in range(0, len(points_mm), rows):
        part = slice(first, first + rows)
        z = points_mm[part, 2:]  # (rows, 1)
        r = np.hypot(points_mm[part, :1], points_mm[part, 1:2])
        square = (r - radius_mm) ** 2 + 2 * r * radius_mm * (1 - cosine)
        detour = square / (np.sqrt(z * z + square) + z)
        wave = -np.expm1(-1j * wavenumber * detour) * (radius_mm * (radius_mm - r * cosine) / square)
        out[part] = np.exp(-1j * wavenumber * z[:, 0]) * wave.mean(axis=1)
    return out


def axial_pressure(distance_mm: NDArray[np.float64], wavenumber: float, radius_mm: float) -> NDArray[np.float64]:
    """Magnitude of the pressure on the disk's axis, any shape.

    References
    ----------
    The paper, equation 6.
    """
    square = (radius_mm / distance_mm) ** 2
    root = square / (np.sqrt(1 + square) + 1)  # sqrt(1 + square) - 1 without cancellation far away
    return 2 * np.abs(np.sin(0.5 * wavenumber * distance_mm * root))


def near_field_mm(wavenumber: float, radius_mm: float) -> float:
    """Distance of the last maximum on the axis, where the near field ends: R^2 / wavelength - wavelength / 4.

    0 for a disk of less than half a wavelength: its pressure falls from its face on.

    References
    ----------
    The paper, equation 6 and what follows it.
    """
    wavelength_mm = 2 * np.pi / wavenumber
    return max(0.0, radius_mm**2 / wavelength_mm - 0.25 * wavelength_mm)


def far_field_mm(wavenumber: float, radius_mm: float) -> float:
    """Distance from which on the pressure on the axis is within 1 % of its far law k R^2 / (2 r).

    Notes
    -----
    About k R^2 for wide disks, or six near fields; there is no sharp border, hence a tolerance.
    """
    law = 0.5 * wavenumber * radius_mm**2

    def lack(distance_mm: float) -> float:
        pressure = axial_pressure(np.array([distance_mm]), wavenumber, radius_mm)
        return float(pressure[0]) * distance_mm / law - 1 + FAR_WITHIN

    low = max(near_field_mm(wavenumber, radius_mm), 1e-3 * radius_mm)
    return float(root_scalar(lack, bracket=(low, 1e3 * (radius_mm + law))).root)


def first_zero_rad(wavenumber_radius: float) -> float:
    """Angle of the directivity's first zero, where the main lobe ends; pi/2 if the lobe fills the half space."""
    return float(np.arcsin(min(1.0, float(jn_zeros(1, 1)[0]) / wavenumber_radius)))


def half_angle_rad(wavenumber_radius: float) -> float:
    """Angle off the axis at which the pressure has fallen to a half (-6 dB, one way); pi/2 if it never does."""

    def above_half(x: float) -> float:
        return float(directivity(np.array([x]))[0]) - 0.5

    x = float(root_scalar(above_half, bracket=(0.0, float(jn_zeros(1, 1)[0]))).root)
    return float(np.arcsin(min(1.0, x / wavenumber_radius)))
