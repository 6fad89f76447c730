"""The rendered chessboard has its corners where the camera model projects them, and the stripe where the laser is."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from echolume_drivers.emulated.board_image import (
    BLACK,
    WHITE,
    board_at,
    board_light,
    board_poses,
    corners,
    render_board,
)
from echolume_drivers.emulated.flaws import Lens
from echolume_drivers.emulated.optics import Side, optical_truth
from echolume_drivers.emulated.stripe_image import LENS_SIGMA_PX

SIDES: tuple[Side, Side] = ("left", "right")
SEED = 5
TRUTH = optical_truth(SEED)
POSES = board_poses(SEED)


def checker(x_mm: np.ndarray, y_mm: np.ndarray) -> np.ndarray:
    """The print itself, sharp: black where the sum of the square numbers is even."""
    even = (np.floor(x_mm / 20) + np.floor(y_mm / 20)) % 2 == 0
    return np.where(even, BLACK, WHITE)


def test_pose_0_lies_in_the_jig_and_defines_the_rig_frame() -> None:
    found = corners(board_at(POSES[0])).reshape(6, 9, 3)
    assert np.array_equal(POSES[0][:3, :3], np.eye(3))
    assert found[0, 0].tolist() == [-80, -50, 0]
    assert found[0, 8].tolist() == [80, -50, 0]
    assert found[5, 0].tolist() == [-80, 50, 0]


@pytest.mark.parametrize("seed", [0, 1, 2])
def test_all_poses_are_above_the_bench_tilted_all_around_and_in_view_of_both_cameras(seed: int) -> None:
    truth, poses = optical_truth(seed), board_poses(seed)
    assert len(poses) == 12
    directions = []
    for pose in poses[1:]:
        found = corners(board_at(pose))
        assert found[:, 2].min() > 0
        assert 9.9 < np.degrees(np.arccos(pose[2, 2])) < 25.1
        directions.append(np.arctan2(pose[1, 2], pose[0, 2]))
        for side in SIDES:
            pixels = truth.camera(side).project(found)
            assert np.all((pixels > 10) & (pixels < [1269, 1013]))
    assert np.diff(np.sort(directions)).max() < np.radians(75)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("pose", [0, 3, 8])
def test_pixels_around_a_corner_are_the_print_blurred_by_the_lens(side: Side, pose: int) -> None:
    camera, board = optical_truth(SEED, lens=Lens(focus_mm=None)).camera(side), board_at(POSES[pose])
    image = board_light(board, camera)
    offsets = np.linspace(-4, 4, 121) * LENS_SIGMA_PX
    du, dv = np.meshgrid(offsets, offsets)
    weight = np.exp(-0.5 * (du**2 + dv**2) / LENS_SIGMA_PX**2)
    weight /= weight.sum()
    up, origin = POSES[pose][:3, 2], POSES[pose][:3, 3]
    for corner in camera.project(corners(board))[[0, 8, 22, 31, 45, 53]]:
        c, r = np.round(corner).astype(int)
        differences = []
        for row, column in [(r, c), (r - 1, c), (r + 1, c + 1), (r, c - 2), (r + 2, c)]:
            pixels = np.stack([(column + du).ravel(), (row + dv).ravel()], axis=1)
            rays = np.concatenate([camera.normalised(pixels), np.ones((du.size, 1))], axis=1)
            ways = rays @ camera.camera_from_rig[:3, :3]
            t = (origin - camera.centre_mm) @ up / (ways @ up)
            local = (camera.centre_mm + t[:, None] * ways - origin) @ POSES[pose][:3, :3]
            seen = (checker(local[:, 0], local[:, 1]).reshape(du.shape) * weight).sum()
            a, b = camera.rays[row, column]
            differences.append(image[row, column] * (1 + a * a + b * b) ** 2 / POSES[pose][2, 2] - seen)
        assert np.abs(differences).max() < 0.015


@pytest.mark.parametrize("side", SIDES)
def test_opencv_finds_all_corners_where_they_are_projected(side: Side) -> None:
    errors = []
    for pose in POSES:
        image = np.rint(board_light(board_at(pose), TRUTH.camera(side)) * 240).astype(np.uint8)
        found, pixels = cv2.findChessboardCorners(image, (9, 6))
        assert found
        criteria = (cv2.TERM_CRITERIA_EPS + cv2.TERM_CRITERIA_COUNT, 100, 1e-4)
        pixels = cv2.cornerSubPix(image, pixels, (5, 5), (-1, -1), criteria).reshape(6, 9, 2)
        # Image rows run along -y, so the detector begins with the board's last row.
        exact = TRUTH.camera(side).project(corners(board_at(pose))).reshape(6, 9, 2)[::-1]
        errors.append(pixels - exact)
    assert np.sqrt(np.mean(np.square(errors))) < 0.025
    assert np.abs(np.mean(errors, axis=(0, 1, 2))).max() < 0.005


def test_noise_leaves_the_corners_within_a_twentieth_of_a_pixel() -> None:
    board = board_at(POSES[2])
    frame = render_board(board, TRUTH, "left", 0.0, np.random.default_rng(0), 8e-3, False)
    exact = TRUTH.left.project(corners(board)).astype(np.float32).reshape(-1, 1, 2)
    found = cv2.cornerSubPix(frame, exact.copy(), (5, 5), (-1, -1), (3, 50, 1e-4))
    assert np.sqrt(np.mean((found - exact) ** 2)) < 0.05
    assert 120 < np.percentile(frame, 99) < 255


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("pose", [0, 4, 9])
def test_the_stripe_on_the_board_lies_in_the_laser_plane(side: Side, pose: int) -> None:
    camera, x_mm = TRUTH.camera(side), 12.0
    frame = render_board(board_at(POSES[pose]), TRUTH, side, x_mm, np.random.default_rng(0), 4e-3, True).astype(float)
    bright = np.flatnonzero(frame.max(axis=1) > 80)
    crest = frame[bright].argmax(axis=1)
    window = np.clip(crest[:, None] + np.arange(-7, 8), 0, 1279)
    values = np.clip(frame[bright[:, None], window] - 6, 0, None)
    columns = (values * window).sum(axis=1) / values.sum(axis=1)
    rays = camera.normalised(np.stack([columns, bright.astype(float)], axis=1))
    ways = np.concatenate([rays, np.ones((len(rays), 1))], axis=1) @ camera.camera_from_rig[:3, :3]
    up, origin = POSES[pose][:3, 2], POSES[pose][:3, 3]
    t = (origin - camera.centre_mm) @ up / (ways @ up)
    points = camera.centre_mm + t[:, None] * ways
    off_mm = points @ TRUTH.laser_normal - TRUTH.plane_offset_mm(x_mm)
    assert len(bright) > 400
    assert abs(np.median(off_mm)) < 0.005
    assert np.median(np.abs(off_mm)) < 0.05


def test_black_squares_reflect_less_of_the_laser() -> None:
    frame = render_board(board_at(POSES[0]), TRUTH, "left", 30.0, np.random.default_rng(0), 4e-3, True)
    rows = TRUTH.left.project(np.array([[30.0, y, 0.0] for y in (-20.0, 0.0, 20.0, 40.0)]))[:, 1].round().astype(int)
    crests = [frame[row - 3 : row + 4].max() for row in rows]
    # x = 30 lies in square 5, so y = -20 (square 1) is black, and they alternate.
    assert max(crests[0], crests[2]) < 40
    assert min(crests[1], crests[3]) > 90
