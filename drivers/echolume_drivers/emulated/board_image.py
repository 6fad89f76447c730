"""Renders the calibration board, with or without the laser's stripe on it, through a camera with distortion."""

from __future__ import annotations

import math

import numba
import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.light_kernels import images
from echolume_drivers.emulated.optics import CameraTruth, OpticalTruth, Side, optical_truth
from echolume_drivers.emulated.sensor import expose
from echolume_drivers.emulated.stage import Board
from echolume_drivers.emulated.stripe_image import (
    LAMP_DN_PER_S,
    LENS_SIGMA_PX,
    STRIPE_DN_PER_S,
    sensor_of,
    stripe_light,
)
from echolume_messages.geometry import Matrix, apply, rotation_from_euler, transform
from echolume_messages.types import Frame

Floats = NDArray[np.float64]

COLUMNS, ROWS, SQUARE_MM = 9, 6, 20.0
"""Inner corners along the board's x and y, and the size of a square."""
WHITE, BLACK, BACKING = 0.9, 0.06, 0.55
"""Albedo of the print, and of the matte plate around it."""
BORDER_MM = 12.0
LASER_WIDTH_MM = 0.15

_LINE_MM = 170.0
_PER_MM = 8


def board_at(rig_from_board: Matrix) -> Board:
    """The rig's own board at a pose."""
    return Board(COLUMNS, ROWS, SQUARE_MM, rig_from_board)


def corners(board: Board) -> Floats:
    """Inner corners (rows * columns, 3) in mm, rig frame; row after row, x fastest.

    Notes
    -----
    The print is black where floor(x / square) + floor(y / square) is even. So the square outside the first corner
    is black and the one outside the last is white: which way round the board lies can be read off.
    """
    y, x = np.mgrid[0 : board.rows, 0 : board.columns].astype(np.float64) * board.square_mm
    return apply(board.rig_from_board, np.stack([x.ravel(), y.ravel(), np.zeros(x.size)], axis=1))


def board_poses(seed: int, count: int = 12) -> list[Matrix]:
    """Poses ``rig_from_board`` of a calibration session.

    Pose 0 lies flat in the jig, its corner grid centred on the rig's origin: it defines the rig frame. The others
    are tilted by 10 to 25 degrees all around and shifted as far as both cameras still see the whole print.
    """
    poses = [transform(np.eye(3), -_middle_mm())]
    rng = np.random.default_rng([seed, 0xB0A2D])
    truth = optical_truth(seed)
    for k in range(1, count):
        for attempt in range(400):
            shift = max(0.0, 1.0 - attempt / 200)
            tilt = math.radians(rng.uniform(10, 25))
            towards = 2 * math.pi * (k + rng.uniform(-0.3, 0.3)) / (count - 1)
            rotation = rotation_from_euler(tilt * math.cos(towards), tilt * math.sin(towards), rng.uniform(-0.2, 0.2))
            centre = np.array([rng.uniform(-40, 40) * shift, rng.uniform(-30, 30) * shift, rng.uniform(0, 15)])
            pose = transform(rotation, centre - rotation @ _middle_mm())
            pose[2, 3] += max(0.0, 2.0 - float(apply(pose, _print_outline())[:, 2].min()))
            if all(_sees(truth.camera(side), apply(pose, _print_outline())) for side in ("left", "right")):
                poses.append(pose)
                break
        else:
            raise ValueError(f"seed {seed}: no board pose {k} of {count} that both cameras see")
    return poses


def _middle_mm() -> Floats:
    return np.array([(COLUMNS - 1) * SQUARE_MM / 2, (ROWS - 1) * SQUARE_MM / 2, 0.0])


def _print_outline() -> Floats:
    """The print's outer corners (4, 3), half the white border with it, board frame."""
    low = -SQUARE_MM - BORDER_MM / 2
    x, y = COLUMNS * SQUARE_MM + BORDER_MM / 2, ROWS * SQUARE_MM + BORDER_MM / 2
    return np.array([[low, low, 0.0], [x, low, 0.0], [x, y, 0.0], [low, y, 0.0]])


def _sees(camera: CameraTruth, points_mm: Floats) -> bool:
    pixels = camera.project(points_mm)
    limit = np.array([camera.width_px, camera.height_px])
    return bool(np.all((pixels > 4) & (pixels < limit - 5)))


