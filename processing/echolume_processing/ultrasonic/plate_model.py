"""Paths and levels of echoes from the reference plate (z = 0) at poses of the array, and how paths move with receivers.

The plate mirrors the emitter: the path to receiver r_i is |r_i - E'|.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3
from echolume_processing.ultrasonic.acoustics import directivity


def plate_paths(rig_from_array: NDArray[np.float64], emitter_mm: NDArray[np.float64], receivers_mm: Points3) -> Points3:
    """Path lengths (pings, receivers) over the plate z = 0 at array poses (pings, 4, 4)."""
    emitter = rig_from_array[:, :3, :3] @ emitter_mm + rig_from_array[:, :3, 3]
    image = emitter * np.array([1.0, 1.0, -1.0])
    receivers = np.einsum("pij,rj->pri", rig_from_array[:, :3, :3], receivers_mm) + rig_from_array[:, None, :3, 3]
    return np.linalg.norm(receivers - image[:, None, :], axis=2)


@dataclass(frozen=True)
class Levels:
    """Amplitude of each ping relative to the reference plate, and over which frequencies it was taken."""

    amplitudes: NDArray[np.float64]  # (pings, receivers)
    frequency_hz: NDArray[np.float64]  # (m,)
    weights: NDArray[np.float64]  # (m,), their sum is 1
    radius_mm: float
    """Nominal."""


def plate_levels(
    rig_from_array: NDArray[np.float64],
    emitter_mm: NDArray[np.float64],
    receivers_mm: Points3,
    wavenumbers: NDArray[np.float64],
    weights: NDArray[np.float64],
    radius_mm: float,
) -> NDArray[np.float64]:
    """Directivity both ways over path, of the plate z = 0 at array poses (pings, 4, 4): (pings, receivers), 1/mm."""
    mirror = np.array([1.0, 1.0, -1.0])
    rotation = rig_from_array[:, :3, :3]
    emitter = rotation @ emitter_mm + rig_from_array[:, :3, 3]
    receivers = np.einsum("pij,rj->pri", rotation, receivers_mm) + rig_from_array[:, None, :3, 3]
    way = receivers - (emitter * mirror)[:, None, :]
    path = np.linalg.norm(way, axis=2)
    axis = rotation[:, :, 2]
    out = np.zeros(path.shape)
    cosines = [np.einsum("pri,pi->pr", w, axis) / path for w in (way, way * mirror)]
    sines = [np.sqrt(np.maximum(1 - c**2, 0.0)) for c in cosines]
    for wavenumber, weight in zip(wavenumbers.tolist(), weights.tolist(), strict=True):
        ka = wavenumber * radius_mm
        out += weight * directivity(ka * sines[0]) * directivity(ka * sines[1])
    return out / path


def near_field_mm(
    paths_mm: NDArray[np.float64], radius_mm: float, reference_mm: float, tilted: NDArray[np.float64] | float = 0.0
) -> NDArray[np.float64]:
    """How much later than over the plate at `reference_mm` of path the echo of disks comes than that of points.

    Parameters
    ----------
    paths_mm : (pings, receivers) float64
    radius_mm, reference_mm : float
    tilted : (pings, 1) float64
        What tilt adds, as a share of what an upright array has.

    Notes
    -----
    The mean way between two disks of radius R that face each other over a path L is L + R^2 / (2 L), for R much
    smaller than L: 0.06 mm at 300 mm. At the reference it belongs to the channels' delays, as in the templates.
    """
    return 0.5 * radius_mm**2 * ((1 + tilted) / paths_mm - 1 / reference_mm)


def path_slopes(
    rig_from_array: NDArray[np.float64], emitter_mm: NDArray[np.float64], receivers_mm: Points3
) -> NDArray[np.float64]:
    """Gradient of each path with its receiver's place in the array frame, (pings, receivers, 3)."""
    rotation, place = rig_from_array[:, :3, :3], rig_from_array[:, :3, 3]
    image = (rotation @ emitter_mm + place) * np.array([1.0, 1.0, -1.0])
    way = np.einsum("pij,rj->pri", rotation, receivers_mm) + (place - image)[:, None, :]
    unit = way / np.linalg.norm(way, axis=2, keepdims=True)
    return np.einsum("pri,pij->prj", unit, rotation)
