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
    """Calibrate, write the calibration file, and report; a refusal says why and writes nothing."""
    import msgspec

    from echolume_messages import calibration as calibration_file
    from echolume_messages.files import require_place
    from echolume_processing.ultrasonic import array_report
    from echolume_processing.ultrasonic.from_archive import calibrate_array_from_archive

    rig = load_rig(args.rig)
    before = calibration_file.load(args.into, rig.name)
    require_place(args.into, "--into")
    result = calibrate_array_from_archive(args.archive, before.left, before.right, before.laser, rig.array)
    calibration_file.save(msgspec.structs.replace(before, array=result.calibration), args.into)
    if args.json:
        sys.stdout.write(json.dumps(array_report.figures(result, rig.array), indent=1) + "\n")
        return 0
    rows = [*array_report.lines(result, rig.array), ("written", str(args.into))]
    width = max(len(name) for name, _ in rows)
    sys.stdout.write("".join(f"{name:<{width}}  {value}\n" for name, value in rows))
    return 0