def render_board(
    board: Board,
    truth: OpticalTruth,
    side: Side,
    x_mm: float,
    rng: np.random.Generator,
    exposure_s: float,
    laser_on: bool,
) -> Frame:
    """A frame (rows, columns) of uint8 of the board, lit by the bench lamp or, with the laser on, by stripe and room.

    Notes
    -----
    Each pixel's undistorted ray is met with the board's plane, and the checker is evaluated there as blurred by the
    lens and, off the plane of focus, by its aperture: corners are exact far below 0.01 px. The board's backing plate
    is larger than the field.
    """
    camera = truth.camera(side)
    lamp = board_light(board, camera)
    even_dn = 0.0 if laser_on else LAMP_DN_PER_S * exposure_s
    lamp *= _room(camera, truth.flaws.ambient_gradient, truth.flaws.ambient_dn_per_s * exposure_s, even_dn)
    if laser_on:
        pieces, brightness = _stripe_pieces(board, truth, side, x_mm)
        laser, touched = stripe_light(pieces, brightness * (STRIPE_DN_PER_S * exposure_s), truth, side)
    else:
        laser, touched = np.zeros_like(lamp), np.zeros((lamp.shape[0], 2), dtype=np.int64)
    return expose(rng, lamp, laser, touched, sensor_of(truth, side, exposure_s))


def _room(camera: CameraTruth, gradient: tuple[float, float], room_dn: float, even_dn: float) -> NDArray[np.float32]:
    """Light on white (rows, columns): the room's, with its gradient, and even light."""
    u = np.linspace(-0.5, 0.5, camera.width_px, dtype=np.float32)
    v = np.linspace(-0.5, 0.5, camera.height_px, dtype=np.float32)
    uneven = (gradient[0] * u + gradient[1] * v[:, None]).astype(np.float32)
    return (room_dn + even_dn) + room_dn * uneven


def board_light(board: Board, camera: CameraTruth) -> NDArray[np.float32]:
    """Noiseless image (rows, columns) of the board under even light; 1 is white that faces the lamp above."""
    camera_from_board = camera.camera_from_rig @ board.rig_from_board
    board_from_ray = np.linalg.inv(camera_from_board[:3, [0, 1, 3]]).astype(np.float64)
    image = np.empty((camera.height_px, camera.width_px), dtype=np.float32)
    blur = np.array([LENS_SIGMA_PX, *camera.packed[21:23], camera.matrix[0, 0], camera.matrix[1, 1]])
    size = np.array([board.columns, board.rows], dtype=np.float64)
    _draw(camera.rays, board_from_ray, blur, size, board.square_mm, max(0.0, board.rig_from_board[2, 2]), image)
    return image


def _stripe_pieces(board: Board, truth: OpticalTruth, side: Side, x_mm: float) -> tuple[Floats, Floats]:
    """Images (n, 3) and brightness (n,) of the laser's line on the board's plane."""
    up = board.rig_from_board[:3, 2]
    origin = board.rig_from_board[:3, 3]
    normal, offset_mm = truth.laser_normal, truth.plane_offset_mm(x_mm)
    along = np.cross(normal, up)
    along *= np.sign(along[1]) / np.linalg.norm(along)
    # The point of both planes whose y is 0, to start from.
    planes = np.stack([normal, up, np.array([0.0, 1.0, 0.0])])
    start = np.linalg.solve(planes, np.array([offset_mm, float(up @ origin), 0.0]))
    t_mm = np.arange(-_LINE_MM * _PER_MM, _LINE_MM * _PER_MM + 1) / _PER_MM
    ends = start + t_mm[:, None] * along
    middle = 0.5 * (ends[:-1] + ends[1:])
    local = (middle - origin) @ board.rig_from_board[:3, :3]
    head = truth.head_mm(x_mm)
    way = head - middle
    far_mm = np.linalg.norm(way, axis=1)
    size = np.array([board.columns, board.rows], dtype=np.float64)
    albedo = _albedo_along(local[:, :2], LASER_WIDTH_MM, size, board.square_mm)
    brightness = albedo * np.maximum(way @ up / far_mm, 0.0) * head[2] / far_mm
    spans = np.concatenate([ends[:-1], ends[1:]], axis=1)
    return images(truth.camera(side).packed, spans, truth.stripe_sigma_px), brightness


@numba.njit(cache=True, nogil=True)
def _step(distance_mm: float, blur_mm: float) -> float:
    """From -1 to 1 over an edge at 0 that is blurred by a Gaussian."""
    t = distance_mm / (blur_mm * math.sqrt(2.0))
    if t > 4.0:
        return 1.0
    if t < -4.0:
        return -1.0
    return math.erf(t)


@numba.njit(cache=True, nogil=True)
def _edge(position_mm: float, edges: float, square_mm: float) -> float:
    """Number of the nearest of the inner edges, which lie at 0, 1, ... squares."""
    return min(max(math.floor(position_mm / square_mm + 0.5), 0.0), edges - 1.0)


