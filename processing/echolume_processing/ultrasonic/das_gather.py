"""Delay-and-sum by gathering: each voxel fetches its echo from each pose and receiver; for poses of any kind."""

from __future__ import annotations

import math
from collections.abc import Callable

import numba
import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import apply, invert
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
    echoes: GatedEchoes, grid: VoxelGrid, min_cosine: float, coherence: bool, tell: Tell
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


@numba.njit(cache=True, fastmath=True, nogil=True)
def lay_poses(
    out: NDArray[np.float32],
    iq: NDArray[np.float64],
    emitters: NDArray[np.float64],
    receivers: NDArray[np.float64],
    axes: NDArray[np.float64],
    x: NDArray[np.float64],
    y: NDArray[np.float64],
    z: NDArray[np.float64],
    scale: NDArray[np.float64],
    weights: NDArray[np.float32],
    min_cosine: float,
    with_power: bool,
) -> None:
    """Add some poses to real part, imaginary part, power and number of echoes of columns of voxels, all in mm.

    `out` is (4, ny, nx, nz). A sample is read as one 64-bit word (`iq` views complex64 as float64), and reading is a
    loop of its own: compilers then keep the arithmetic before and after it in vector registers.
    """
    poses, channels, samples = iq.shape
    depth = z.size
    leg, part, turn = np.empty(depth, np.float32), np.empty(depth, np.float32), np.empty(depth, np.float32)
    heights = z.astype(np.float32)
    at = np.empty(depth, np.int32)
    words = np.empty((2, depth), np.float64)
    low_word, high_word = words[0], words[1]
    floats = words.view(np.float32)
    low, high = floats[0], floats[1]
    per_mm, first, turns = np.float32(scale[0]), np.float32(scale[1]), np.float32(scale[2])
    top, nought, half = np.float32(samples - 2), np.float32(0), np.float32(0.5)
    c0, c1, c2, c3, c4, c5 = weights[0]
    s0, s1, s2, s3, s4, s5 = weights[1]
    limited = min_cosine > -1
    for p in range(poses):
        for iy in range(y.size):
            for ix in range(x.size):
                dx, dy = x[ix] - emitters[p, 0], y[iy] - emitters[p, 1]
                rho, up = np.float32(dx * dx + dy * dy), np.float32(emitters[p, 2])
                for k in range(depth):
                    dz = heights[k] - up
                    leg[k] = math.sqrt(rho + dz * dz) * per_mm - first
                if limited:
                    side, ahead = np.float32(dx * axes[p, 0] + dy * axes[p, 1]), np.float32(axes[p, 2])
                    least = np.float32(min_cosine) / per_mm
                    count = out[3, iy, ix]
                    for k in range(depth):
                        seen = side + (heights[k] - up) * ahead >= least * (leg[k] + first)
                        count[k] += np.float32(channels) if seen else nought
                        leg[k] = leg[k] if seen else np.float32(-1e6)
                real, imaginary, power = out[0, iy, ix], out[1, iy, ix], out[2, iy, ix]
                for c in range(channels):
                    dx, dy = x[ix] - receivers[p, c, 0], y[iy] - receivers[p, c, 1]
                    rho, up = np.float32(dx * dx + dy * dy), np.float32(receivers[p, c, 2])
                    for k in range(depth):
                        dz = heights[k] - up
                        u = leg[k] + math.sqrt(rho + dz * dz) * per_mm
                        u = min(max(u, nought), top)
                        j = np.int32(u)
                        at[k] = j
                        part[k] = u - np.float32(j)
                        u *= turns
                        turn[k] = u - math.floor(u + half)
                    row = iq[p, c]
                    for k in range(depth):
                        n = np.uint32(at[k])
                        low_word[k] = row[n]
                        high_word[k] = row[n + np.uint32(1)]
                    for k in range(depth):
                        f, t = part[k], turn[k]
                        h = t * t
                        cosine = c0 + h * (c1 + h * (c2 + h * (c3 + h * (c4 + h * c5))))
                        sine = t * (s0 + h * (s1 + h * (s2 + h * (s3 + h * (s4 + h * s5)))))
                        a, b = low[2 * k], low[2 * k + 1]
                        a += f * (high[2 * k] - a)
                        b += f * (high[2 * k + 1] - b)
                        real[k] += a * cosine - b * sine
                        imaginary[k] += a * sine + b * cosine
                    if with_power:
                        for k in range(depth):
                            f = part[k]
                            a = low[2 * k] + f * (high[2 * k] - low[2 * k])
                            b = low[2 * k + 1] + f * (high[2 * k + 1] - low[2 * k + 1])
                            power[k] += a * a + b * b
    if not limited:
        out[3] += np.float32(poses * channels)
