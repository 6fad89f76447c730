"""Calibrate cameras and laser from passes board-NN and laser-NN: of an archive, of a folder, or while the scan runs.

A folder holds pairs of images and a file frames.csv with the columns pass,x_mm,left,right: the pass (board-00,
laser-00, ...), the guide's position in mm (empty for boards), and both images. Without archive or folder the passes
are taken from the bus: start `echolume scan` with the plan calibrate.toml in another terminal. After each board the
operator is told what is missing. The session ends with the scan, or by Ctrl-C with what there is.

examples:
  echolume calibrate laser calibrate.mcap --into calibration.json
  echolume calibrate laser stripes/
  echolume calibrate laser --rig rig.toml --into calibration.json --save stripes
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from echolume_messages.rig_option import add_rig, load_rig
from echolume_processing.commands.board_option import add_board, chessboard
from echolume_processing.commands.report_table import say_aside, write_table
from echolume_processing.commands.stripe_folder import StripeFolder, read_shots

if TYPE_CHECKING:
    from echolume_processing.optical.board import Pattern
    from echolume_processing.optical.calibrate_rig import OpticsCalibration


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.description = __doc__
    parser.add_argument(
        "archive", type=Path, nargs="?", help="archive (.mcap) of a calibration scan, or a folder with frames.csv"
    )
    add_board(parser, charuco=False)
    add_rig(parser)
    parser.add_argument("--into", type=Path, metavar="FILE", help="calibration file whose optical parts to replace")
    parser.add_argument("--save", type=Path, metavar="FOLDER", help="live: keep the images taken as such a folder")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Calibrate, write the calibration file if there is one, and report."""
    import msgspec

    from echolume_messages import calibration as calibration_file
    from echolume_processing.optical.calibrate_rig import calibrate_optics, calibrate_shots

    board = chessboard(args)
    before = calibration_file.load(args.into) if args.into else None
    if args.archive is None:
        found = _live(args, board)
    elif args.archive.is_dir():
        found = calibrate_shots(read_shots(args.archive), board)
    else:
        found = calibrate_optics(args.archive, board)
    if before is not None:
        updated = msgspec.structs.replace(
            before, left=found.left, right=found.right, stereo_rms_px=found.stereo_rms_px, laser=found.laser
        )
        calibration_file.save(updated, args.into)
    if args.json:
        figures = msgspec.to_builtins(found.report) | {"laser": msgspec.to_builtins(found.laser)}
        sys.stdout.write(json.dumps(figures, indent=1) + "\n")
        return 0
    lines = rows(found)
    if args.into:
        lines.append(("written", str(args.into)))
    write_table(lines, found.report.rejected)
    return 0


def _live(args: argparse.Namespace, board: Pattern) -> OpticsCalibration:
    import threading

    from echolume_messages.bus import connect
    from echolume_messages.bus.lifetime import stopped_by_signals
    from echolume_messages.files import make_folder
    from echolume_processing.calibrate_live import LedgerEnd, camera_pairs, gather_optics

    rig = load_rig(args.rig)
    keep = StripeFolder(make_folder(args.save, "--save")).keep if args.save is not None else None
    stop = threading.Event()
    with stopped_by_signals(stop), connect(rig.bus.endpoint, rig.name) as bus:
        ended = LedgerEnd(bus)
        say_aside(
            "waiting for passes board-NN and laser-NN; start the scan calibrate.toml; Ctrl-C ends with what there is"
        )
        pairs = camera_pairs(bus)
        found = gather_optics(pairs, board, say_aside, stop, ended, keep)
        if pairs.lost:
            say_aside(f"{pairs.lost} frames did not arrive; boards or stripes may be missing from this calibration")
        return found


def rows(found: OpticsCalibration) -> list[tuple[str, str]]:
    """The report's lines."""
    report, laser = found.report, found.laser
    per_guide = sum(a * b for a, b in zip(laser.normal, laser.guide_direction, strict=True))
    normal = ", ".join(f"{value:.6f}" for value in laser.normal)
    out = [
        ("views used", f"{len(report.views)} of {len(report.views) + len(report.rejected)}"),
        ("left RMS", f"{report.left_rms_px:.4f} px"),
        ("right RMS", f"{report.right_rms_px:.4f} px"),
        ("stereo RMS", f"{report.stereo_rms_px:.4f} px"),
        ("views left out in turn", f"{report.left_out_px:.4f} px, {report.left_out_mm:.4f} mm RMS"),
        ("baseline", f"{report.baseline_mm:.3f} mm"),
        ("squares, triangulated", f"{report.square_mean_mm:.3f} mm +- {report.square_sd_mm:.3f} mm"),
        ("laser plane", f"({normal}) . X = {laser.offset_mm:.4f} mm + {per_guide:.6f} s"),
        ("plane RMS", f"{report.plane_rms_mm:.4f} mm over {report.stripe_points} points of {report.stripes} stripes"),
        ("boards left out in turn", f"plane within {report.plane_leave_one_out_mm:.4f} mm RMS"),
        ("plane in the field", f"sigma at most {report.plane_field_sigma_mm:.4f} mm"),
        ("parallel to YZ", f"within {report.parallel_deg:.3f} deg, {report.parallel_mm:.3f} mm over the field"),
    ]
    if report.turned:
        out.append(("rig frame", "turned by half a turn: the guide runs against the board's x"))
    out.append(("verdict", "accepted"))
    return out
