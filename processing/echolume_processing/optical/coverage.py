"""Which parts of the field and which tilts of the board a set of views still lacks."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from echolume_processing.optical.board import CalibrationBoard
from echolume_processing.optical.pair_solver import BoardView

Flags = NDArray[np.bool_]

WANTED_VIEWS = 10
CELLS = 3
CORNERS_IN_CELL = 2
MIN_TILT = 0.03
"""Relative change of scale across the board that counts as a tilt."""
MIN_MOVE = 0.03
"""Share of the image's width: a board that moved by less, and is not tilted otherwise, is the same view."""
_ROWS = ("top", "middle", "bottom")
_COLUMNS = ("left", "centre", "right")
TILTS = ("left side", "right side", "top", "bottom")


@dataclass
class Coverage:
    """Views taken so far.

    Attributes
    ----------
    board : CalibrationBoard
    size_px : (int, int)
        Columns and rows of the images.
    views : list of BoardView
    """

    board: CalibrationBoard
    size_px: tuple[int, int]
    views: list[BoardView] = field(default_factory=list[BoardView])
    _cells: Flags = field(default_factory=lambda: np.zeros((2, CELLS, CELLS), dtype=np.bool_))
    _tilts: Flags = field(default_factory=lambda: np.zeros(len(TILTS), dtype=np.bool_))

    def add(self, view: BoardView) -> bool:
        """Take a view; False if the board stands as in one that was taken before."""
        if any(self._same(view, other) for other in self.views):
            return False
        self.views.append(view)
        size = np.array(self.size_px, dtype=np.float64)
        for side, points in enumerate((view.left_px, view.right_px)):
            cell = np.clip((points / size * CELLS).astype(np.int64), 0, CELLS - 1)
            count = np.zeros((CELLS, CELLS), dtype=np.int64)
            np.add.at(count, (cell[:, 1], cell[:, 0]), 1)
            self._cells[side] |= count >= CORNERS_IN_CELL
        x, y = self.recession(view)
        self._tilts |= np.array([x < -MIN_TILT, x > MIN_TILT, y < -MIN_TILT, y > MIN_TILT])
        return True

    def recession(self, view: BoardView) -> tuple[float, float]:
        """Towards which side of the images the board goes away, and by how much (relative change of scale).

        Notes
        -----
        The mean of both cameras: two that converge see a flat board tilted in opposite ways.
        """
        shape = view.shape_mm(self.board)[:, :2]
        found = [_scale_change(shape, points) for points in (view.left_px, view.right_px)]
        x, y = np.mean(found, axis=0)
        return float(x), float(y)

    @property
    def missing(self) -> list[str]:
        """What is still to be covered, in words; empty when all is."""
        out: list[str] = []
        for side, cells in zip(("left", "right"), self._cells, strict=True):
            empty = [f"{_ROWS[r]} {_COLUMNS[c]}" for r, c in np.argwhere(~cells)]
            if empty:
                out.append(f"{side} image: board at {', '.join(empty)}")
        out += [f"board tilted so that its {TILTS[k]} goes away" for k in np.nonzero(~self._tilts)[0]]
        if len(self.views) < WANTED_VIEWS:
            out.append(f"{WANTED_VIEWS - len(self.views)} more views")
        return out

    def _same(self, one: BoardView, other: BoardView) -> bool:
        moved = 0.0
        for a, b in ((one.left_px, other.left_px), (one.right_px, other.right_px)):
            if a.shape != b.shape:
                return False
            moved = max(moved, float(np.linalg.norm(a - b, axis=1).max()))
        turned = np.abs(np.subtract(self.recession(one), self.recession(other))).max()
        return moved < MIN_MOVE * self.size_px[0] and bool(turned < MIN_TILT)


def _scale_change(shape: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share (2,) by which distance grows from one end of the board to the other, towards the image's u and v.

    Notes
    -----
    A homography's denominator is proportional to the depth of the board's points: fitted linearly (DLT), it is
    followed over the extent of the board and turned into the image by the homography's own direction.
    """
    middle, size = shape.mean(axis=0), float(np.ptp(shape, axis=0).max())
    x, y = ((shape - middle) / size).T
    centre, spread = points.mean(axis=0), float(np.ptp(points, axis=0).max())
    u, v = ((points - centre) / spread).T
    one, nil = np.ones_like(x), np.zeros_like(x)
    rows = np.concatenate(
        [
            np.column_stack([x, y, one, nil, nil, nil, -u * x, -u * y, -u]),
            np.column_stack([nil, nil, nil, x, y, one, -v * x, -v * y, -v]),
        ]
    )
    h = np.linalg.svd(rows)[2][-1].reshape(3, 3)
    h /= h[2, 2]
    gradient = h[2, :2]  # of the depth along x and y, relative to the depth at the middle
    turn = h[:2, :2] - np.outer(h[:2, 2], gradient)  # from board to image at the middle
    back = np.linalg.inv(turn / np.sqrt(abs(float(np.linalg.det(turn)))))
    return np.asarray(gradient @ back, dtype=np.float64)
