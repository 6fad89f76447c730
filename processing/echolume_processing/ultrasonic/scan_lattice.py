"""The regular grid that a robot's raster follows, and how far the poses are from it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from echolume_messages.geometry import Matrix, Points3, apply, invert, require_shape, transform
from echolume_processing.ultrasonic.gated import GatedEchoes
from echolume_processing.ultrasonic.voxels import VoxelGrid

SAME_MM = 0.5
"""Poses closer than this are the same place, pinged twice."""
TOLERANCE = 1 / 32
"""Of the carrier's wavelength: no element may lie further from its place on the grid (a path then errs by at most a
sixteenth of a wave)."""


class IrregularScanError(ValueError):
    """The poses follow no regular grid closely enough for convolution; the message says by how much."""


@dataclass(frozen=True)
class ScanLattice:
    """Places of a raster: lattice (0, 0) at `first_mm`, then every `pitch_mm`, in the plane of the scan.

    The lattice's frame is the rig frame turned about the middle of the scan into its rows and columns, so that its
    coordinates are those of the rig but for the robot's small tilt and yaw.
    """

    rig_from_lattice: Matrix
    first_mm: NDArray[np.float64]
    pitch_mm: tuple[float, float]
    """From column to column (x) and from row to row (y)."""
    index: NDArray[np.int64]
    """Column and row of each pose, (poses, 2)."""

    @property
    def columns(self) -> int:
        """Along x."""
        return int(self.index[:, 0].max()) + 1

    @property
    def rows(self) -> int:
        """Along y."""
        return int(self.index[:, 1].max()) + 1


def scan_lattice(emitters_mm: Points3, axes: Points3) -> ScanLattice:
    """Find rows, columns and pitch of a raster from its emitters' places.

    Parameters
    ----------
    emitters_mm : (poses, 3) float64
        Rig frame, any order; places may be missing or repeated.
    axes : (poses, 3) float64
        Where the array looks.

    Raises
    ------
    IrregularScanError
        If there are fewer than two rows or two columns.
    """
    require_shape("emitters_mm", emitters_mm, (None, 3))
    middle = 0.5 * (emitters_mm.min(axis=0) + emitters_mm.max(axis=0))
    rotation = _turned_into_rows(emitters_mm, axes)
    local = (emitters_mm - middle) @ rotation + middle
    numbers = [_numbers(local[:, k]) for k in (0, 1)]
    if min(int(n.max()) for n in numbers) < 1:
        raise IrregularScanError(
            f"the scan has {int(numbers[0].max()) + 1} columns and {int(numbers[1].max()) + 1} rows; delay-and-sum by "
            "FFT needs two of each at least: use the gather (`--method gather`)"
        )
    index = np.stack(numbers, axis=1)
    pitch = [float(np.polyfit(index[:, k], local[:, k], 1)[0]) for k in (0, 1)]
    first = np.array([*(np.mean(local[:, k] - pitch[k] * index[:, k]) for k in (0, 1)), local[:, 2].mean()])
    return ScanLattice(transform(rotation, middle - rotation @ middle), first, (pitch[0], pitch[1]), index)


def _turned_into_rows(emitters_mm: Points3, axes: Points3) -> Matrix:
    """Columns: along the rows (near the rig's x), across them, and up from the scene, in the rig frame."""
    away = emitters_mm - emitters_mm.mean(axis=0)
    up = -axes.mean(axis=0)
    if np.linalg.matrix_rank(away, tol=SAME_MM) >= 2:
        normal = np.linalg.svd(away, full_matrices=False)[2][2]
        up = normal * (1.0 if normal @ up > 0 else -1.0)
    up = up / np.linalg.norm(up)
    east = np.array([1.0, 0.0, 0.0]) - up[0] * up
    east /= np.linalg.norm(east)
    north = np.cross(up, east)
    flat = np.stack([away @ east, away @ north], axis=1)
    near = KDTree(flat).query_pairs(1.5 * _spacing(flat), output_type="ndarray").reshape(-1, 2)
    way = flat[near[:, 1]] - flat[near[:, 0]]
    way = way[np.linalg.norm(way, axis=1) > SAME_MM]
    # Neighbours lie along rows or along columns: the fourth power of their direction is the same for all four.
    turn_rad = (
        0.25 * float(np.angle(np.mean(((way[:, 0] + 1j * way[:, 1]) / np.hypot(*way.T)) ** 4))) if way.size else 0.0
    )
    for _ in range(2):
        along = np.cos(turn_rad) * east + np.sin(turn_rad) * north
        across = np.cross(up, along)
        turn_rad += _remaining_turn(away @ along, away @ across)
    along = np.cos(turn_rad) * east + np.sin(turn_rad) * north
    return np.stack([along, np.cross(up, along), up], axis=1)


def _spacing(flat_mm: NDArray[np.float64]) -> float:
    """Distance from place to place, repeated ones left out."""
    places = np.unique(np.rint(flat_mm / SAME_MM), axis=0) * SAME_MM
    if len(places) < 2:
        raise IrregularScanError("the scan has a single place; delay-and-sum needs poses around the scene")
    return float(np.median(np.asarray(KDTree(places).query(places, k=2)[0])[:, 1]))


def _remaining_turn(x_mm: NDArray[np.float64], y_mm: NDArray[np.float64]) -> float:
    """Angle by which rows and columns still lean, rad."""
    return 0.5 * (_slope(x_mm, y_mm) - _slope(y_mm, x_mm))


def _slope(along_mm: NDArray[np.float64], across_mm: NDArray[np.float64]) -> float:
    """How much rows climb across, mean of all rows."""
    if np.ptp(along_mm) < SAME_MM:
        return 0.0
    return float(np.polyfit(along_mm - along_mm.mean(), across_mm - _row_means(across_mm), 1)[0])


def _row_means(values_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean of the row that each value belongs to."""
    numbers = _numbers(values_mm)
    return (np.bincount(numbers, values_mm) / np.maximum(np.bincount(numbers), 1))[numbers]


def _numbers(values_mm: NDArray[np.float64]) -> NDArray[np.int64]:
    """Number of the row of each value; rows left out keep their number."""
    order = np.argsort(values_mm)
    gaps = np.diff(values_mm[order])
    wide = gaps > SAME_MM
    if not wide.any():
        return np.zeros(len(values_mm), dtype=np.int64)
    pitch_mm = float(np.median(gaps[wide]))
    steps = np.where(wide, np.maximum(np.rint(gaps / pitch_mm), 1), 0)
    out = np.zeros(len(values_mm), dtype=np.int64)
    out[order[1:]] = np.cumsum(steps)
    return out


@dataclass(frozen=True)
class Placement:
    """A scan on the lattice of a voxel grid: everything that convolution needs, in the grid's frame."""

    index: NDArray[np.int64]
    """Column and row of each pose, (poses, 2)."""
    first_mm: NDArray[np.float64]
    """Emitter at column 0, row 0, (3,)."""
    offsets_mm: Points3
    """Receivers relative to the emitter, (receivers, 3)."""
    axis: NDArray[np.float64]
    every: tuple[int, int]
    """Voxels from column to column and from row to row."""


def place(echoes: GatedEchoes, grid: VoxelGrid) -> Placement:
    """Put a scan on the lattice of a voxel grid.

    Raises
    ------
    IrregularScanError
        If an element lies further from its place than `TOLERANCE` of the carrier's wavelength, whatever the reason:
        poses off the raster, a turned array, a grid not along the rows, steps that do not divide the pitch.
    """
    lattice = scan_lattice(echoes.emitters_mm, echoes.axes)
    every = tuple(max(1, round(pitch / step)) for pitch, step in zip(lattice.pitch_mm, grid.step_mm, strict=False))
    grid_from_rig = invert(grid.rig_from_grid)
    emitters = apply(grid_from_rig, echoes.emitters_mm)
    receivers = apply(grid_from_rig, echoes.receivers_mm.reshape(-1, 3)).reshape(echoes.receivers_mm.shape)
    pitch = np.array([every[0] * grid.step_mm[0], every[1] * grid.step_mm[1], 0.0])
    steps = np.pad(lattice.index, ((0, 0), (0, 1))) * pitch
    first = (emitters - steps).mean(axis=0)
    offsets = (receivers - emitters[:, None]).mean(axis=0)
    off_mm = np.linalg.norm(emitters - steps - first, axis=1).max()
    off_mm = max(off_mm, np.linalg.norm(receivers - steps[:, None] - first - offsets, axis=2).max())
    allowed_mm = TOLERANCE * echoes.wavelength_mm
    if off_mm > allowed_mm:
        raise IrregularScanError(
            f"an element of the array lies {off_mm:.2f} mm from its place on a regular grid of "
            f"{pitch[0]:.3f} x {pitch[1]:.3f} mm; delay-and-sum by FFT allows {allowed_mm:.2f} mm (1/32 of the wave): "
            "use the gather (`--method gather`)"
        )
    axis = (echoes.axes @ grid.rig_from_grid[:3, :3]).mean(axis=0)
    return Placement(lattice.index, first, offsets, axis / np.linalg.norm(axis), (every[0], every[1]))


def grid_over(lattice: ScanLattice, z_mm: tuple[float, float], voxel_mm: float, margin_mm: float = 0.0) -> VoxelGrid:
    """Voxels over the field of a scan, fit for convolution: an even part of the pitch wide, at most `voxel_mm`.

    Parameters
    ----------
    lattice : ScanLattice
    z_mm : (low, high)
        In the lattice's frame, which is the rig's but for the robot's tilt.
    voxel_mm : float
        Widest voxel allowed; along z it is taken as it is.
    margin_mm : float
        Beyond the outermost poses.
    """
    if not (voxel_mm > 0 and z_mm[0] < z_mm[1]):
        raise ValueError(f"volume: expected z from low to high and a voxel above 0 mm, got {z_mm} and {voxel_mm}")
    step = [pitch / int(np.ceil(pitch / voxel_mm - 1e-9)) for pitch in lattice.pitch_mm]
    count = [
        round((n - 1) * pitch / s) + 2 * int(margin_mm // s) + 1
        for n, pitch, s in zip((lattice.columns, lattice.rows), lattice.pitch_mm, step, strict=True)
    ]
    first = [float(lattice.first_mm[k]) - int(margin_mm // step[k]) * step[k] for k in (0, 1)]
    depth = int(np.floor((z_mm[1] - z_mm[0]) / voxel_mm + 1e-9)) + 1
    return VoxelGrid(
        lattice.rig_from_lattice,
        (first[0], first[1], z_mm[0]),
        (step[0], step[1], voxel_mm),
        (depth, count[1], count[0]),
    )
