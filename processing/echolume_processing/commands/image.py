"""Images of sound alone from the archive of a scan: cloud, gray levels, edges in 3D, and a delay-and-sum volume.

examples:
  echolume image demo-out/raw.mcap --out images
  echolume image demo-out/raw.mcap --out images --volume --voxel 2 --levels 0.25 --interpolate linear

Writes fig08_cloud.png, fig09_interpolated.png and fig10_edges.png to --out; with --volume also volume.npz (values,
coherence and axes in mm), volume_projections.png and volume_slices.png.
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from echolume_processing.commands.progress_line import ProgressLine
from echolume_processing.commands.report_table import write_table

if TYPE_CHECKING:
    from echolume_processing.imaging import ImageResults


def above_zero(text: str) -> float:
    """A number above 0."""
    value = float(text)
    if not (value > 0 and math.isfinite(value)):
        raise argparse.ArgumentTypeError(f"expected a number above 0, got {text}")
    return value


def acute(text: str) -> float:
    """An angle in degrees, above 0 and below 85."""
    value = above_zero(text)
    if value > 85:
        raise argparse.ArgumentTypeError(f"expected at most 85 degrees, got {text}")
    return value


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("archive", type=Path, help="raw.mcap of a scan with an ultrasonic pass")
    parser.add_argument("--out", type=Path, required=True, help="folder for the pictures and the volume")
    parser.add_argument("--pixel", type=above_zero, default=1.0, metavar="MM", help="pixel of the maps (default: 1)")
    parser.add_argument(
        "--levels", type=above_zero, metavar="MM", help="height of one gray level (default: as fine as 256 allow)"
    )
    parser.add_argument(
        "--interpolate",
        choices=("nearest", "linear", "natural"),
        default="natural",
        help="which map the gray levels and edges are made from (default: natural)",
    )
    parser.add_argument("--volume", action="store_true", help="also make the delay-and-sum volume")
    parser.add_argument(
        "--method",
        choices=("fft", "gather"),
        help="how: fft needs a regular raster of poses, gather takes any (default: fft where it may)",
    )
    parser.add_argument("--voxel", type=above_zero, default=2.5, metavar="MM", help="largest voxel (default: 2.5)")
    parser.add_argument(
        "--half-angle",
        type=acute,
        metavar="DEG",
        help="poses that see a voxel further off their axis are left out of it (default: what the pitch allows, to 45)",
    )
    parser.add_argument("--json", action="store_true", help="print the results as JSON")


def run(args: argparse.Namespace) -> int:
    """Make the images and print what came out."""
    from echolume_processing.imaging import image_archive
    from echolume_processing.sound_images import MapSettings
    from echolume_processing.sound_volume import VolumeSettings

    maps = MapSettings(args.pixel, args.levels, args.interpolate)
    half_angle_rad = None if args.half_angle is None else math.radians(args.half_angle)
    volume = VolumeSettings(args.method or "auto", args.voxel, half_angle_rad) if args.volume else None
    progress = ProgressLine()
    try:
        found = image_archive(args.archive, args.out, maps, volume, progress)
    finally:
        progress.close()
    if args.json:
        sys.stdout.write(json.dumps(found, indent=1) + "\n")
    else:
        _write(found, args.out)
    return 0


def _write(found: ImageResults, out: Path) -> None:
    rows = [
        ("scan", found["scan"]),
        ("pings", str(found["pings"])),
        ("points", f"{found['points']} ({found['points_left_out']} outside the field or far from all others)"),
        ("map", f"{found['interpolation']}, pixel {found['pixel_mm']:g} mm, gray level {found['level_mm']:.3g} mm"),
        ("edges", str(len(found["edges"]))),
    ]
    if found["volume"] is not None:
        volume = found["volume"]
        rows.append(("volume", f"{volume['voxels']} voxels of {volume['step_mm']} mm by {volume['method']}"))
        rows.append(("brightest at", f"{volume['brightest_mm']} mm"))
    rows.extend(("note", note) for note in found["notes"])
    write_table(rows, {})
    sys.stdout.write(f"\nResults are in {out}: {', '.join(found['files'])}\n")
