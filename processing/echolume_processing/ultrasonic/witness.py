"""The angle that the energy tells, as a second witness to the angle that the paths tell."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_processing.ultrasonic.plate_energy import GaussianFit, angle_from_energy, fit_gaussian

AGREE_SIGMAS = 3.0
AXIS = np.array([0.0, 0.0, 1.0])


@dataclass(frozen=True)
class EnergyCurve:
    """Energy over the angle of a plate, as calibrated, and how far pings scatter about it."""

    fit: GaussianFit
    relative_sigma: float


def energy_curve(angle_rad: NDArray[np.float64], energy: NDArray[np.float64]) -> EnergyCurve:
    """Fit equation 9 to pings over a plate at known angles, both (n,).

    Raises
    ------
    ValueError
        If fewer than four pings leave no scatter to be seen.
    """
    require_shape("energy", energy, angle_rad.shape)
    if len(energy) < 4:
        raise ValueError(f"energy: expected four pings at least, got {len(energy)}")
    fit = fit_gaussian(angle_rad, energy)
    expected = np.log(fit.a) - ((angle_rad - fit.b_rad) / fit.c_rad) ** 2
    scatter = np.sum((np.log(energy) - expected) ** 2) / (len(energy) - 3)
    return EnergyCurve(fit, float(np.sqrt(scatter)))


@dataclass(frozen=True)
class Witness:
    """What energy and paths say of a plate's angle off the array's axis."""

    energy_angle_rad: float
    """Its magnitude off the angle of most energy."""
    energy_sigma_rad: float
    """Largest near that angle, where the energy hardly changes."""
    path_angle_rad: float
    path_sigma_rad: float
    sigmas: float
    """Logarithm of the energy less that of what the paths' angle should return, in its standard deviations: below 0,
    the plate returned too little."""

    @property
    def agree(self) -> bool:
        """Whether the two contradict each other by less than three sigmas."""
        return abs(self.sigmas) < AGREE_SIGMAS


def energy_witness(
    energy: float,
    curve: EnergyCurve,
    normal: NDArray[np.float64],
    normal_covariance: NDArray[np.float64],
) -> Witness:
    """Compare a ping's energy with the normal that its paths gave.

    Parameters
    ----------
    energy : float
        Normalised as in the curve: to the perpendicular plate at the same distance.
    curve : EnergyCurve
    normal : (3,) float64
        Unit, towards the array, in the array's frame.
    normal_covariance : (3, 3) float64

    Raises
    ------
    ValueError
        If the energy or the curve's scatter is not positive.

    Notes
    -----
    Compared as logarithms of energy, where the sigma is the same at all angles; the angles are for people. With the
    fit's b other than 0 the sign of the angle counts, which the magnitude here does not have: the nearer one is taken.
    Energy lower than the angle explains: the plate is small, rough, absorbing, or ends within the beam; higher: another
    surface stands in it.

    References
    ----------
    The paper, equation 9.
    """
    require_shape("normal", normal, (3,))
    require_shape("normal_covariance", normal_covariance, (3, 3))
    fit, relative_sigma = curve.fit, curve.relative_sigma
    if not (energy > 0 and relative_sigma > 0):
        raise ValueError(f"energy and its relative sigma: expected above 0, got {energy} and {relative_sigma}")
    across = normal + AXIS * (1.0 if normal[2] < 0 else -1.0)
    across[2] = 0.0
    sine = float(np.linalg.norm(across))
    variance = float(np.trace(normal_covariance)) / 2
    if sine**2 > variance:
        direction = across / sine
        variance = float(direction @ normal_covariance @ direction) / (1 - sine**2)
    path_rad, path_sigma = float(np.arcsin(min(sine, 1.0))), float(np.sqrt(variance))
    off = min(abs(path_rad - fit.b_rad), abs(path_rad + fit.b_rad))
    expected = np.log(fit.a) - (off / fit.c_rad) ** 2
    # first and second order of off^2: near the best angle the first vanishes
    moved = np.hypot(2 * off * path_sigma, np.sqrt(2) * path_sigma**2) / fit.c_rad**2
    sigmas = (np.log(energy) - expected) / np.hypot(relative_sigma, moved)
    energy_rad = angle_from_energy(energy, fit)
    energy_sigma = 0.5 * relative_sigma * fit.c_rad**2 / max(energy_rad, fit.c_rad * np.sqrt(0.5 * relative_sigma))
    return Witness(energy_rad, float(energy_sigma), path_rad, path_sigma, float(sigmas))
