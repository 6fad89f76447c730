"""ChArUco boards: a chessboard whose white squares carry numbered markers, so that a part of it is enough."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import cast

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import ConfigError
from echolume_messages.geometry import Points3
from echolume_messages.types import Frame
from echolume_processing.optical.board import Corners, grid_mm, grid_neighbours
from echolume_processing.optical.corner_fit import REACH, refine_corners

MIN_CORNERS = 12
"""Fewer corners say too little of a board's pose."""
OF_THE_GAP = 0.9
"""The window around a corner stays within this share of the white gap around the markers."""


@dataclass(frozen=True)
class CharucoPattern:
    """A ChArUco board.

    Attributes
    ----------
    columns, rows : int
        Inner corners along x and y (squares less one).
    square_mm, marker_mm : float
        Sizes of a square and of a marker.
    dictionary : str
        OpenCV's name of the markers' dictionary, such as ``DICT_5X5_100``.

    Notes
    -----
    The board frame has its origin at the inner corner at the lower left of the print as it is read, x to the right,
    y up and z out of the print. Corners are numbered as OpenCV does, from the upper left.
    """

    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_5X5_100"

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3 or not 0 < self.marker_mm < self.square_mm:
            raise ConfigError(
                f"charuco board: expected at least 3x3 inner corners and a marker smaller than the square, "
                f"got {self.columns}x{self.rows}, {self.square_mm} mm and {self.marker_mm} mm"
            )
        if not self.dictionary.startswith("DICT_") or not hasattr(cv2.aruco, self.dictionary):
            raise ConfigError(f"charuco board: no dictionary {self.dictionary!r}; expected one such as DICT_5X5_100")
        available = len(cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary)).bytesList)
        needed = (self.columns + 1) * (self.rows + 1) // 2
        if needed > available:
            raise ConfigError(f"charuco board: needs {needed} markers, {self.dictionary} has {available}")

    @cached_property
    def board(self) -> cv2.aruco.CharucoBoard:
        """OpenCV's description of the board."""
        markers = cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
        size = (self.columns + 1, self.rows + 1)
        return cv2.aruco.CharucoBoard(size, self.square_mm, self.marker_mm, markers)

    @property
    def corners_mm(self) -> Points3:
        """Inner corners (rows * columns, 3), board frame; row after row from the top, x fastest."""
        grid = grid_mm(self.columns, self.rows, self.square_mm)
        grid[:, 1] = (self.rows - 1) * self.square_mm - grid[:, 1]
        return grid

    @property
    def neighbours(self) -> NDArray[np.int64]:
        """Pairs (m, 2) of corners that are one square apart."""
        return grid_neighbours(self.columns, self.rows)

    @property
    def name(self) -> str:
        """What a message calls it."""
        return f"{MIN_CORNERS} of the {self.columns}x{self.rows} ChArUco corners"

    def find(self, image: Frame) -> Corners | None:
        """The corners that are to be seen, or None if they are fewer than `MIN_CORNERS`."""
        points, ids, *_ = cast("tuple[object, ...]", cv2.aruco.CharucoDetector(self.board).detectBoard(image))
        if points is None or ids is None:
            return None
        which = np.reshape(np.asarray(ids, dtype=np.int64), -1)
        order = np.argsort(which)
        which = which[order]
        near = np.reshape(np.asarray(points, dtype=np.float64), (-1, 2))[order]
        if len(which) < MIN_CORNERS:
            return None
        known = grid_mm(self.columns, self.rows, self.square_mm)[which, :2]
        if np.linalg.matrix_rank(known - known.mean(axis=0)) < 2:
            return None
        step = self._squares_px(known, near)
        reach = min(REACH, OF_THE_GAP * 0.5 * (1 - self.marker_mm / self.square_mm))
        fine, blur_px = refine_corners(image, near, step[0], step[1], reach)
        fitted = np.isfinite(blur_px)
        blur = float(np.median(blur_px[fitted])) if fitted.any() else float("nan")
        return Corners(which, fine, blur, float(fitted.mean()))

    def _squares_px(self, known: NDArray[np.float64], seen: NDArray[np.float64]) -> list[NDArray[np.float64]]:
        """One square along x and y at each corner, in the image, by the homography of all of them."""
        homography = np.asarray(cv2.findHomography(known, seen)[0], dtype=np.float64)

        def mapped(points: NDArray[np.float64]) -> NDArray[np.float64]:
            out = np.column_stack([points, np.ones(len(points))]) @ homography.T
            return out[:, :2] / out[:, 2:]

        half = 0.5 * self.square_mm * np.eye(2)
        return [mapped(known + half[axis]) - mapped(known - half[axis]) for axis in (0, 1)]
