"""What the emulated ultrasonic array really is; only the emulator, tests and scoring know it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, robot_from_flange, rotation_from_euler, rotation_from_vector, transform
from echolume_messages.rig import ArraySettings

OFFSET_SIGMA_MM = 0.7
"""Mounting error per axis of the robot on the rig and of the array on the flange."""
OFFSET_SIGMA_RAD = float(np.radians(0.3))
PLACEMENT_SIGMA_MM = (0.1, 0.1, 0.05)
"""How far a receiver sits from its drawing, per axis of the array frame."""


@dataclass(frozen=True)
class ArrayTruth:
    """The array as it is, with the spread of its parts; n is the number of receivers."""

    seed: int
    delays_s: NDArray[np.float64]
    """Electrical and electro-acoustic delay of each channel (n,)."""
    gains: NDArray[np.float64]
    """Sensitivity of each channel relative to the nominal one (n,)."""
    radius_mm: float
    """Effective piston radius of every element."""
    centre_shift: NDArray[np.float64]
    """Relative shift of each channel's band or resonance (n,)."""
    quality: NDArray[np.float64]
    """Quality factor of each narrow-band receiver (n,)."""
    ripple: NDArray[np.complex128]
    """Strength of a weak resonance in each channel's band (n,)."""
    cross_talk: NDArray[np.float64]
    """Direct sound at each receiver, relative to a plate's echo at 150 mm (n,)."""
    flange_from_array: Matrix
    rig_from_robot: Matrix
    placement_mm: NDArray[np.float64]
    """How far each receiver sits from its drawing, seen from the emitter (n, 3). The array frame is laid so that they
    have no turn in common."""
    thermometer_error_k: float
    """What the array's thermometer reads above the air on the sound's way."""
    pose_sigma_mm: float = 0.02
    """Repeatability of the robot per axis, unknown to its encoders."""
    timing_sigma_s: float = 5e-8
    """Jitter of each channel's time of flight from moving air."""
    air_sigma: float = 5e-5
    """Relative jitter of the speed of sound from ping to ping."""
    amplitude_sigma: float = 0.01
    """Relative jitter of a ping's level."""
    snr_db: float = 45.0
    """Peak over rms after the matched filter, of a perpendicular plate at 150 mm."""

    def rig_from_array(self, pose: NDArray[np.float64]) -> Matrix:
        """True pose of the array at robot axes `pose` (6,), mm and rad."""
        return self.rig_from_robot @ robot_from_flange(pose) @ self.flange_from_array


def _offset(rng: np.random.Generator) -> Matrix:
    return transform(rotation_from_vector(rng.normal(0, OFFSET_SIGMA_RAD, 3)), rng.normal(0, OFFSET_SIGMA_MM, 3))


def _placement(seed: int, array: ArraySettings) -> NDArray[np.float64]:
    """Scatter of the receivers around their drawing, from its own generator, less the turn that they share."""
    arms = np.array(array.layout.receivers_mm, dtype=np.float64) - np.array(array.layout.emitter_mm)
    scatter = np.random.default_rng([seed, 0x91ACE]).normal(0, PLACEMENT_SIGMA_MM, arms.shape)
    turns = np.cross(np.eye(3)[:, None, :], arms).reshape(3, -1).T  # (3 n, 3): displacement by a turn about each axis
    flat = scatter.ravel()
    return (flat - turns @ np.linalg.lstsq(turns, flat, rcond=None)[0]).reshape(arms.shape)


def array_truth(seed: int, array: ArraySettings) -> ArrayTruth:
    """Draw an array from a seed: delays 20 to 60 us, gains +-15 %, radius +-2 %, receivers off by 0.1 mm, mounting
    about 1 mm and 0.5 deg."""
    rng = np.random.default_rng([seed, 0xA88A])
    n = len(array.layout.receivers_mm)
    x, y, z, *angles_deg = array.nominal_flange_from_array_mm_deg
    nominal = transform(rotation_from_euler(*(float(np.radians(a)) for a in angles_deg)), np.array([x, y, z], float))
    return ArrayTruth(
        seed=seed,
        delays_s=rng.uniform(20e-6, 60e-6, n),
        gains=rng.uniform(0.85, 1.15, n),
        radius_mm=array.layout.radius_mm * rng.uniform(0.98, 1.02),
        centre_shift=rng.uniform(-0.01, 0.01, n),
        quality=20 * rng.uniform(0.95, 1.05, n),
        ripple=0.08 * (rng.normal(size=n) + 1j * rng.normal(size=n)),
        cross_talk=0.25 * rng.uniform(0.7, 1.3, n),
        flange_from_array=nominal @ _offset(rng),
        rig_from_robot=_offset(rng),
        placement_mm=_placement(seed, array),
        thermometer_error_k=0.3 * float(rng.choice([-1.0, 1.0])) * rng.uniform(0.8, 1.2),
    )
