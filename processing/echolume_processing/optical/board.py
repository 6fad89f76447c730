"""Chessboard corners in an image, always in the board's own order, whichever end the detector starts from."""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import ConfigError
from echolume_messages.geometry import Points3
from echolume_messages.types import Frame
from echolume_processing.optical.corner_fit import refine_corners

Points2 = NDArray[np.float64]

MIN_WINDOW_PX = 5
MAX_WINDOW_PX = 11
WINDOW_PER_SQUARE = 0.12
"""Half window of the first refinement over the square's size in the image; the fit that follows has its own."""


class Corners(NamedTuple):
    """Corners found in one image.

    Attributes
    ----------
    which : (n,) int64
        Which of the board's corners, ascending.
    points_px : (n, 2) float64
    blur_px : float
        Standard deviation of the blur of the print's edges, median over the corners; nan if none could be fitted.
    fitted : float
        Share of the corners whose surroundings look like a corner of the print.
    """

    which: NDArray[np.int64]
    points_px: Points2
    blur_px: float
    fitted: float


class CalibrationBoard(Protocol):
    """A flat print with corners of known places."""

    @property
    def square_mm(self) -> float:
        """Size of a square."""
        ...

    @property
    def corners_mm(self) -> Points3:
        """All corners (n, 3), board frame, z = 0."""
        ...

    @property
    def neighbours(self) -> NDArray[np.int64]:
        """Pairs (m, 2) of corners that are one square apart."""
        ...

    @property
    def name(self) -> str:
        """What a message calls it, such as ``9x6 corners``."""
        ...

    def find(self, image: Frame) -> Corners | None:
        """The board's corners in an image, or None if too little of it is to be seen."""
        ...


def grid_mm(columns: int, rows: int, square_mm: float) -> Points3:
    """Places (rows * columns, 3) of a grid of corners; row after row, x fastest, z = 0."""
    places = np.zeros((rows, columns, 3))
    places[:, :, 0] = np.arange(columns) * square_mm
    places[:, :, 1] = np.arange(rows)[:, None] * square_mm
    return places.reshape(-1, 3)


def grid_neighbours(columns: int, rows: int) -> NDArray[np.int64]:
    """Pairs (m, 2) of neighbours in a grid numbered row after row."""
    number = np.arange(columns * rows).reshape(rows, columns)
    across = np.stack([number[:, :-1].ravel(), number[:, 1:].ravel()], axis=1)
    down = np.stack([number[:-1].ravel(), number[1:].ravel()], axis=1)
    return np.concatenate([across, down])


@dataclass(frozen=True)
class Pattern:
    """A chessboard: inner corners along x and y, and the size of a square.

    The board frame has its origin at the first inner corner, x along the columns, y along the rows and z out of
    the print. The first corner is the one whose inner square is black.
    """

    columns: int
    rows: int
    square_mm: float

    def __post_init__(self) -> None:
        if self.columns < 3 or self.rows < 3 or not self.square_mm > 0:
            raise ConfigError(
                f"board: expected at least 3x3 inner corners and a square above 0 mm, "
                f"got {self.columns}x{self.rows} and {self.square_mm} mm"
            )

    @property
    def corners_mm(self) -> Points3:
        """Inner corners (rows * columns, 3), board frame; row after row, x fastest."""
        return grid_mm(self.columns, self.rows, self.square_mm)

    @property
    def neighbours(self) -> NDArray[np.int64]:
        """Pairs (m, 2) of corners that are one square apart."""
        return grid_neighbours(self.columns, self.rows)

    @property
    def name(self) -> str:
        """What a message calls it."""
        return f"{self.columns}x{self.rows} corners"

    def find(self, image: Frame) -> Corners | None:
        """All corners, or None if the board is not in the image as a whole."""
        return _find(image, self)

    @property
    def asymmetric(self) -> bool:
        """Whether colours tell which way round the board lies."""
        return (self.columns + self.rows) % 2 == 1


def find_corners(image: Frame, pattern: Pattern) -> Points2 | None:
    """Sub-pixel inner corners of the board, or None if it is not in the image as a whole.

    Parameters
    ----------
    image : (rows, columns) uint8
        A view of the board.
    pattern : Pattern
        What to look for.

    Returns
    -------
    (pattern.rows * pattern.columns, 2) float64
        Corners in pixels in the order of `Pattern.corners_mm`.
    """
    found = _find(image, pattern)
    return None if found is None else found.points_px


def _find(image: Frame, pattern: Pattern) -> Corners | None:
    found, raw = cv2.findChessboardCorners(
        image, (pattern.columns, pattern.rows), flags=cv2.CALIB_CB_ADAPTIVE_THRESH | cv2.CALIB_CB_NORMALIZE_IMAGE
    )
    if not found:
        return None
    rough = np.ascontiguousarray(np.reshape(raw, (-1, 1, 2)), dtype=np.float32)
    grid = rough.reshape(pattern.rows, pattern.columns, 2)
    square_px = min(
        float(np.linalg.norm(np.diff(grid, axis=0), axis=2).min()),
        float(np.linalg.norm(np.diff(grid, axis=1), axis=2).min()),
    )
    half = int(np.clip(WINDOW_PER_SQUARE * square_px, MIN_WINDOW_PX, MAX_WINDOW_PX))
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    near = np.reshape(
        np.asarray(cv2.cornerSubPix(image, rough, (half, half), (-1, -1), criteria), dtype=np.float64),
        (pattern.rows, pattern.columns, 2),
    )
    along_x, along_y = (np.reshape(np.asarray(np.gradient(near, axis=axis)), (-1, 2)) for axis in (1, 0))
    fine, blur_px = refine_corners(image, near.reshape(-1, 2), along_x, along_y)
    points = in_board_order(image, fine.reshape(near.shape), pattern).reshape(-1, 2)
    fitted = np.isfinite(blur_px)
    blur = float(np.median(blur_px[fitted])) if fitted.any() else float("nan")
    return Corners(np.arange(len(points)), points, blur, float(fitted.mean()))


def in_board_order(image: Frame, grid: NDArray[np.float64], pattern: Pattern) -> NDArray[np.float64]:
    """Turn a detected grid (rows, columns, 2) so that z points to the camera and the first corner is the board's.

    Notes
    -----
    Where rows + columns is even the print looks the same after half a turn; x then points to the right of the
    image (or down, where it is nearer to vertical), which two upright cameras agree on.
    """
    along_x = np.diff(grid, axis=1).mean(axis=(0, 1))
    along_y = np.diff(grid, axis=0).mean(axis=(0, 1))
    if along_x[0] * along_y[1] - along_x[1] * along_y[0] > 0:  # v points down: this is a mirrored board
        grid = grid[::-1]
    if pattern.asymmetric:
        centres = 0.25 * (grid[:-1, :-1] + grid[1:, :-1] + grid[:-1, 1:] + grid[1:, 1:])
        u, v = (np.rint(centres[..., axis]).astype(np.int64) for axis in (0, 1))
        bright = image[np.clip(v, 0, image.shape[0] - 1), np.clip(u, 0, image.shape[1] - 1)].astype(np.float64)
        sign = np.where((np.indices(bright.shape).sum(axis=0) % 2) == 0, 1.0, -1.0)
        turned = bool((bright * sign).sum() - sign.sum() * bright.mean() > 0)
    else:
        main = int(abs(along_x[1]) > abs(along_x[0]))
        turned = bool(along_x[main] < 0)
    return grid[::-1, ::-1] if turned else grid
