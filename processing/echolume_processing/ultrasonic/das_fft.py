"""Delay-and-sum by convolution: over a regular raster of poses every slice of the volume is a sum of 2D convolutions.

For one receiver and one slice, the path from a pose to a voxel depends on their difference only. Within the paths that
occur there, every echo of the band is a combination of a few functions of the path (`EchoBasis`); for each function the
sum over all poses is the convolution of the poses' coefficients with that function, carrier included, laid out over the
differences.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_processing.ultrasonic.das_gather import Tell, least_cosine
from echolume_processing.ultrasonic.das_kernels import lay_kernel, multiply_add
from echolume_processing.ultrasonic.echo_basis import EchoBasis
from echolume_processing.ultrasonic.gated import GatedEchoes
from echolume_processing.ultrasonic.scan_lattice import Placement, place
from echolume_processing.ultrasonic.voxels import VoxelGrid

CELLS = 1 << 20
"""More columns than any raster has."""
PRIMES = (11, 13, 17, 19, 23, 29, 31, 37, 41, 43, 47)
"""Factors of a length that make its transform slow."""


@dataclass(frozen=True)
class _Differences:
    """Places of the voxels relative to the emitter of a pose, wrapped round for convolution."""

    x_mm: NDArray[np.float32]
    """(phases along x, length)."""
    y_mm: NDArray[np.float32]

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Phases along y and x, and lengths along both."""
        return len(self.y_mm), len(self.x_mm), self.y_mm.shape[1], self.x_mm.shape[1]


def convolve(
    echoes: GatedEchoes, grid: VoxelGrid, half_angle_rad: float, coherence: bool, tell: Tell
) -> tuple[NDArray[np.complex64], NDArray[np.float32], NDArray[np.float32]]:
    """Sum of the echoes at each voxel, sum of their squares (empty if not asked for), and how many there were.

    All three are (nz, ny, nx).

    Raises
    ------
    IrregularScanError
        If the poses do not lie on a lattice of the grid.
    """
    placed, min_cosine = place(echoes, grid), least_cosine(half_angle_rad)
    waves = _Convolution(echoes.iq, echoes, echoes.bandwidth, echoes.wavenumber, placed, grid, min_cosine)
    strength = None
    if coherence:
        square = (echoes.iq.real**2 + echoes.iq.imag**2).astype(np.complex64)
        strength = _Convolution(square, echoes, 2 * echoes.bandwidth, 0.0, placed, grid, min_cosine)
    nz, ny, nx = grid.shape
    values = np.empty(grid.shape, dtype=np.complex64)
    power = np.zeros((nz if coherence else 0, ny, nx), dtype=np.float32)
    number = np.full(grid.shape, echoes.iq.shape[0] * echoes.iq.shape[1], dtype=np.float32)
    for k in range(nz):
        tell(k, nz)
        values[k] = waves.slice(k)
        if strength is not None:
            power[k] = np.maximum(strength.slice(k).real, 0)
        if min_cosine > -1:
            number[k] = echoes.iq.shape[1] * waves.seen(k)
    return values, power, number


