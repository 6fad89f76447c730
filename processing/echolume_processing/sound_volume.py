"""The delay-and-sum volume of a scan, over the field of its raster and the heights of its cloud."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from echolume_messages.errors import ConfigError
from echolume_messages.geometry import Points3, apply, invert
from echolume_processing.sound_images import Images
from echolume_processing.sound_scan import Progress, SoundScan
from echolume_processing.ultrasonic.delay_and_sum import Method, delay_and_sum, silent
from echolume_processing.ultrasonic.gated import gate_pings
from echolume_processing.ultrasonic.pipeline import MIN_PATH_MM, speed_of_sound_mps
from echolume_processing.ultrasonic.raster import spacing_mm
from echolume_processing.ultrasonic.scan_lattice import IrregularScanError, grid_over, scan_lattice
from echolume_processing.ultrasonic.voxels import Volume, VoxelGrid

BELOW_MM, ABOVE_MM = 15.0, 20.0
"""The volume reaches so far below and above the cloud."""
MOST_VOXELS = 100_000_000
"""A voxel takes 20 bytes."""
WIDEST_RAD = float(np.radians(45.0))


@dataclass(frozen=True)
class VolumeSettings:
    """How the volume is made, and how fine."""

    method: Method = "auto"
    voxel_mm: float = 2.5
    half_angle_rad: float | None = None
    """None: as wide as the pitch allows, at most `WIDEST_RAD`."""


def clean_half_angle_rad(pitch_mm: float, wavelength_mm: float) -> float:
    """Half angle up to which a pitch takes two samples of every wave that comes back: beyond it, surfaces echo twice.

    Between two poses the path to a voxel at this angle changes by a wave: sin = wavelength / (2 pitch).
    """
    return min(WIDEST_RAD, float(np.arcsin(min(1.0, wavelength_mm / (2 * pitch_mm)))))


def make_volume(scan: SoundScan, images: Images, settings: VolumeSettings, progress: Progress = silent) -> Volume:
    """Delay-and-sum volume over the scan's field, from below its cloud to above it, with coherence.

    Raises
    ------
    IrregularScanError
        If convolution was asked for and the poses follow no regular raster.
    ConfigError
        If the voxels are too many.
    """
    poses = [scan.pipeline.rig_from_array(ping.robot_pose) for ping in scan.pings]
    found = scan.pipeline.calibration
    emitter = np.array(found.emitter_mm, dtype=np.float64)
    emitters = np.array([apply(pose, emitter[None])[0] for pose in poses])
    axes = np.array([pose[:3, 2] for pose in poses])
    z = images.points["z_mm"]
    z_mm = float(z.min()) - BELOW_MM, float(z.max()) + ABOVE_MM
    grid, notes = _grid(emitters, axes, z_mm, settings)
    if np.prod(grid.shape) > MOST_VOXELS:
        raise ConfigError(
            f"--voxel {settings.voxel_mm:g}: {grid.shape[2]} x {grid.shape[1]} x {grid.shape[0]} voxels would take "
            f"{20e-9 * np.prod(grid.shape):.0f} GB; take larger ones"
        )
    half_angle_rad = settings.half_angle_rad
    if half_angle_rad is None:
        wavelength_mm = 1e3 * found.speed_of_sound_mps / (0.5 * (found.low_hz + found.high_hz))
        half_angle_rad = clean_half_angle_rad(spacing_mm(emitters), wavelength_mm)
        notes = (*notes, f"half angle {np.degrees(half_angle_rad):.0f} deg, what the pitch allows")
    heights = apply(invert(grid.rig_from_grid), emitters)[:, 2]
    spread_mm = float(np.linalg.norm(np.array(found.receivers_mm) - emitter, axis=1).max())
    shortest = max(2 * float(heights.min() - grid.z_mm[-1]), MIN_PATH_MM)
    longest = 2 * float(heights.max() - grid.z_mm[0]) / np.cos(half_angle_rad) + spread_mm
    if heights.min() <= grid.z_mm[-1] or shortest >= longest:
        raise ValueError(
            f"the array scanned at {heights.min():.0f} mm, inside the volume up to {grid.z_mm[-1]:.0f} mm; scan higher"
        )
    longest = min(longest, _record_mm(scan))
    progress("gating", 0, len(scan.pings))
    echoes = gate_pings(scan.pings, scan.pipeline, (shortest, longest))
    volume = delay_and_sum(
        echoes, grid, settings.method, half_angle_rad=half_angle_rad, coherence=True, progress=progress
    )
    return Volume(volume.grid, volume.values, volume.coherence, volume.method, (*notes, *volume.notes))


def _grid(
    emitters_mm: Points3, axes: Points3, z_mm: tuple[float, float], settings: VolumeSettings
) -> tuple[VoxelGrid, tuple[str, ...]]:
    """Voxels along the raster of the poses; along the rig's axes where there is none."""
    try:
        return grid_over(scan_lattice(emitters_mm, axes), z_mm, settings.voxel_mm), ()
    except IrregularScanError as error:
        if settings.method == "fft":
            raise
        low, high = emitters_mm.min(axis=0), emitters_mm.max(axis=0)
        step = settings.voxel_mm
        counts = [int((b - a) // step) + 1 for a, b in ((z_mm[0], z_mm[1]), (low[1], high[1]), (low[0], high[0]))]
        first = float(low[0]), float(low[1]), z_mm[0]
        grid = VoxelGrid(np.eye(4), first, (step, step, step), (counts[0], counts[1], counts[2]))
        return grid, (f"voxels along the rig's axes, because {error}",)


def _record_mm(scan: SoundScan) -> float:
    """Longest path that every ping's record holds."""
    late_s = max(scan.pipeline.calibration.delays_s)
    return min(
        1e3 * speed_of_sound_mps(scan.pipeline.calibration, p.air_temperature_c)
        * (p.start_s + p.echoes.shape[1] / p.sample_rate_hz - late_s)
        for p in scan.pings
    )  # fmt: skip


def save_volume(volume: Volume, path: Path) -> None:
    """Values (nz, ny, nx), coherence, the axes in mm, and ``rig_from_grid``, in one ``.npz``."""
    with path.open("wb") as stream:
        np.savez(
            stream,
            allow_pickle=False,
            values=volume.values,
            coherence=np.zeros(0, np.float32) if volume.coherence is None else volume.coherence,
            x_mm=volume.grid.x_mm,
            y_mm=volume.grid.y_mm,
            z_mm=volume.grid.z_mm,
            rig_from_grid=volume.grid.rig_from_grid,
        )
