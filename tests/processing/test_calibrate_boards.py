"""Corners of drawn boards against where they were drawn; views that are of no use, by name."""

from __future__ import annotations

import re

import cv2
import numpy as np
import pytest

from echolume_messages.errors import CalibrationRejectedError, ConfigError
from echolume_processing.optical.acceptance import LeftOut, require_accepted, verdict
from echolume_processing.optical.board import Pattern
from echolume_processing.optical.calibrate import CameraPair, calibrate_cameras
from echolume_processing.optical.charuco import CharucoPattern
from echolume_processing.optical.corner_fit import refine_corners
from processing import board_render as render

CHESS = Pattern(9, 6, 20.0)
CHARUCO = CharucoPattern(9, 6, 20.0, 14.0)
PRINT = render.chess_print()
VIEWS = render.poses(8, PRINT)


def rms(values: np.ndarray) -> float:
    return float(np.sqrt(np.mean(values**2)))


@pytest.fixture(scope="module")
def images() -> tuple[list[np.ndarray], list[np.ndarray]]:
    return render.pairs(PRINT, VIEWS)


@pytest.fixture(scope="module")
def found(images: tuple[list[np.ndarray], list[np.ndarray]]) -> CameraPair:
    return calibrate_cameras(*images, CHESS)


@pytest.mark.parametrize("blur_px", [0.5, 0.8, 1.5])
def test_corners_are_found_to_three_hundredths_of_a_pixel_whatever_the_blur(blur_px: float) -> None:
    image, truth = render.draw(PRINT, render.RIGHT, VIEWS[2], np.random.default_rng(1), blur_px)
    corners = CHESS.find(image)
    assert corners is not None
    assert corners.points_px.dtype == np.float64
    order = np.arange(54).reshape(6, 9)[::-1].ravel()  # a chessboard counts its rows along y, from below
    assert rms(corners.points_px - truth[order]) < 0.03
    assert corners.fitted == 1.0
    assert corners.blur_px == pytest.approx(np.hypot(blur_px, 0.4), abs=0.2)


def test_the_fit_is_at_least_twice_as_good_as_gradient_refinement() -> None:
    image, truth = render.draw(PRINT, render.LEFT, VIEWS[1], np.random.default_rng(2), noise_dn=4.0)
    criteria = (cv2.TERM_CRITERIA_EPS | cv2.TERM_CRITERIA_MAX_ITER, 60, 1e-4)
    start = np.ascontiguousarray(truth[:, None] + 0.4, dtype=np.float32)
    usual = np.reshape(cv2.cornerSubPix(image, start, (5, 5), (-1, -1), criteria), (-1, 2))
    grid = truth.reshape(6, 9, 2)
    steps = [np.gradient(grid, axis=axis).reshape(-1, 2) for axis in (1, 0)]
    fitted, _ = refine_corners(image, truth + 0.4, *steps)
    assert rms(fitted - truth) < 0.5 * rms(usual - truth)


def test_where_there_is_no_corner_the_point_stays_and_has_no_blur() -> None:
    flat = np.full((60, 60), 90, dtype=np.uint8)
    start = np.array([[30.2, 29.7]])
    points, blur_px = refine_corners(flat, start, np.array([[20.0, 0.0]]), np.array([[0.0, 20.0]]))
    assert np.array_equal(points, start)
    assert np.isnan(blur_px[0])


def test_a_corner_at_the_rim_of_the_image_stays_within_it() -> None:
    image, truth = render.draw(PRINT, render.LEFT, VIEWS[0], np.random.default_rng(0))
    cut = image[int(truth[:, 1].min()) - 3 :, int(truth[:, 0].min()) - 3 :]
    shifted = truth - [int(truth[:, 0].min()) - 3, int(truth[:, 1].min()) - 3]
    steps = [np.gradient(shifted.reshape(6, 9, 2), axis=axis).reshape(-1, 2) for axis in (1, 0)]
    fitted, _ = refine_corners(np.ascontiguousarray(cut), shifted, *steps)
    assert np.abs(fitted - shifted).max() < 0.5


def test_the_cameras_are_recovered_from_a_chessboard(found: CameraPair) -> None:
    assert found.rejected == {}
    assert found.stereo_rms_px < 0.05
    assert found.baseline_mm == pytest.approx(np.linalg.norm(render.RIGHT_FROM_LEFT[:3, 3]), abs=0.15)
    for camera, truth in ((found.left, render.LEFT), (found.right, render.RIGHT)):
        assert camera.matrix[0, 0] == pytest.approx(truth.matrix[0, 0], rel=2e-3)
    assert found.square_mm[0] == pytest.approx(20.0, abs=0.01)


def test_the_cameras_lie_within_their_sigmas_of_the_truth(found: CameraPair) -> None:
    sigma = found.covariance.sigmas
    for side, camera, truth in (("left", found.left, render.LEFT), ("right", found.right, render.RIGHT)):
        for name, at in (("fx", (0, 0)), ("fy", (1, 1)), ("cx", (0, 2)), ("cy", (1, 2))):
            assert abs(camera.matrix[at] - truth.matrix[at]) < 4 * sigma[f"{side} {name}_px"]


