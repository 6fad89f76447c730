"""Boards drawn through a pinhole camera: a print's image, warped, blurred like a lens, with noise."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np

from echolume_messages import geometry
from echolume_processing.optical.board import grid_mm
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.charuco import CharucoPattern

PER_SQUARE = 60
FINER = 3
SIZE_PX = (640, 480)
MATRIX = np.array([[800.0, 0.0, 322.0], [0.0, 802.0, 238.0], [0.0, 0.0, 1.0]])
RIGHT_FROM_LEFT = geometry.transform(geometry.rotation_from_euler(0.01, 0.12, -0.005), np.array([-60.0, 1.0, 4.0]))
LEFT = Camera(MATRIX, np.zeros(5), np.eye(4))
RIGHT = Camera(MATRIX, np.zeros(5), RIGHT_FROM_LEFT)


@dataclass(frozen=True)
class Print:
    """A print and where the first corner of its grid lies in it; `PER_SQUARE` pixels a square, y downwards."""

    image: np.ndarray
    columns: int
    rows: int
    square_mm: float

    @property
    def grid_px(self) -> np.ndarray:
        """Corners (n, 2) in the print's image, row after row from the top."""
        margin = (np.array(self.image.shape[::-1]) - PER_SQUARE * np.array([self.columns + 1, self.rows + 1])) / 2
        return grid_mm(self.columns, self.rows, PER_SQUARE)[:, :2] + PER_SQUARE + margin - 0.5

    @property
    def grid_mm(self) -> np.ndarray:
        """The same corners (n, 3) on the board: x to the right, y up, z out of the print."""
        grid = grid_mm(self.columns, self.rows, self.square_mm)
        grid[:, 1] = (self.rows - 1) * self.square_mm - grid[:, 1]
        return grid


def chess_print(columns: int = 9, rows: int = 6, square_mm: float = 20.0) -> Print:
    """A chessboard with a white rim; the square inside the corner at the lower left is black."""
    j, i = np.indices((rows + 1, columns + 1))
    squares = (i + j + rows) % 2 * 255
    image = np.kron(squares, np.ones((PER_SQUARE, PER_SQUARE))).astype(np.uint8)
    return Print(np.pad(image, PER_SQUARE // 2, constant_values=255), columns, rows, square_mm)


def charuco_print(board: CharucoPattern) -> Print:
    """The image that OpenCV prints for the board."""
    size = (PER_SQUARE * (board.columns + 1), PER_SQUARE * (board.rows + 1))
    image = np.asarray(board.board.generateImage(size, marginSize=0), dtype=np.uint8)
    return Print(np.pad(image, PER_SQUARE // 2, constant_values=255), board.columns, board.rows, board.square_mm)


def draw(
    board: Print,
    camera: Camera,
    pose: np.ndarray,
    rng: np.random.Generator,
    blur_px: float = 0.7,
    noise_dn: float = 1.5,
) -> tuple[np.ndarray, np.ndarray]:
    """Image (480, 640) and true corners (n, 2) of a board at the pose ``left_from_board``."""
    truth = camera.project(geometry.apply(pose, board.grid_mm))
    homography, _ = cv2.findHomography(board.grid_px, truth)
    finer = np.array([[FINER, 0, (FINER - 1) / 2], [0, FINER, (FINER - 1) / 2], [0, 0, 1.0]])
    size = (SIZE_PX[0] * FINER, SIZE_PX[1] * FINER)
    large = cv2.warpPerspective(board.image, finer @ homography, size, flags=cv2.INTER_LINEAR, borderValue=150)
    image = cv2.resize(large, SIZE_PX, interpolation=cv2.INTER_AREA).astype(np.float64)
    image = cv2.GaussianBlur(image, (0, 0), blur_px) * 0.75 + 25 + rng.normal(0, noise_dn, image.shape)
    return np.clip(image, 0, 255).astype(np.uint8), truth


def poses(count: int, board: Print, tilt_rad: float = 0.35) -> list[np.ndarray]:
    """``left_from_board`` in view of both cameras, the print facing them, tilted all around."""
    middle = board.grid_mm.mean(axis=0)
    out = []
    for k in range(count):
        towards = 2 * np.pi * k / count
        facing = np.diag([1.0, -1.0, -1.0])
        tilted = geometry.rotation_from_euler(
            tilt_rad * np.cos(towards), tilt_rad * np.sin(towards), 0.05 * (k % 3 - 1)
        )
        centre = np.array([30 + 35 * np.cos(2.4 * k), 25 * np.sin(2.4 * k), 420.0 + 25 * (k % 3)])
        rotation = tilted @ facing
        out.append(geometry.transform(rotation, centre - rotation @ middle))
    return out


def pairs(
    board: Print, views: Sequence[np.ndarray], seed: int = 0, blur_px: float = 0.7
) -> tuple[list[np.ndarray], list[np.ndarray]]:
    """Left and right images of the board at each pose."""
    rng = np.random.default_rng(seed)
    drawn = [[draw(board, camera, pose, rng, blur_px)[0] for pose in views] for camera in (LEFT, RIGHT)]
    return drawn[0], drawn[1]
