"""What may be off in a set-up after its calibration, and what each of it does to the places of the array's elements.

Ten errors: the robot's frame off in the rig (z, rx, ry, x, y, yaw, about the rig's origin), the array tilted on its
flange (about the emitter, along the rig's axes), the speed of sound (its relative error in the middle of the scan),
and its drift (the relative change from the middle to the end).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import rotation_from_vector
from echolume_processing.hybrid.predict import Aperture

NAMES = ("z_mm", "rx_rad", "ry_rad", "x_mm", "y_mm", "yaw_rad", "array_rx_rad", "array_ry_rad", "speed", "drift")
POSE = 8
"""So many of them, the first ones, move the array."""
SPEED, DRIFT = 8, 9
SHIFTS = (3, 4, 5)
"""Those that a level bench does not show."""
UNSURE_FIRST = (5, 3, 4, 6, 7, 9, 8, 1, 2)
"""Which is given up first where the echoes cannot tell two apart. The height is never given up."""
MAY_BE_OFF = np.array([0.5, 4e-3, 4e-3, 0.5, 0.5, 4e-3, 4e-3, 4e-3, 5e-3, 0.0])
"""One sigma of what happens to a rig after its calibration: 0.5 mm, 0.23 deg, 3 K; the drift is the thermometer's."""
SHARED = np.array([0.0, 1e-4, 1e-4, 0.1, 0.1, 1e-3, 3e-4, 3e-4, 4e-4, 1e-4])
"""One sigma of what all pings share: where light puts edges, how the predictor's waveforms differ. None of the height,
which takes up every delay that is in all echoes."""
STEADY = 2e-4
"""The air may drift by so much while the thermometer stands still, 0.1 K to either side of the middle."""


@dataclass(frozen=True)
class Solution:
    """Errors of the set-up, in the order of `NAMES`.

    One that is not determined is 0, with the prior's sigma; one that is, and is no more than its sigma explains, is 0
    with its own sigma: the calibration holds.
    """

    value: NDArray[np.float64]
    sigma: NDArray[np.float64]
    determined: NDArray[np.bool_]


def displacements(elements_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """How far each element moves for a unit of each error of the pose, shape (POSE, pings, elements, 3).

    Parameters
    ----------
    elements_mm : (pings, elements, 3) float64
        Rig frame, the emitter first.
    """
    arms = elements_mm - elements_mm[:, :1]
    x, y, z = np.eye(3)
    still = np.zeros_like(elements_mm)
    return np.stack(
        [
            still + z,
            np.cross(x, elements_mm),
            np.cross(y, elements_mm),
            still + x,
            still + y,
            np.cross(z, elements_mm),
            np.cross(x, arms),
            np.cross(y, arms),
        ]
    )


def turns(value: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """What turned the array's place about the rig's origin, and all of it about its emitter, given the errors (10,)."""
    about_rig = rotation_from_vector(value[[1, 2, 5]])
    return about_rig, about_rig @ rotation_from_vector(np.array([value[6], value[7], 0.0]))


def moved(apertures: Sequence[Aperture], value: NDArray[np.float64]) -> tuple[Aperture, ...]:
    """Where the array really stood, given the errors (10,)."""
    about_rig, about_emitter = turns(value)
    out: list[Aperture] = []
    for one in apertures:
        emitter_mm = one.elements_mm[0]
        place_mm = about_rig @ emitter_mm + value[[3, 4, 0]]
        elements_mm = (one.elements_mm - emitter_mm) @ about_emitter.T + place_mm
        out.append(Aperture(np.ascontiguousarray(elements_mm), np.ascontiguousarray(about_emitter @ one.axis)))
    return tuple(out)


def prior_sigma(pose_covariance: NDArray[np.float64] | None, drift_mps: float, speed_mps: float) -> NDArray[np.float64]:
    """How far off each may be, (10,): what the calibration leaves open and what happens after it.

    Parameters
    ----------
    pose_covariance : (6, 6) float64 or None
        Of x, y, z in mm and the rotation vector in rad, rig axes; None where the calibration states none.
    drift_mps, speed_mps
        Change of the speed of sound as the thermometer tells it, from the middle of the scan to its end, and the speed.
        A slow thermometer misses up to as much again.
    """
    calibrated = np.zeros(len(NAMES))
    if pose_covariance is not None:
        spread = np.sqrt(np.diag(pose_covariance))
        calibrated[[3, 4, 0]] = spread[:3]
        calibrated[[1, 2, 5]] = spread[3:]
        calibrated[[6, 7]] = spread[3:5]
    sigma = np.hypot(calibrated, MAY_BE_OFF)
    sigma[DRIFT] = np.hypot(STEADY, drift_mps / speed_mps)
    return sigma


def faster(value: NDArray[np.float64], order: NDArray[np.float64]) -> NDArray[np.float64]:
    """By what share sound was faster than assumed, at each place in the order of the scan (-1 to 1)."""
    return value[SPEED] + value[DRIFT] * order