def test_charuco_corners_of_a_part_of_the_board_carry_their_numbers() -> None:
    board = render.charuco_print(CHARUCO)
    image, truth = render.draw(board, render.LEFT, VIEWS[3], np.random.default_rng(3))
    image[:, :270] = 120  # a hand over the left part
    corners = CHARUCO.find(image)
    assert corners is not None
    assert 12 <= len(corners.which) < 54
    assert np.all(np.diff(corners.which) > 0)
    assert rms(corners.points_px - truth[corners.which]) < 0.05
    assert CHARUCO.find(np.full_like(image, 120)) is None


def test_our_places_of_charuco_corners_are_opencvs_with_y_up() -> None:
    theirs, _ = CHARUCO.board.matchImagePoints(np.zeros((54, 1, 2), np.float32), np.arange(54, dtype=np.int32)[:, None])
    ours = CHARUCO.corners_mm
    offset = np.reshape(theirs, (-1, 3)) * [1, -1, 1] - ours
    assert np.abs(offset - offset[0]).max() < 1e-4


def test_the_cameras_are_recovered_from_parts_of_a_charuco_board() -> None:
    left, right = render.pairs(render.charuco_print(CHARUCO), VIEWS[:6])
    left[1][:, :280] = 120
    right[4][300:] = 120
    pair = calibrate_cameras(left, right, CHARUCO)
    assert pair.rejected == {}
    assert sum(len(v.left_px) < 40 for v in pair.views) == 2
    assert pair.stereo_rms_px < 0.1
    assert pair.left.matrix[0, 0] == pytest.approx(800, rel=5e-3)
    assert pair.square_mm[0] == pytest.approx(20.0, abs=0.02)


@pytest.mark.parametrize(
    ("spoil", "reason"),
    [
        (lambda image: cv2.GaussianBlur(image, (0, 0), 4.0), r"the right image is blurred by 4\.\d px"),
        (lambda image: np.where(np.arange(640) < 330, 120, image).astype(np.uint8), "no 9x6 corners in the right"),
        (lambda image: np.roll(image, 5, axis=0), r"residual \d+\.\d+ px in cameras calibrated without it"),
    ],
    ids=["blurred", "half", "moved"],
)
def test_a_bad_view_is_named_and_left_out(images, spoil, reason: str, found: CameraPair) -> None:
    left, right = images
    spoilt = [spoil(image) if k == 5 else image for k, image in enumerate(right)]
    pair = calibrate_cameras(left, spoilt, CHESS)
    assert list(pair.rejected) == ["5"]
    assert re.search(reason, pair.rejected["5"])
    assert pair.stereo_rms_px < 0.05


@pytest.mark.parametrize(
    ("other", "reason"),
    [(render.chess_print(8, 5), "no 9x6 corners"), (render.chess_print(square_mm=19.0), "residual")],
    ids=["fewer squares", "smaller squares"],
)
def test_a_view_of_another_board_is_named_and_left_out(images, other: render.Print, reason: str) -> None:
    left, right = render.pairs(other, VIEWS[:1])
    pair = calibrate_cameras([*images[0][1:], *left], [*images[1][1:], *right], CHESS, names=list("abcdefgX"))
    assert list(pair.rejected) == ["X"]
    assert reason in pair.rejected["X"]


@pytest.mark.parametrize(
    ("tilt_rad", "reason"),
    [
        (0.0, "tilt the board by 15 degrees or more"),
        (0.025, r"camera's f[xy] to \d+ \+- \d+ px only, 0\.5% is"),
    ],
)
def test_views_that_are_all_alike_are_rejected_with_the_reason(tilt_rad: float, reason: str) -> None:
    left, right = render.pairs(PRINT, render.poses(5, PRINT, tilt_rad))
    with pytest.raises(CalibrationRejectedError, match=reason):
        calibrate_cameras(left, right, CHESS)


@pytest.mark.parametrize(
    ("px", "mm", "reason"),
    [
        (1.4, 0.1, r"without view b miss its corners by 1\.40 px, at most 1\.0 px"),
        (0.2, 1.3, r"without view b measure its corners 1\.300 mm off the board's shape, at most 1\.000 mm"),
    ],
)
def test_a_calibration_that_does_not_hold_for_a_view_left_out_is_rejected(px: float, mm: float, reason: str) -> None:
    left_out = LeftOut(["a", "b"], np.array([[0.1, 0.1], [px, 0.1]]), np.array([0.05, mm]))
    with pytest.raises(CalibrationRejectedError, match=reason):
        require_accepted(left_out, 20.0)


def test_the_verdict_tells_how_well_views_left_out_fit(found: CameraPair) -> None:
    assert found.left_out.names == [str(k) for k in range(8)]
    assert found.stereo_rms_px < found.left_out.rms_px < 1.5 * found.stereo_rms_px
    assert verdict(found.left_out).startswith("accepted: views left out in turn fit to 0.0")


@pytest.mark.parametrize(
    ("columns", "marker_mm", "dictionary", "reason"),
    [
        (9, 20.0, "DICT_5X5_100", "marker smaller than the square"),
        (9, 14.0, "DICT_NONE", "no dictionary"),
        (30, 14.0, "DICT_5X5_100", "needs 108 markers, DICT_5X5_100 has 100"),
    ],
)
def test_a_charuco_board_that_cannot_be_is_refused(
    columns: int, marker_mm: float, dictionary: str, reason: str
) -> None:
    with pytest.raises(ConfigError, match=reason):
        CharucoPattern(columns, 6, 20.0, marker_mm, dictionary)
