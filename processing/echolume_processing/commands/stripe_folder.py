"""Folders of a calibration's images with ``frames.csv``: which pass each pair is of, and where the guide stood."""

from __future__ import annotations

import csv
import math
from pathlib import Path
from typing import TYPE_CHECKING

from echolume_messages.errors import ConfigError
from echolume_processing.commands.image_pairs import read_image, write_image

if TYPE_CHECKING:
    from echolume_messages.bus import Message
    from echolume_processing.optical.calibration_shots import CalibrationShots

LIST = "frames.csv"
COLUMNS = ("pass", "x_mm", "left", "right")


class StripeFolder:
    """Keeps the pairs of a calibration scan in a folder that `read_shots` reads.

    Parameters
    ----------
    folder : Path
        Made anew, or empty of an earlier list.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        if (folder / LIST).exists():
            raise ConfigError(f"{folder / LIST}: there is one already; give an empty folder")
        self._line(COLUMNS)

    def keep(self, left: Message, right: Message) -> None:
        """Write one pair, then its line: an image that the list names is whole."""
        import numpy as np

        header = left.header
        names: list[str] = []
        for side, message in (("left", left), ("right", right)):
            names.append(f"{header.pass_name}-{header.trigger:04d}-{header.attempt}-{side}.png")
            write_image(self._folder / names[-1], np.asarray(message.payload, dtype=np.uint8))
        from echolume_processing.optical.calibration_shots import BOARD

        x_mm = "" if header.pass_name.startswith(BOARD) else repr(header.source.x_mm)
        self._line((header.pass_name, x_mm, *names))

    def _line(self, values: tuple[str, ...]) -> None:
        path = self._folder / LIST
        try:
            with path.open("a", encoding="utf-8", newline="") as stream:
                csv.writer(stream).writerow(values)
        except OSError as error:
            raise ConfigError(f"{path}: cannot be written: {error.strerror}") from error


def read_shots(folder: Path) -> CalibrationShots:
    """Boards and stripes of a folder with ``frames.csv``.

    Raises
    ------
    ConfigError
        If the list or an image cannot be read; the line is named.
    """
    from echolume_processing.optical.calibration_shots import BOARD, LASER, CalibrationShots

    path = folder / LIST
    try:
        with path.open(encoding="utf-8", newline="") as stream:
            lines = list(csv.reader(stream))
    except OSError as error:
        raise ConfigError(
            f"{path}: {error.strerror}; the laser needs the guide's position at each image: a file with the columns "
            f"{','.join(COLUMNS)}"
        ) from error
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigError(f"{path}: not a list of comma-separated values: {error}") from error
    if not lines or tuple(lines[0]) != COLUMNS:
        raise ConfigError(f"{path}, line 1: expected the columns {','.join(COLUMNS)}")
    shots = CalibrationShots()
    for number, line in enumerate(lines[1:], start=2):
        if len(line) != len(COLUMNS) or not line[0].startswith((BOARD, LASER)):
            raise ConfigError(
                f"{path}, line {number}: expected a pass {BOARD}NN or {LASER}NN, x_mm, left and right image, "
                f"got {','.join(line)!r}"
            )
        frames = read_image(folder / line[2]), read_image(folder / line[3])
        if frames[0].shape != frames[1].shape:
            raise ConfigError(f"{path}, line {number}: the images differ in size")
        x_mm = None if line[0].startswith(BOARD) else _guide_mm(line[1], f"{path}, line {number}")
        shots.add(line[0], number, x_mm, frames)
    return shots


def _guide_mm(text: str, where: str) -> float:
    try:
        x_mm = float(text)
    except ValueError:
        x_mm = math.nan
    if not math.isfinite(x_mm):
        raise ConfigError(f"{where}: expected the guide's position in mm, got {text!r}")
    return x_mm