@numba.njit(cache=True, nogil=True)
def _checker(
    x: float, y: float, blur_x: float, blur_y: float, slant: float, columns: float, rows: float, square_mm: float
) -> float:
    """The print without its border, 1 where black and -1 where white, blurred by an ellipse.

    `blur_x`, `blur_y` and `slant` are the ellipse's standard deviations in mm and its correlation. At a corner, the
    mean of the product of two correlated signs differs from the product of their means by the integral of the
    bivariate normal density over the correlation (R. L. Plackett, Biometrika 41, 1954, doi:10.1093/biomet/41.3-4.351).
    """
    i, j = _edge(x, columns, square_mm), _edge(y, rows, square_mm)
    sign = 1.0 if (i + j) % 2 == 0 else -1.0
    dx, dy = x - i * square_mm, y - j * square_mm
    value = _step(dx, blur_x) * _step(dy, blur_y)
    a, b = dx / blur_x, dy / blur_y
    if abs(a) < 5.0 and abs(b) < 5.0:
        for node, weight in ((0.1127016653792583, 5 / 18), (0.5, 8 / 18), (0.8872983346207417, 5 / 18)):
            r = slant * node
            rest = 1 - r * r
            density = math.exp(-0.5 * (a * a - 2 * r * a * b + b * b) / rest) / (2 * math.pi * math.sqrt(rest))
            value += 4 * slant * weight * density
    return sign * value


@numba.njit(cache=True, nogil=True)
def _within(position_mm: float, blur_mm: float, low_mm: float, high_mm: float) -> float:
    """1 between the limits, 0 outside."""
    return 0.25 * (1 + _step(position_mm - low_mm, blur_mm)) * (1 + _step(high_mm - position_mm, blur_mm))


@numba.njit(cache=True, nogil=True)
def _albedo(
    x: float, y: float, blur_x: float, blur_y: float, slant: float, columns: float, rows: float, square: float
) -> float:
    checker = _checker(x, y, blur_x, blur_y, slant, columns, rows, square)
    low, right, top = -square, columns * square, rows * square
    printed = _within(x, blur_x, low, right) * _within(y, blur_y, low, top)
    paper = _within(x, blur_x, low - BORDER_MM, right + BORDER_MM)
    paper *= _within(y, blur_y, low - BORDER_MM, top + BORDER_MM)
    around = paper * WHITE + (1 - paper) * BACKING
    return printed * (0.5 * (WHITE + BLACK) - 0.5 * (WHITE - BLACK) * checker) + (1 - printed) * around


@numba.njit(cache=True, nogil=True)
def _albedo_along(points: Floats, blur_mm: float, size: Floats, square_mm: float) -> Floats:
    out = np.empty(points.shape[0])
    for i in range(points.shape[0]):
        out[i] = _albedo(points[i, 0], points[i, 1], blur_mm, blur_mm, 0.0, size[0], size[1], square_mm)
    return out


@numba.njit(cache=True, nogil=True)
def _draw(
    rays: Floats,
    board_from_ray: Floats,
    blur: Floats,
    size: Floats,
    square_mm: float,
    facing: float,
    image: NDArray[np.float32],
) -> None:
    h = board_from_ray
    for row in range(image.shape[0]):
        for column in range(image.shape[1]):
            a, b = rays[row, column, 0], rays[row, column, 1]
            w = h[2, 0] * a + h[2, 1] * b + h[2, 2]
            x = (h[0, 0] * a + h[0, 1] * b + h[0, 2]) / w
            y = (h[1, 0] * a + h[1, 1] * b + h[1, 2]) / w
            # 1 / w is the distance along the optical axis.
            blur_px = math.sqrt(blur[0] ** 2 + (blur[1] * (1 - blur[2] * w)) ** 2)
            s_a, s_b = blur_px / blur[3], blur_px / blur[4]
            x_a, x_b = (h[0, 0] - x * h[2, 0]) / w * s_a, (h[0, 1] - x * h[2, 1]) / w * s_b
            y_a, y_b = (h[1, 0] - y * h[2, 0]) / w * s_a, (h[1, 1] - y * h[2, 1]) / w * s_b
            blur_x, blur_y = math.sqrt(x_a * x_a + x_b * x_b), math.sqrt(y_a * y_a + y_b * y_b)
            slant = (x_a * y_a + x_b * y_b) / (blur_x * blur_y)
            vignette = 1.0 / (1.0 + a * a + b * b) ** 2
            albedo = _albedo(x, y, blur_x, blur_y, slant, size[0], size[1], square_mm)
            image[row, column] = facing * vignette * albedo
