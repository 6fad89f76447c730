"""Delay-and-sum by gathering: each voxel fetches its echo from each pose and receiver; for poses of any kind."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import apply, invert
from echolume_processing.ultrasonic.das_kernels import lay_poses
from echolume_processing.ultrasonic.gated import GatedEchoes
from echolume_processing.ultrasonic.voxels import VoxelGrid

Tell = Callable[[int, int], None]
"""Called with how much is done, and how much there is."""

SLAB = 64
"""Slices summed at once: the length of the innermost loop."""
TILE = 4096
"""Columns summed at once; their sums stay in the processor's cache."""
POSES = 64
"""Poses added in one call, so that progress and Ctrl-C come through."""


def gather(
    echoes: GatedEchoes, grid: VoxelGrid, half_angle_rad: float, coherence: bool, tell: Tell
) -> tuple[NDArray[np.complex64], NDArray[np.float32], NDArray[np.float32]]:
    """Sum of the echoes at each voxel, sum of their squares (empty if not asked for), and how many there were.

    All three are (nz, ny, nx).

    Notes
    -----
    The baseband is interpolated between two samples after a second-order correction of what that takes away (1/12 of
    the second difference); the carrier's phase is that of the voxel's own path.
    """
    nz, ny, nx = grid.shape
    values = np.empty(grid.shape, dtype=np.complex64)
    power = np.zeros(grid.shape if coherence else (0, ny, nx), dtype=np.float32)
    number = np.zeros(grid.shape, dtype=np.float32)
    iq = sharpened(echoes.iq).view(np.float64)
    grid_from_rig = invert(grid.rig_from_grid)
    emitters = apply(grid_from_rig, echoes.emitters_mm)
    receivers = apply(grid_from_rig, echoes.receivers_mm.reshape(-1, 3)).reshape(echoes.receivers_mm.shape)
    axes = echoes.axes @ grid.rig_from_grid[:3, :3]
    turns = echoes.wavenumber * echoes.step_mm / (2 * np.pi)
    scale = np.array([1 / echoes.step_mm, echoes.first_mm / echoes.step_mm, turns])
    weights = turn_weights()
    min_cosine = least_cosine(half_angle_rad)
    turn = np.exp(1j * echoes.wavenumber * echoes.first_mm).astype(np.complex64)
    rows = max(1, TILE // nx)
    starts = [(k, j) for k in range(0, nz, SLAB) for j in range(0, ny, rows)]
    for done, (k, j) in enumerate(starts):
        z, y = grid.z_mm[k : k + SLAB], grid.y_mm[j : j + rows]
        out = np.zeros((4, len(y), nx, len(z)), dtype=np.float32)
        for pose in range(0, len(iq), POSES):
            part = slice(pose, pose + POSES)
            lay_poses(
                out, iq[part], emitters[part], receivers[part], axes[part], grid.x_mm, y, z, scale, weights, min_cosine,
                coherence,
            )  # fmt: skip
            tell(done * len(iq) + pose, len(starts) * len(iq))
        block = slice(k, k + len(z)), slice(j, j + len(y))
        values[block] = np.moveaxis(out[0] + 1j * out[1], -1, 0) * turn
        number[block] = np.moveaxis(out[3], -1, 0)
        if coherence:
            power[block] = np.moveaxis(out[2], -1, 0)
    return values, power, number


def least_cosine(half_angle_rad: float) -> float:
    """Cosine of the angle beyond which a pose does not see a voxel; below -1 (nothing is beyond) from pi on."""
    return -2.0 if half_angle_rad >= np.pi else float(np.cos(half_angle_rad))


def sharpened(iq: NDArray[np.complex64]) -> NDArray[np.complex64]:
    """Baseband whose linear interpolation has the right level, same shape; the two outermost samples are silent."""
    out = iq.copy()
    out[..., 1:-1] -= (iq[..., 2:] - 2 * iq[..., 1:-1] + iq[..., :-2]) / np.float32(12)
    out[..., [0, -2, -1]] = 0
    return out


def turn_weights() -> NDArray[np.float32]:
    """Polynomials of a turn t from -1/2 to 1/2, (2, 6).

    cos(2 pi t) is the sum of [0, k] t^2k, sin(2 pi t) is t times the sum of [1, k] t^2k; both are good to 1e-6.
    """
    t = 0.5 * np.cos(np.pi * (np.arange(200) + 0.5) / 200)
    powers = t[:, None] ** (2 * np.arange(6))
    cosine = np.linalg.lstsq(powers, np.cos(2 * np.pi * t), rcond=None)[0]
    sine = np.linalg.lstsq(powers * t[:, None], np.sin(2 * np.pi * t), rcond=None)[0]
    return np.array([cosine, sine], dtype=np.float32)
