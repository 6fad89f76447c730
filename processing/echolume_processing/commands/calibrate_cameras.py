"""Calibrate both cameras from pairs leftNN.*/rightNN.* of a board, or on the live rig.

Without a folder, frames are taken from the bus while a scan with `snap` passes runs in another terminal. Each view is
answered with what is still missing: parts of the images, tilts. The session ends when all is covered, or by Ctrl-C
with the views it has.

examples:
  echolume calibrate cameras boards/ --pattern 9x6 --square 25
  echolume calibrate cameras boards/ --pattern 10x7 --square 20 --marker 15
  echolume calibrate cameras --rig rig.toml --save boards
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.rig_option import add_rig, load_rig
from echolume_processing.commands.board_option import add_board, any_board
from echolume_processing.commands.image_pairs import published_rms_px, read_pairs, write_pair
from echolume_processing.commands.report_table import say_aside, write_table

if TYPE_CHECKING:
    from echolume_messages.types import Frame
    from echolume_processing.optical.board import CalibrationBoard
    from echolume_processing.optical.calibrate import CameraPair


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.description = __doc__
    parser.add_argument(
        "folder", type=Path, nargs="?", help="folder of images leftNN.jpg and rightNN.jpg (png, bmp, tif too)"
    )
    add_board(parser, charuco=True)
    add_rig(parser)
    parser.add_argument("--save", type=Path, metavar="FOLDER", help="live: keep the images taken as such a folder")
    parser.add_argument("--json", action="store_true", help="print the figures as JSON")


def run(args: argparse.Namespace) -> int:
    """Calibrate, and report."""
    from echolume_processing.optical.calibrate import calibrate_cameras

    board = any_board(args)
    if args.folder is None:
        pair, published = _live(args, board), None
    else:
        names, left, right = read_pairs(args.folder)
        pair, published = calibrate_cameras(left, right, board, names=names), published_rms_px(args.folder)
    if args.json:
        sys.stdout.write(json.dumps(figures(pair, board.square_mm, published), indent=1) + "\n")
    else:
        write_table(rows(pair, board.square_mm, published), pair.rejected)
    return 0


def _live(args: argparse.Namespace, board: CalibrationBoard) -> CameraPair:
    import threading

    from echolume_messages.bus import connect
    from echolume_messages.bus.lifetime import stopped_by_signals
    from echolume_messages.files import make_folder
    from echolume_processing.calibrate_live import camera_pairs, gather_views
    from echolume_processing.optical.calibrate import calibrate_views

    rig = load_rig(args.rig)
    folder: Path | None = args.save
    if folder is not None:
        make_folder(folder)

    def keep(number: int, left: Frame, right: Frame) -> None:
        if folder is not None:
            write_pair(folder, number, left, right)

    stop = threading.Event()
    with stopped_by_signals(stop), connect(rig.bus.endpoint, rig.name) as bus:
        say_aside("waiting for images of the board; start a scan with snap passes; Ctrl-C ends with what there is")
        coverage = gather_views(camera_pairs(bus), board, say_aside, stop, keep)
    if coverage is None:
        raise CalibrationRejectedError("calibrate cameras: no view of the board came before the end")
    for line in coverage.missing:
        say_aside(f"not covered: {line}")
    return calibrate_views(coverage.views, board, coverage.size_px)


def figures(pair: CameraPair, square_mm: float, published_px: float | None) -> dict[str, object]:
    """The calibration's figures by name."""
    judged = bool(pair.left_out.names)
    return {
        "views": len(pair.views),
        "rejected": pair.rejected,
        "left_rms_px": pair.left_rms_px,
        "right_rms_px": pair.right_rms_px,
        "stereo_rms_px": pair.stereo_rms_px,
        "published_left_rms_px": published_px,
        "baseline_mm": pair.baseline_mm,
        "square_mm": square_mm,
        "square_mean_mm": pair.square_mm[0],
        "square_sd_mm": pair.square_mm[1],
        "leave_one_out_px": pair.left_out.rms_px if judged else None,
        "leave_one_out_mm": pair.left_out.rms_mm if judged else None,
        "sigmas": pair.covariance.sigmas,
        "noise_px": pair.covariance.noise_px,
    }


def rows(pair: CameraPair, square_mm: float, published_px: float | None) -> list[tuple[str, str]]:
    """The report's lines."""
    from echolume_processing.optical.acceptance import verdict

    beside = f"   (published with the images: {published_px:.5f} px)" if published_px is not None else ""
    sigma = pair.covariance.sigmas
    mean_mm, sd_mm = pair.square_mm
    out = [
        ("views used", f"{len(pair.views)} of {len(pair.views) + len(pair.rejected)}"),
        ("left RMS", f"{pair.left_rms_px:.4f} px{beside}"),
        ("right RMS", f"{pair.right_rms_px:.4f} px"),
        ("stereo RMS", f"{pair.stereo_rms_px:.4f} px"),
        ("baseline", f"{pair.baseline_mm:.3f} mm"),
        ("squares, triangulated", f"{mean_mm:.3f} mm +- {sd_mm:.3f} mm (true: {square_mm:g})"),
    ]
    for side, camera in (("left", pair.left), ("right", pair.right)):
        fx, fy, cx, cy = (float(camera.matrix[k]) for k in ((0, 0), (1, 1), (0, 2), (1, 2)))
        out.append(
            (f"{side} focal lengths", f"{fx:.2f} +- {sigma[f'{side} fx_px']:.2f}, {fy:.2f} +- "
             f"{sigma[f'{side} fy_px']:.2f} px")
        )  # fmt: skip
        out.append(
            (f"{side} centre", f"{cx:.2f} +- {sigma[f'{side} cx_px']:.2f}, {cy:.2f} +- {sigma[f'{side} cy_px']:.2f} px")
        )
    shift = ", ".join(f"{sigma[f'right_from_left {axis}_mm']:.3f}" for axis in "xyz")
    out.append(("relative pose", f"sigma {shift} mm along the right camera's x, y, z"))
    out.append(("verdict", verdict(pair.left_out)))
    return out
