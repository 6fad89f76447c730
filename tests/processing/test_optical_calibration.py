"""Calibration from emulated boards and stripes against the emulated rig's truth."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated import board_image
from echolume_drivers.emulated.optics import optical_truth
from echolume_messages import topics
from echolume_messages.bus.message import Message
from echolume_messages.errors import CalibrationRejectedError, ConfigError
from echolume_processing.optical import triangulate
from echolume_processing.optical.board import Pattern, find_corners, in_board_order
from echolume_processing.optical.calibrate import calibrate_cameras
from echolume_processing.optical.calibrate_rig import OpticsCalibration, calibrate_optics
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.laser import StripeOnBoard, fit_laser
from processing.calibration_scan import calibration_records

SEED = 1
TRUTH = optical_truth(SEED)
BOARD = Pattern(9, 6, 20.0)


@pytest.fixture(scope="module")
def records() -> list[Message]:
    return list(calibration_records(SEED))


@pytest.fixture(scope="module")
def found(records: list[Message]) -> OpticsCalibration:
    return calibrate_optics(records)


def field_points() -> np.ndarray:
    """Points over the whole field that both cameras see."""
    axes = np.meshgrid(np.arange(-100, 101, 20.0), np.arange(-90, 91, 20.0), (0.0, 20.0, 40.0))
    points = np.stack([a.ravel() for a in axes], axis=1)
    limit = np.array([TRUTH.left.width_px - 1, TRUTH.left.height_px - 1])
    seen = [np.all((px > 0) & (px < limit), axis=1) for px in (TRUTH.left.project(points), TRUTH.right.project(points))]
    return points[seen[0] & seen[1]]


def board_images(records: Sequence[Message]) -> tuple[list[np.ndarray], list[np.ndarray]]:
    boards = [m for m in records if m.header.pass_name.startswith("board-")]
    sides = tuple(
        [m.payload for m in boards if m.topic == topic] for topic in (topics.CAMERA_LEFT, topics.CAMERA_RIGHT)
    )
    return sides[0], sides[1]


def synthetic_stripes(
    heights_mm: Sequence[float],
    guide_mm: Sequence[float],
    noise_mm: float = 0.03,
    tilt: float = 0.25,
    per_guide: float = 1.0,
) -> list[StripeOnBoard]:
    """Stripes of the plane x = 0.5 + s + 0.004 y - 0.003 z on boards that tilt along y."""
    rng = np.random.default_rng(0)
    stripes = []
    for k, height in enumerate(heights_mm):
        for s in guide_mm:
            y = np.linspace(-50, 50, 80)
            z = height + tilt * (k % 3 - 1) * y
            x = 0.5 + per_guide * s + 0.004 * y - 0.003 * z + rng.normal(0, noise_mm, len(y))
            stripes.append(StripeOnBoard(f"{k:02d}", s, np.column_stack([x, y, z])))
    return stripes


def test_corners_are_found_in_the_boards_own_order() -> None:
    pose = board_image.board_poses(SEED, 3)[2]
    board = board_image.board_at(pose)
    image = board_image.render_board(board, TRUTH, "right", 0.0, np.random.default_rng(0), 8e-3, False)
    corners = find_corners(image, BOARD)
    assert corners is not None
    assert corners.dtype == np.float64
    assert np.sqrt(np.mean((corners - TRUTH.right.project(board_image.corners(board))) ** 2)) < 0.05


@pytest.mark.parametrize("turn", range(4))
def test_the_order_does_not_depend_on_where_the_detector_starts(records: list[Message], turn: int) -> None:
    image = board_images(records)[0][1]
    grid = find_corners(image, BOARD).reshape(6, 9, 2)
    started = {0: grid, 1: grid[::-1], 2: grid[:, ::-1], 3: grid[::-1, ::-1]}[turn]
    assert np.array_equal(in_board_order(image, started, BOARD), grid)


def test_a_board_that_looks_the_same_upside_down_is_ordered_by_the_image(records: list[Message]) -> None:
    image = board_images(records)[0][1]
    grid = find_corners(image, BOARD).reshape(6, 9, 2)[:, :8]
    assert np.array_equal(in_board_order(image, grid[::-1, ::-1], Pattern(8, 6, 20.0)), grid)


def test_no_board_no_corners() -> None:
    assert find_corners(np.full((200, 300), 90, dtype=np.uint8), BOARD) is None


def test_every_emulated_view_is_used(found: OpticsCalibration) -> None:
    assert len(found.report.views) == 7
    assert found.report.rejected == {}
    assert found.left.rms_px < 0.06
    assert found.right.rms_px < 0.06
    assert found.stereo_rms_px < 0.06
    assert found.report.square_mean_mm == pytest.approx(20.0, abs=0.005)


def test_calibrated_cameras_reproject_the_field_within_a_tenth_of_a_pixel(found: OpticsCalibration) -> None:
    points = field_points()
    for calibration, truth in ((found.left, TRUTH.left), (found.right, TRUTH.right)):
        error_px = Camera.of(calibration).project(points) - truth.project(points)
        assert np.abs(error_px).max() < 0.2
        assert np.sqrt(np.mean(error_px**2)) < 0.1


def test_calibrated_triangulation_is_within_a_tenth_of_a_millimetre_over_the_field(found: OpticsCalibration) -> None:
    points = field_points()
    cameras = Camera.of(found.left), Camera.of(found.right)
    left, right = (
        c.undistort(t.project(points)) for c, t in zip(cameras, (TRUTH.left, TRUTH.right), strict=True)
    )  # fmt: skip
    stereo = triangulate.stereo(cameras[0].projection, cameras[1].projection, left, right)
    assert np.abs(stereo - points).max() < 0.1
    normal = np.array(found.laser.normal)
    per_guide = normal @ np.array(found.laser.guide_direction)
    for camera, image in zip(cameras, (left, right), strict=True):
        for k in range(0, len(points), 7):
            s = (points[k] @ TRUTH.laser_normal - TRUTH.laser_offset_mm) / (TRUTH.laser_normal @ TRUTH.guide_direction)
            rays = camera.rays(image[k : k + 1])
            active = triangulate.active_plane(camera.centre_mm, rays, normal, found.laser.offset_mm + s * per_guide)
            assert np.abs(active[0] - points[k]).max() < 0.1


def test_focal_lengths_and_the_laser_plane_are_recovered(found: OpticsCalibration) -> None:
    for calibration, truth in ((found.left, TRUTH.left), (found.right, TRUTH.right)):
        assert calibration.matrix[0, 0] == pytest.approx(truth.matrix[0, 0], rel=1e-3)
        assert np.linalg.norm(Camera.of(calibration).centre_mm - truth.centre_mm) < 0.5
    assert np.allclose(found.laser.normal, TRUTH.laser_normal, atol=3e-4)
    assert found.laser.offset_mm == pytest.approx(TRUTH.laser_offset_mm, abs=0.02)
    assert found.laser.rms_mm < 0.06
    assert found.report.plane_leave_one_out_mm < 0.03


def test_a_board_the_other_way_round_in_the_jig_gives_the_same_rig_frame() -> None:
    turned = calibrate_optics(calibration_records(SEED, boards=4, upside_down=True))
    assert turned.report.turned
    assert np.linalg.norm(Camera.of(turned.left).centre_mm - TRUTH.left.centre_mm) < 0.5
    assert np.allclose(turned.laser.normal, TRUTH.laser_normal, atol=3e-4)


def test_the_same_records_give_the_same_bits(records: list[Message], found: OpticsCalibration) -> None:
    assert all(msgspec.json.encode(calibrate_optics(records)[:4]) == msgspec.json.encode(found[:4]) for _ in range(3))


def test_the_order_of_records_does_not_matter(records: list[Message], found: OpticsCalibration) -> None:
    again = calibrate_optics(sorted(records, key=lambda m: (m.topic.name, m.header.seq)))
    assert msgspec.json.encode(again.laser) == msgspec.json.encode(found.laser)
    assert msgspec.json.encode(again.left) == msgspec.json.encode(found.left)


def test_an_attempt_that_failed_half_way_is_replaced(records: list[Message], found: OpticsCalibration) -> None:
    spoilt = [
        Message(msgspec.structs.replace(m.header, attempt=1), m.topic, m.payload) if m.header.trigger == 1 else m
        for m in records
    ]
    first = next(m for m in records if m.header.trigger == 1)
    again = calibrate_optics([Message(first.header, first.topic, np.zeros_like(first.payload)), *spoilt])
    assert msgspec.json.encode(again.laser) == msgspec.json.encode(found.laser)


def test_a_view_without_a_board_is_named_and_left_out(records: list[Message]) -> None:
    blank = [
        dataclasses.replace(m, payload=np.full_like(m.payload, 40))
        if (m.header.pass_name, m.topic) == ("board-03", topics.CAMERA_RIGHT)
        else m
        for m in records
    ]
    found = calibrate_optics(blank)
    assert found.report.rejected == {"board-03": "no 9x6 corners in the right image"}
    assert len(found.report.views) == 6


def test_a_view_whose_board_moved_between_the_cameras_is_named_and_left_out(records: list[Message]) -> None:
    left, right = board_images(records)
    right = [np.roll(image, 4, axis=0) if k == 5 else image for k, image in enumerate(right)]
    found = calibrate_cameras(left, right, (9, 6), 20.0)
    assert list(found.rejected) == ["5"]
    assert "residual" in found.rejected["5"]
    assert found.stereo_rms_px < 0.06


def test_without_the_board_in_the_jig_there_is_no_rig_frame(records: list[Message]) -> None:
    with pytest.raises(CalibrationRejectedError, match=r"pose `board-00` defines the rig frame.*the pass is missing"):
        calibrate_optics(m for m in records if m.header.pass_name not in ("board-00", "laser-00"))


def test_an_archive_of_another_scan_is_refused() -> None:
    with pytest.raises(CalibrationRejectedError, match="is this the archive of a calibration scan"):
        calibrate_optics([])


def test_too_few_views_are_refused_with_their_reasons(records: list[Message]) -> None:
    left, right = board_images(records)
    with pytest.raises(CalibrationRejectedError, match=r"3 usable views of the board, needs 4.*3: no 9x6 corners"):
        calibrate_cameras([*left[:3], left[0]], [*right[:3], np.zeros_like(right[0])])


def test_the_laser_plane_is_recovered_through_outliers() -> None:
    stripes = synthetic_stripes((0, 10, 20, 5, 15), (-40, 0, 40))
    stripes[4].points_mm[:25, 0] += 8.0
    fit = fit_laser(stripes)
    normal = np.array([1, -0.004, 0.003]) / np.sqrt(1 + 0.004**2 + 0.003**2)
    assert np.allclose(fit.calibration.normal, normal, atol=2e-4)
    assert fit.calibration.offset_mm == pytest.approx(0.5, abs=0.01)
    assert fit.calibration.rms_mm == pytest.approx(0.03, rel=0.2)
    assert np.dot(fit.calibration.normal, fit.calibration.guide_direction) == pytest.approx(normal[0], abs=1e-3)


@pytest.mark.parametrize(
    ("stripes", "reason"),
    [
        (synthetic_stripes((0, 0, 0, 0), (-40, 0, 40), tilt=0.0), r"height \(z\) varies by only 0.00 mm"),
        (synthetic_stripes((0, 10, 20, 5), (7,)), "guide position varies by only 0.00 mm"),
        (synthetic_stripes((0,), (7, 8)), "2 of 2 stripes have 20 points on a board, needs 4"),
        (synthetic_stripes((0, 10, 20, 5), (-40, 0, 40), noise_mm=1.0), "mm from the best plane"),
        (synthetic_stripes((0, 10, 20, 5), (-40, 0, 40), per_guide=2.0), "moves 2.000 mm per mm of the guide"),
    ],
    ids=["flat", "one guide position", "few", "noisy", "wrong scale"],
)
def test_stripes_that_do_not_determine_the_plane_are_refused(stripes: list[StripeOnBoard], reason: str) -> None:
    with pytest.raises(CalibrationRejectedError, match=reason):
        fit_laser(stripes)


def test_a_board_without_corners_is_refused() -> None:
    with pytest.raises(ConfigError, match="at least 3x3 inner corners"):
        Pattern(2, 6, 20.0)
