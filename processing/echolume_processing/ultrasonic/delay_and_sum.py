"""Delay-and-sum: the volume that a scan's echoes come from, by convolution on a regular raster, by gathering on any."""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echolume_processing.ultrasonic.das_fft import convolve
from echolume_processing.ultrasonic.das_gather import gather
from echolume_processing.ultrasonic.gated import GatedEchoes
from echolume_processing.ultrasonic.scan_lattice import IrregularScanError
from echolume_processing.ultrasonic.voxels import Volume, VoxelGrid

Method = Literal["fft", "gather", "auto"]
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is."""


def silent(what: str, done: int, total: int) -> None:
    """Progress for nobody."""


def delay_and_sum(
    echoes: GatedEchoes,
    grid: VoxelGrid,
    method: Method = "auto",
    *,
    half_angle_rad: float | None = None,
    coherence: bool = False,
    progress: Progress = silent,
) -> Volume:
    """Sum all echoes at the path emitter -> voxel -> receiver, with the carrier's phase there.

    Parameters
    ----------
    echoes : GatedEchoes
        Of n poses and m receivers.
    grid : VoxelGrid
    method : {"auto", "fft", "gather"}
        ``fft`` convolves over the poses' raster, 20 and more times faster than ``gather``, and needs a regular raster
        whose pitch is a whole number of voxels (`grid_over` makes such a grid); ``auto`` takes it where it may, and
        notes why where it may not.
    half_angle_rad : float
        Poses that see a voxel further off the array's axis are left out.
    coherence : bool
        Also find the coherence factor abs(sum)^2 / (n sum of abs^2), over the same poses. Costs about as much again.

    Returns
    -------
    Volume
        The mean of the echoes; 0 where no pose sees a voxel.

    Raises
    ------
    IrregularScanError
        If ``fft`` was asked for and an element lies further than 1/32 of the wave from the raster.

    Notes
    -----
    The memory taken is the gated baseband's, the volume's, and one slab's (64 slices of 4096 columns, or one slice's
    kernels).
    """
    if half_angle_rad is not None and not 0 < half_angle_rad <= np.pi / 2:
        raise ValueError(f"half_angle_rad: expected above 0 and at most pi/2, got {half_angle_rad}")
    limit_rad = np.pi if half_angle_rad is None else half_angle_rad

    def tell(done: int, total: int) -> None:
        progress("delay-and-sum", done, total)

    notes: tuple[str, ...] = ()
    if method != "gather":
        try:
            found = convolve(echoes, grid, limit_rad, coherence, tell)
            return _volume(grid, *found, coherence, "fft", notes)
        except IrregularScanError as error:
            if method == "fft":
                raise
            notes = (f"gathered, because {error}",)
    return _volume(grid, *gather(echoes, grid, limit_rad, coherence, tell), coherence, "gather", notes)


def _volume(
    grid: VoxelGrid,
    total: NDArray[np.complex64],
    power: NDArray[np.float32],
    number: NDArray[np.float32],
    coherence: bool,
    method: str,
    notes: tuple[str, ...],
) -> Volume:
    count = np.maximum(number, 1)
    factor = None
    if coherence:
        floor = np.float32(1e-12) * power.max(initial=0.0) + np.finfo(np.float32).tiny
        factor = np.clip(np.abs(total) ** 2 / (count * np.maximum(power, floor)), 0, 1).astype(np.float32)
    total /= count
    return Volume(grid, total, factor, method, notes)
