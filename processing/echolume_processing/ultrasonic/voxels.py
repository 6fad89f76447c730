"""Where a delay-and-sum volume lies, and what it holds."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Matrix, Points3, apply


@dataclass(frozen=True)
class VoxelGrid:
    """A box of voxels in a frame of its own; voxel (z, y, x) is centred at first + number * step along each axis."""

    rig_from_grid: Matrix
    first_mm: tuple[float, float, float]
    """Centre of the first voxel: x, y, z."""
    step_mm: tuple[float, float, float]
    shape: tuple[int, int, int]
    """Voxels along z, y and x."""

    def __post_init__(self) -> None:
        if min(self.shape) < 1 or min(self.step_mm) <= 0:
            raise ValueError(
                f"voxels: expected one or more along each axis and steps above 0 mm, got {self.shape} of {self.step_mm}"
            )

    @property
    def x_mm(self) -> NDArray[np.float64]:
        """Centres along x, (nx,)."""
        return _centres(self.first_mm[0], self.step_mm[0], self.shape[2])

    @property
    def y_mm(self) -> NDArray[np.float64]:
        """Centres along y, (ny,)."""
        return _centres(self.first_mm[1], self.step_mm[1], self.shape[1])

    @property
    def z_mm(self) -> NDArray[np.float64]:
        """Centres along z, (nz,)."""
        return _centres(self.first_mm[2], self.step_mm[2], self.shape[0])

    def corners(self) -> Points3:
        """Centres of the outermost voxels in the grid's frame, (8, 3)."""
        ends = (self.x_mm[[0, -1]], self.y_mm[[0, -1]], self.z_mm[[0, -1]])
        return np.stack(np.meshgrid(*ends, indexing="ij"), axis=-1).reshape(-1, 3)

    def in_rig(self, points_mm: Points3) -> Points3:
        """Points (n, 3) of the grid's frame in the rig frame."""
        return apply(self.rig_from_grid, points_mm)


def _centres(first_mm: float, step_mm: float, count: int) -> NDArray[np.float64]:
    return (first_mm + step_mm * np.arange(count)).astype(np.float64)


@dataclass(frozen=True)
class Volume:
    """What delay-and-sum made of the echoes."""

    grid: VoxelGrid
    values: NDArray[np.complex64]
    """Mean over all poses and receivers, carrier included, (nz, ny, nx)."""
    coherence: NDArray[np.float32] | None
    """Coherence factor, 0 to 1, (nz, ny, nx): 1 where all echoes agree in amplitude and phase."""
    method: str
    notes: tuple[str, ...] = ()

    def magnitude(self, *, weighted: bool = False) -> NDArray[np.float32]:
        """Magnitude (nz, ny, nx), times the coherence factor if asked for.

        Raises
        ------
        ValueError
            If the volume was made without coherence.
        """
        out = np.abs(self.values)
        if not weighted:
            return out
        if self.coherence is None:
            raise ValueError("this volume has no coherence factor; make it with coherence=True")
        return out * self.coherence
