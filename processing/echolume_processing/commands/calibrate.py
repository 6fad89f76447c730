"""Calibrate cameras, laser, array, or the whole rig.

examples:
  echolume calibrate cameras boards/ --pattern 9x6 --square 25
  echolume calibrate laser calibrate.mcap --into calibration.json
  echolume calibrate rig calibrate.mcap --out calibration.json
"""

from __future__ import annotations

import argparse
import json
import re
import sys
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING

from echolume_messages.errors import ConfigError

if TYPE_CHECKING:
    from echolume_messages.types import Frame

ARCHIVE_MODULES = {
    "array": "echolume_processing.commands.calibrate_array",
    "rig": "echolume_processing.commands.calibrate_whole",
}
IMAGE_NAME = re.compile(r"left(?P<number>.*)\.(?:jpe?g|png|bmp|tiff?)", re.IGNORECASE)
PUBLISHED = re.compile(r"^avg_reprojection_error:\s*(?P<value>[-+.0-9eE]+)\s*$", re.MULTILINE)


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the subcommands; each imports its libraries only when it runs."""
    kinds = parser.add_subparsers(dest="kind", required=True, metavar="cameras|laser|array|rig")
    cameras = kinds.add_parser(
        "cameras",
        help="both cameras, from a folder of board images",
        description="Calibrate both cameras from pairs leftNN.*/rightNN.* of a chessboard.\n\n"
        "example: echolume calibrate cameras boards/ --pattern 9x6 --square 25",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    cameras.add_argument("folder", type=Path, help="folder of images leftNN.jpg and rightNN.jpg (png, bmp, tif too)")
    cameras.add_argument("--pattern", default="9x6", help="inner corners along x and y (default: 9x6)")
    cameras.add_argument("--square", type=float, default=20.0, metavar="MM", help="size of a square (default: 20)")
    cameras.add_argument("--json", action="store_true", help="print the figures as JSON")
    laser = kinds.add_parser(
        "laser",
        help="cameras, rig frame and laser plane, from the archive of a calibration scan",
        description="Calibrate cameras and laser from the passes board-NN and laser-NN of an archive.\n\n"
        "example: echolume calibrate laser calibrate.mcap --into calibration.json",
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    laser.add_argument("archive", type=Path, help="archive (.mcap) of a calibration scan")
    laser.add_argument("--pattern", default="9x6", help="inner corners along x and y (default: 9x6)")
    laser.add_argument("--square", type=float, default=20.0, metavar="MM", help="size of a square (default: 20)")
    laser.add_argument("--into", type=Path, metavar="FILE", help="calibration file whose optical parts to replace")
    laser.add_argument("--json", action="store_true", help="print the figures as JSON")
    for name, module in ARCHIVE_MODULES.items():
        what = "the ultrasonic array" if name == "array" else "cameras, laser and array"
        parser_of = kinds.add_parser(
            name,
            help=f"{what}, from the archive of a calibration scan",
            formatter_class=argparse.RawDescriptionHelpFormatter,
        )
        import_module(module).configure(parser_of)


def run(args: argparse.Namespace) -> int:
    """Run the subcommand that was asked for."""
    if args.kind == "cameras":
        return run_cameras(args)
    if args.kind == "laser":
        return run_laser(args)
    return int(import_module(ARCHIVE_MODULES[args.kind]).run(args))


def parse_pattern(text: str) -> tuple[int, int]:
    """Columns and rows of inner corners from a text such as ``9x6``."""
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if found is None:
        raise ConfigError(f"--pattern {text}: expected inner corners along x and y, such as 9x6")
    return int(found[1]), int(found[2])


def run_cameras(args: argparse.Namespace) -> int:
    """``echolume calibrate cameras``."""
    from echolume_processing.optical.calibrate import calibrate_cameras

    pattern = parse_pattern(args.pattern)
    names, left, right = read_pairs(args.folder)
    pair = calibrate_cameras(left, right, pattern, args.square, names)
    published = published_rms_px(args.folder)
    figures: dict[str, object] = {
        "views": len(pair.views),
        "rejected": pair.rejected,
        "left_rms_px": pair.left_rms_px,
        "right_rms_px": pair.right_rms_px,
        "stereo_rms_px": pair.stereo_rms_px,
        "published_left_rms_px": published,
        "baseline_mm": pair.baseline_mm,
        "square_mm": args.square,
        "square_mean_mm": pair.square_mm[0],
        "square_sd_mm": pair.square_mm[1],
        "leave_one_out_mm": pair.left_out.rms_mm,
    }
    if args.json:
        sys.stdout.write(json.dumps(figures, indent=1) + "\n")
        return 0
    beside = f"   (published with the images: {published:.5f} px)" if published is not None else ""
    rows = [
        ("views used", f"{len(pair.views)} of {len(names)}"),
        ("left RMS", f"{pair.left_rms_px:.4f} px{beside}"),
        ("right RMS", f"{pair.right_rms_px:.4f} px"),
        ("stereo RMS", f"{pair.stereo_rms_px:.4f} px"),
        ("baseline", f"{pair.baseline_mm:.3f} mm"),
        ("squares, triangulated", f"{pair.square_mm[0]:.3f} mm +- {pair.square_mm[1]:.3f} mm (true: {args.square:g})"),
    ]
    if pair.left_out.names:
        rows.append(("views left out in turn", f"corners within {pair.left_out.rms_mm:.3f} mm RMS of the board's shape"))
    _write_table(rows, pair.rejected)
    return 0


def run_laser(args: argparse.Namespace) -> int:
    """``echolume calibrate laser``."""
    import msgspec

    from echolume_messages import calibration as calibration_file
    from echolume_processing.optical.board import Pattern
    from echolume_processing.optical.calibrate_rig import calibrate_optics

    before = calibration_file.load(args.into) if args.into else None
    found = calibrate_optics(args.archive, Pattern(*parse_pattern(args.pattern), args.square))
    if before is not None:
        updated = msgspec.structs.replace(
            before, left=found.left, right=found.right, stereo_rms_px=found.stereo_rms_px, laser=found.laser
        )
        calibration_file.save(updated, args.into)
    report = found.report
    if args.json:
        figures = msgspec.to_builtins(report) | {"laser": msgspec.to_builtins(found.laser)}
        sys.stdout.write(json.dumps(figures, indent=1) + "\n")
        return 0
    laser = found.laser
    per_guide = sum(a * b for a, b in zip(laser.normal, laser.guide_direction, strict=True))
    normal = ", ".join(f"{value:.6f}" for value in laser.normal)
    rows = [
        ("views used", f"{len(report.views)} of {len(report.views) + len(report.rejected)}"),
        ("left RMS", f"{report.left_rms_px:.4f} px"),
        ("right RMS", f"{report.right_rms_px:.4f} px"),
        ("stereo RMS", f"{report.stereo_rms_px:.4f} px"),
        ("baseline", f"{report.baseline_mm:.3f} mm"),
        ("squares, triangulated", f"{report.square_mean_mm:.3f} mm +- {report.square_sd_mm:.3f} mm"),
        ("laser plane", f"({normal}) . X = {laser.offset_mm:.4f} mm + {per_guide:.6f} s"),
        ("plane RMS", f"{report.plane_rms_mm:.4f} mm over {report.stripe_points} points of {report.stripes} stripes"),
        ("boards left out in turn", f"plane within {report.plane_leave_one_out_mm:.4f} mm RMS"),
        ("plane in the field", f"sigma at most {report.plane_field_sigma_mm:.4f} mm"),
    ]
    if report.turned:
        rows.append(("rig frame", "turned by half a turn: the guide runs against the board's x"))
    if args.into:
        rows.append(("written", str(args.into)))
    _write_table(rows, report.rejected)
    return 0


def read_pairs(folder: Path) -> tuple[list[str], list[Frame], list[Frame]]:
    """Names and images of the pairs ``leftNN``/``rightNN`` in a folder, in the order of their names."""
    import cv2
    import numpy as np

    if not folder.is_dir():
        raise ConfigError(f"{folder}: no such folder; give the one with leftNN and rightNN images")
    names: list[str] = []
    images: tuple[list[Frame], list[Frame]] = ([], [])
    for left in sorted(folder.iterdir()):
        found = IMAGE_NAME.fullmatch(left.name)
        if found is None:
            continue
        right = left.with_name("right" + left.name[len("left") :])
        if not right.is_file():
            raise ConfigError(f"{right}: missing; {left.name} has no partner")
        for path, side in ((left, images[0]), (right, images[1])):
            image = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
            if image is None:
                raise ConfigError(f"{path}: not an image that can be read")
            side.append(np.asarray(image, dtype=np.uint8))
        names.append(found["number"])
    if not names:
        raise ConfigError(f"{folder}: no images named leftNN.jpg (png, bmp, tif) with their rightNN")
    return names, *images


def published_rms_px(folder: Path) -> float | None:
    """Reprojection error published beside the images in ``left_intrinsics.yml``, or None."""
    path = folder / "left_intrinsics.yml"
    found = PUBLISHED.search(path.read_text(encoding="utf-8")) if path.is_file() else None
    return float(found["value"]) if found is not None else None


def _write_table(rows: list[tuple[str, str]], rejected: dict[str, str]) -> None:
    width = max(len(name) for name, _ in rows)
    lines = [f"{name:<{width}}  {value}" for name, value in rows]
    lines += [f"left out: view {name}: {why}" for name, why in rejected.items()]
    sys.stdout.write("\n".join(lines) + "\n")
