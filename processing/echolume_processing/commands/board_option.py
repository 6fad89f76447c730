"""Which board is used: ``--pattern``, ``--square``, and for ChArUco ``--marker`` and ``--dictionary``."""

from __future__ import annotations

import argparse
import re
from typing import TYPE_CHECKING

from echolume_messages.errors import ConfigError

if TYPE_CHECKING:
    from echolume_processing.optical.board import CalibrationBoard, Pattern


def add_board(parser: argparse.ArgumentParser, charuco: bool) -> None:
    """The options; those of ChArUco boards only where such a board is of use."""
    parser.add_argument("--pattern", default="9x6", help="inner corners along x and y (default: 9x6)")
    parser.add_argument("--square", type=float, default=20.0, metavar="MM", help="size of a square (default: 20)")
    if charuco:
        parser.add_argument("--marker", type=float, metavar="MM", help="a ChArUco board with markers of this size")
        parser.add_argument(
            "--dictionary", default="DICT_5X5_100", help="the markers' dictionary (default: DICT_5X5_100)"
        )


def parse_pattern(text: str) -> tuple[int, int]:
    """Columns and rows of inner corners from a text such as ``9x6``."""
    found = re.fullmatch(r"(\d+)x(\d+)", text)
    if found is None:
        raise ConfigError(f"--pattern {text}: expected inner corners along x and y, such as 9x6")
    return int(found[1]), int(found[2])


def chessboard(args: argparse.Namespace) -> Pattern:
    """The chessboard that the options describe."""
    from echolume_processing.optical.board import Pattern

    return Pattern(*parse_pattern(args.pattern), args.square)


def any_board(args: argparse.Namespace) -> CalibrationBoard:
    """The board that the options describe."""
    from echolume_processing.optical.charuco import CharucoPattern

    if args.marker is None:
        return chessboard(args)
    return CharucoPattern(*parse_pattern(args.pattern), args.square, args.marker, args.dictionary)
