"""Calibrate a whole rig (cameras, laser, array) from the archive of one calibration scan.

example: echolume calibrate rig calibrate.mcap --out calibration.json
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
    parser.add_argument("archive", type=Path, help="archive (.mcap) of a scan of the plan calibrate.toml")
    parser.add_argument("--out", type=Path, required=True, metavar="FILE", help="calibration file to write")
    add_rig(parser)
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the calibration file, and report."""
    from echolume_messages import calibration as calibration_file
    from echolume_messages.files import require_place
    from echolume_processing.calibrate_rig import calibrate_rig

    rig = load_rig(args.rig)
    require_place(args.out)
    calibration, figures = calibrate_rig(args.archive, rig.name, rig.array)
    calibration_file.save(calibration, args.out)
    if args.json:
        sys.stdout.write(json.dumps({"digest": calibration.digest, **figures}, indent=1) + "\n")
        return 0
    rows = [
        ("left, right RMS", f"{figures['left_rms_px']:.4f}, {figures['right_rms_px']:.4f} px"),
        ("stereo RMS", f"{figures['stereo_rms_px']:.4f} px"),
        ("laser plane RMS", f"{figures['plane_rms_mm']:.4f} mm"),
        ("array path RMS", f"{figures['path_rms_mm']:.4f} mm"),
        ("board views", f"{figures['views']}; left out: {figures['views_left_out'] or 'none'}"),
        ("pings left out", f"{figures['pings_left_out'] or 'none'}"),
        ("digest", calibration.digest),
        ("written", str(args.out)),
    ]
    sys.stdout.write("".join(f"{name:<16} {value}\n" for name, value in rows))
    return 0
