"""From the archive of a scan to the images of sound alone: cloud, gray levels, edges, and the delay-and-sum volume."""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict

import numpy as np

from echolume_messages.errors import ArchiveError, ConfigError
from echolume_messages.files import make_folder
from echolume_processing import image_figures
from echolume_processing.sound_images import MapSettings, make_images
from echolume_processing.sound_scan import Progress, read_sound
from echolume_processing.sound_volume import VolumeSettings, make_volume, save_volume
from echolume_processing.ultrasonic.delay_and_sum import silent
from echolume_processing.ultrasonic.edges import Edge
from echolume_processing.ultrasonic.scan_lattice import IrregularScanError
from echolume_processing.ultrasonic.voxels import Volume


class ImageResults(TypedDict):
    """What came of a scan's images."""

    scan: str
    pings: int
    points: int
    points_left_out: int
    pixel_mm: float
    level_mm: float
    interpolation: str
    edges: list[dict[str, object]]
    volume: dict[str, object] | None
    files: list[str]
    notes: list[str]


def image_archive(
    archive: Path, out: Path, maps: MapSettings, volume: VolumeSettings | None = None, progress: Progress = silent
) -> ImageResults:
    """Images of a scan from its archive, drawn into a folder.

    Parameters
    ----------
    archive
        ``raw.mcap`` of a scan with a calibration and an ultrasonic pass; a torn one gives what it holds.
    out
        Folder; made if needed.
    maps, volume
        How fine, and made from what; no volume unless there are settings of one.
    progress
        Told what is going on.

    Raises
    ------
    ArchiveError
        If it is no archive of a scan, holds no pings, or its cloud spans no surface.
    ConfigError
        If the settings do not suit the scan.
    """
    scan = read_sound(archive, progress)
    make_folder(out)
    progress("images", 0, 0)
    try:
        images = make_images(scan, maps)
        found = None if volume is None else make_volume(scan, images, volume, progress)
    except IrregularScanError as error:
        raise ConfigError(f"--method fft: {archive}: {error}") from error
    except ValueError as error:
        raise ArchiveError(f"{archive}: scan {scan.start.scan}: {error}") from error
    progress("drawing", 0, 0)
    files = image_figures.draw(images, found, out)
    if found is not None:
        save_volume(found, out / "volume.npz")
        files.append("volume.npz")
    return ImageResults(
        scan=scan.start.scan,
        pings=len(scan.pings),
        points=int(images.points.size),
        points_left_out=int(scan.points.size - images.points.size),
        pixel_mm=maps.pixel_mm,
        level_mm=images.scale.resolution_mm,
        interpolation=maps.interpolation,
        edges=[_edge_report(edge) for edge in images.edges],
        volume=None if found is None else _volume_report(found),
        files=files,
        notes=[] if found is None else list(found.notes),
    )


def _edge_report(edge: Edge) -> dict[str, object]:
    return {
        "ends_mm": np.round(edge.ends_mm, 3).tolist(),
        "sigma_across_mm": np.round(edge.sigma_across_mm, 3).tolist(),
        "sigma_z_mm": round(float(np.sqrt(edge.covariance_mm2[0, 2, 2])), 4),
        "step_mm": round(edge.step_mm, 2),
    }


def _volume_report(volume: Volume) -> dict[str, object]:
    grid = volume.grid
    bright = np.unravel_index(np.argmax(volume.magnitude(weighted=True)), grid.shape)
    return {
        "method": volume.method,
        "voxels": [grid.shape[2], grid.shape[1], grid.shape[0]],
        "step_mm": [round(s, 4) for s in grid.step_mm],
        "brightest_mm": [
            round(float(a[i]), 2) for a, i in zip((grid.x_mm, grid.y_mm, grid.z_mm), bright[::-1], strict=True)
        ],
    }
