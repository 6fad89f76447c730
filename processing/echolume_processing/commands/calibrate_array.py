"""Calibrate the ultrasonic array from the passes plate, block-light and block-sound of a calibration scan.

example: echolume calibrate array calibrate.mcap --into calibration.json
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path

from echolume_messages.rig_option import add_rig, load_rig


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.description = __doc__
    parser.add_argument("archive", type=Path, help="archive (.mcap) of a calibration scan")
    parser.add_argument(
        "--into", type=Path, required=True, metavar="FILE", help="calibration file whose array part to replace"
    )
    add_rig(parser)
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the calibration file, and report."""
    import msgspec
    import numpy as np

    from echolume_messages import calibration as calibration_file
    from echolume_messages.files import require_place
    from echolume_processing.ultrasonic.from_archive import calibrate_array_from_archive

    rig = load_rig(args.rig)
    before = calibration_file.load(args.into, rig.name)
    require_place(args.into, "--into")
    result = calibrate_array_from_archive(args.archive, before.left, before.right, before.laser, rig.array)
    calibration_file.save(msgspec.structs.replace(before, array=result.calibration), args.into)
    plate, block = result.plate, result.block
    sigmas = plate.sigmas | (block.sigmas if block is not None else {})
    figures = {
        "pings_used": result.pings_used,
        "pings_rejected": result.pings_rejected,
        "path_rms_mm": plate.path_rms_mm,
        "level_rms": plate.level_rms,
        "speed_of_sound_mps": plate.speed_mps,
        "temperature_c": plate.temperature_c,
        "radius_mm": plate.radius_mm,
        "block_explained": block.explained if block is not None else None,
        "sigmas": sigmas,
    }
    if args.json:
        sys.stdout.write(json.dumps(figures, indent=1) + "\n")
        return 0
    rows = [
        ("pings used", f"{result.pings_used}; left out: {result.pings_rejected or 'none'}"),
        ("paths", f"{plate.path_rms_mm:.3f} mm rms"),
        ("speed of sound", f"{plate.speed_mps:.2f} m/s at {plate.temperature_c:.1f} C"),
        ("effective radius", f"{plate.radius_mm:.2f} mm"),
    ]
    for name, sigma in sigmas.items():
        angle = name.endswith((" rx", " ry", " yaw"))
        unit = "m/s" if name == "speed of sound" else "deg" if angle else "mm"
        rows.append((name, f"sigma {np.degrees(sigma) if angle else sigma:.3f} {unit}"))
    rows.append(("written", str(args.into)))
    width = max(len(name) for name, _ in rows)
    sys.stdout.write("".join(f"{name:<{width}}  {value}\n" for name, value in rows))
    return 0
