"""Show for each stripe how far the laser plane is from parallel to YZ, while the head is turned in its mount.

Frames are taken from the bus: run a scan with `optical` passes in another terminal. The cameras must have been
calibrated; the laser's own calibration is not used. Over a flat bench the stripe tells only the turn about z; put a
block under a part of the line, and the turn about y is told too. Ctrl-C ends it.

example: echolume calibrate align --rig rig.toml
"""

from __future__ import annotations

import argparse
from pathlib import Path

from echolume_messages.errors import CalibrationMissingError
from echolume_messages.rig_option import add_rig, load_rig
from echolume_processing.commands.report_table import say


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.description = __doc__
    add_rig(parser)
    parser.add_argument(
        "--calibration", type=Path, metavar="FILE", help="calibration file (default: the one that the rig file names)"
    )
    parser.add_argument("--stripes", type=int, metavar="N", help="end after N stripes")


def run(args: argparse.Namespace) -> int:
    """Watch until Ctrl-C."""
    import threading

    from echolume_messages import calibration as calibration_file
    from echolume_messages.bus import connect
    from echolume_messages.bus.lifetime import stopped_by_signals
    from echolume_processing.calibrate_live import camera_pairs, watch_alignment
    from echolume_processing.optical.camera import Camera

    rig = load_rig(args.rig)
    path = args.calibration or (Path(rig.calibration) if rig.calibration else None)
    if path is None:
        raise CalibrationMissingError(f"{args.rig}: names no calibration; give one with --calibration")
    calibration = calibration_file.load(path, rig.name)
    cameras = Camera.of(calibration.left), Camera.of(calibration.right)
    stop = threading.Event()
    with stopped_by_signals(stop), connect(rig.bus.endpoint, rig.name) as bus:
        watch_alignment(camera_pairs(bus), cameras, say, stop, args.stripes)
    return 0