class _Convolution:
    """Sums one kind of signal over all poses and receivers, slice by slice."""

    def __init__(
        self,
        signals: NDArray[np.complex64],
        echoes: GatedEchoes,
        width: float,
        wavenumber: float,
        placed: Placement,
        grid: VoxelGrid,
        min_cosine: float,
    ) -> None:
        # Places pinged twice add up before everything else.
        cells = placed.index[:, 1] * CELLS + placed.index[:, 0]
        order = np.argsort(cells, kind="stable")
        places, starts, self._pings = np.unique(cells[order], return_index=True, return_counts=True)
        self._rows, self._columns = places // CELLS, places % CELLS
        # (receivers, samples, places)
        self._signals = np.ascontiguousarray(np.add.reduceat(signals[order], starts, axis=0).transpose(1, 2, 0))
        self._echoes = echoes
        self._placed = placed
        self._grid = grid
        self._min_cosine = min_cosine
        width_rad = 2 * np.pi * width * echoes.step_mm
        self._basis = EchoBasis(signals, echoes.first_mm, echoes.step_mm, width_rad, wavenumber)
        self._away = _differences(placed, grid)

    def slice(self, number: int) -> NDArray[np.complex64]:
        """Sum over all poses and receivers at slice `number`, (ny, nx)."""
        drop = self._grid.z_mm[number] - self._placed.first_mm[2]
        analysis, table, first = self._basis.over(*self._paths_mm(drop))
        phases_y, phases_x, length_y, length_x = shape = self._away.shape
        total = np.zeros(shape, dtype=np.complex64)
        if not len(analysis):
            return self._interleaved(total)
        kernel, coefficients = np.empty((2, len(analysis), length_y, length_x), dtype=np.complex64)
        places = np.zeros((len(analysis), length_y * length_x), dtype=np.complex64)
        words, floats = kernel.view(np.float64), table.view(np.float32)
        per_mm = self._basis.fine / self._echoes.step_mm
        start = (self._echoes.first_mm + first * self._echoes.step_mm) * per_mm
        window = slice(first, first + analysis.shape[1])
        for channel, offset in enumerate(self._placed.offsets_mm):
            places[:, self._rows * length_x + self._columns] = analysis @ self._signals[channel, window]
            _transform(places.reshape(coefficients.shape), coefficients)
            for py, px in np.ndindex(phases_y, phases_x):
                lay_kernel(
                    words, floats, self._away.x_mm[px], self._away.y_mm[py], np.float32(drop),
                    offset.astype(np.float32), np.float32(per_mm), np.float32(start),
                    self._placed.axis.astype(np.float32), np.float32(self._min_cosine),
                )  # fmt: skip
                _transform(kernel, kernel)
                multiply_add(total[py, px], kernel, coefficients)
        planes = total.reshape(phases_y * phases_x, length_y, length_x)
        _transform(planes, planes, cv2.DFT_INVERSE | cv2.DFT_SCALE)
        return self._interleaved(total)

    def seen(self, number: int) -> NDArray[np.float32]:
        """How many poses have each voxel of slice `number` within their beam, (ny, nx)."""
        drop = self._grid.z_mm[number] - self._placed.first_mm[2]
        x, y = self._away.x_mm[None, :, None, :], self._away.y_mm[:, None, :, None]
        axis = self._placed.axis
        ahead = x * axis[0] + y * axis[1] + drop * axis[2]
        within = ahead >= self._min_cosine * np.sqrt(x * x + y * y + drop * drop)
        kernel = np.ascontiguousarray(within, dtype=np.complex64)
        poses = np.zeros((1, *kernel.shape[2:]), dtype=np.complex64)
        poses[0, self._rows, self._columns] = self._pings
        planes = kernel.reshape(-1, *kernel.shape[2:])
        _transform(poses, poses)
        _transform(planes, planes)
        kernel *= poses[0]
        _transform(planes, planes, cv2.DFT_INVERSE | cv2.DFT_SCALE)
        return np.rint(self._interleaved(kernel).real)

    def _paths_mm(self, drop_mm: float) -> tuple[float, float]:
        """Paths between which all those at this height lie."""
        ends = [np.array([np.abs(v).min(), np.abs(v).max()]) for v in (self._away.x_mm, self._away.y_mm)]
        near, far = (float(r) for r in np.hypot(ends[0], ends[1]))
        aside = float(np.linalg.norm(self._placed.offsets_mm[:, :2], axis=1).max())
        up = float(np.abs(self._placed.offsets_mm[:, 2]).max())
        lean = float(np.hypot(*self._placed.axis[:2]))
        if self._min_cosine > lean:
            limit_rad = float(np.arccos(self._min_cosine) + np.arcsin(lean))
            far = min(far, abs(drop_mm) * float(np.tan(limit_rad)))
        shortest = np.hypot(near, drop_mm) + np.hypot(max(near - aside, 0.0), drop_mm) - up
        return shortest, np.hypot(far, drop_mm) + np.hypot(far + aside, drop_mm) + up

    def _interleaved(self, phases: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """The slice (ny, nx) from its phases (py, px, ly, lx)."""
        _, ny, nx = self._grid.shape
        py, px = phases.shape[:2]
        rows, columns = -(-ny // py), -(-nx // px)
        whole = phases[:, :, :rows, :columns].transpose(2, 0, 3, 1).reshape(rows * py, columns * px)
        return whole[:ny, :nx]


def _differences(placed: Placement, grid: VoxelGrid) -> _Differences:
    """Differences voxel - emitter along x and y."""
    out: list[NDArray[np.float32]] = []
    for k, voxels in ((0, grid.shape[2]), (1, grid.shape[1])):
        every, places = placed.every[k], int(placed.index[:, k].max()) + 1
        forward = -(-voxels // every)
        length = fast_length(forward + places - 1)
        number = np.arange(length)
        number = np.where(number < forward, number, number - length)
        # Lengths beyond what convolution needs repeat the last place, lest they widen the range of paths.
        number = np.clip(number, 1 - places, forward - 1)
        phase = np.arange(every)[:, None]
        at = grid.first_mm[k] + grid.step_mm[k] * (phase + every * number) - placed.first_mm[k]
        out.append(at.astype(np.float32))
    return _Differences(out[0], out[1])


def fast_length(at_least: int) -> int:
    """Next multiple of 16 without prime factors above 7: what OpenCV transforms fastest."""
    length = -(-at_least // 16) * 16
    while any(length % prime == 0 for prime in PRIMES):
        length += 16
    return length


def _transform(planes: NDArray[np.complex64], into: NDArray[np.complex64], flags: int = 0) -> None:
    """Fourier transform of each plane (n, ly, lx), which may be written over."""
    for plane, spectrum in zip(_pairs(planes), _pairs(into), strict=True):
        cv2.dft(plane, spectrum, flags=flags | cv2.DFT_COMPLEX_OUTPUT)


def _pairs(planes: NDArray[np.complex64]) -> NDArray[np.float32]:
    return planes.view(np.float32).reshape(*planes.shape, 2)
