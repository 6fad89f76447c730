"""Joint triangulation, covariances, correspondence, verdicts: known answers, Monte Carlo, NEES of emulated stripes."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import Material, SceneBuilder, matte, plate
from echolume_drivers.emulated.stripe_image import render_stripe, true_stripe
from echolume_messages.calibration import CameraCalibration
from echolume_messages.types import Frame, OpticalSource
from echolume_processing.optical import covariance, triangulate
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.candidates import Candidates, candidates_of, view_of
from echolume_processing.optical.correspond import walk
from echolume_processing.optical.pipeline import OpticalPipeline, OpticalSettings
from echolume_processing.optical.select import Verdict
from echolume_processing.optical.stripe import extract
from processing.test_optical_pipeline import camera_of, laser_of

TRUTH = optical_truth(1)
CAMERAS = tuple(Camera(c.matrix, c.distortion, c.camera_from_rig) for c in (TRUTH.left, TRUTH.right))
M = CAMERAS[0].projection, CAMERAS[1].projection
VIEWS = view_of(CAMERAS[0], CAMERAS[1]), view_of(CAMERAS[1], CAMERAS[0])
NORMAL, DISTANCE_MM = TRUTH.laser_normal, 12.0
GATES_MM = np.array([-8.0, 80.0, -130.0, 130.0])


def plane_points(n: int) -> np.ndarray:
    """Points (n, 3) of the laser plane within the field."""
    points = np.random.default_rng(0).uniform([0, -90, 0], [0, 90, 40], (n, 3))
    return points - np.outer(points @ NORMAL - DISTANCE_MM, NORMAL)


def columns_of(points: np.ndarray) -> np.ndarray:
    """Undistorted image points (4, n): u, v of the left camera, then of the right."""
    return np.concatenate([camera.undistort(camera.project(points)).T for camera in CAMERAS])


def pair(scene: object, x_mm: float, seed: int = 0) -> list[Frame]:
    rng = np.random.default_rng(seed)
    return [render_stripe(scene, TRUTH, side, x_mm, rng, 4e-3, True) for side in ("left", "right")]


@pytest.fixture(scope="module")
def pipeline() -> OpticalPipeline:
    return OpticalPipeline.of(camera_of(TRUTH.left), camera_of(TRUTH.right), laser_of())


def test_both_layouts_of_the_closed_forms_agree() -> None:
    seen = columns_of(plane_points(300)) + np.random.default_rng(1).normal(0, 0.1, (4, 300))
    rows = triangulate.stereo(*M, np.ascontiguousarray(seen[:2].T), np.ascontiguousarray(seen[2:].T))
    assert np.allclose(triangulate.stereo_columns(*M, seen), rows.T, atol=1e-9)
    plane = triangulate.plane_from_pixel(CAMERAS[1].centre_mm, CAMERAS[1].ray_matrix, NORMAL, DISTANCE_MM)
    rows = triangulate.active(plane, np.ascontiguousarray(seen[2:].T))
    assert np.allclose(triangulate.active_columns(plane, seen[2:]), rows.T, atol=1e-9)
    assert np.abs(rows @ NORMAL - DISTANCE_MM).max() < 1e-9


def test_with_a_hard_plane_joint_points_lie_on_it_and_z_is_the_weighted_mean_of_both_cameras() -> None:
    points = plane_points(300)
    seen = columns_of(points)
    seen[0] += np.random.default_rng(2).normal(0, 0.05, 300)
    seen[2] += np.random.default_rng(3).normal(0, 0.2, 300)
    stereo = triangulate.stereo_columns(*M, seen)
    own = covariance.stereo_covariance(*M, stereo, np.full(300, 0.05), np.full(300, 0.2), 1e-4)
    drawn, after = covariance.joint(stereo, own, NORMAL, DISTANCE_MM, 0.0)
    assert np.abs(NORMAL @ drawn - DISTANCE_MM).max() < 1e-10
    assert np.abs(np.einsum("i,ijn->jn", NORMAL, np.moveaxis(covariance.full(after), 0, 2))).max() < 1e-12
    planes = [triangulate.plane_from_pixel(v.centre_mm, v.ray_matrix, NORMAL, DISTANCE_MM) for v in VIEWS]
    left_z, right_z = (triangulate.active_columns(planes[i], seen[2 * i : 2 * i + 2])[2] for i in (0, 1))
    variances = [
        covariance.active_covariance(M[i], NORMAL, stereo, np.full(300, s), 1e-4, 0.0)[5]
        for i, s in enumerate((0.05, 0.2))
    ]
    mean_z = (left_z / variances[0] + right_z / variances[1]) / (1 / variances[0] + 1 / variances[1])
    assert np.allclose(drawn[2], mean_z, atol=2e-3)
    assert np.std(drawn[2] - points[:, 2]) < 0.5 * np.std(stereo[2] - points[:, 2])


def test_a_plane_known_to_nothing_leaves_stereo_points_where_they_are() -> None:
    points = plane_points(50).T
    own = covariance.stereo_covariance(*M, points, np.full(50, 0.1), np.full(50, 0.1), 0.01)
    drawn, after = covariance.joint(points + 0.3, own, NORMAL, DISTANCE_MM, 1e4)
    assert np.allclose(drawn, points + 0.3, atol=1e-6)
    assert np.allclose(after, own, rtol=1e-6)


def test_covariances_are_those_of_ten_thousand_draws() -> None:
    n, rng = 20_000, np.random.default_rng(4)
    point = np.array([[DISTANCE_MM, 55.0, 21.0]])
    point -= (point @ NORMAL - DISTANCE_MM)[:, None] * NORMAL
    exact = np.repeat(columns_of(point), n, axis=1)
    sigma_left, sigma_right, sigma_v, sigma_plane = 0.08, 0.15, 0.03, 0.04
    left = exact[:2] + rng.normal(0, 1, (2, n)) * [[sigma_left], [sigma_v]]
    right_column = exact[2] + rng.normal(0, sigma_right, n)
    # The right point lies on the left one's epipolar line, as the walk finds it.
    line = VIEWS[0].f_to_other @ np.vstack([left, np.ones(n)])
    right_row = -(line[0] * right_column + line[2]) / line[1]
    stereo = triangulate.stereo_columns(*M, np.vstack([left, right_column, right_row]))
    centre = VIEWS[0].centre_mm
    slant = VIEWS[0].ray_matrix @ np.vstack([left, np.ones(n)])
    shifted = DISTANCE_MM + rng.normal(0, sigma_plane, n)
    active = centre[:, None] + (shifted - NORMAL @ centre) / (NORMAL @ slant) * slant
    stated = (
        covariance.stereo_covariance(*M, point.T, np.array([sigma_left]), np.array([sigma_right]), sigma_v),
        covariance.active_covariance(M[0], NORMAL, point.T, np.array([sigma_left]), sigma_v, sigma_plane),
    )
    for drawn, own in zip((stereo, active), stated, strict=True):
        expected = covariance.full(own)[0]
        scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
        assert np.abs((np.cov(drawn) - expected) / scale).max() < 0.04


def test_joint_covariance_is_smaller_than_either() -> None:
    points = plane_points(40).T
    sigma = np.full(40, 0.1)
    own = covariance.stereo_covariance(*M, points, sigma, sigma, 0.01)
    _, both = covariance.joint(points, own, NORMAL, DISTANCE_MM, 0.03)
    active = covariance.active_covariance(M[0], NORMAL, points, sigma, 0.01, 0.03)
    for larger in (own, active):
        assert np.linalg.eigvalsh(covariance.full(larger) - covariance.full(both)).min() > -1e-12


STRIPES = 24
JOINT = 9
"""Beside the sources of published points."""


def moved(camera: CameraCalibration, u_px: float, v_px: float) -> CameraCalibration:
    """A calibration whose image centre is off."""
    rows = [list(row) for row in camera.camera_matrix]
    rows[0][2] += u_px
    rows[1][2] += v_px
    return msgspec.structs.replace(camera, camera_matrix=rows, rms_px=0.04)


def test_covariances_of_emulated_stripes_are_honest() -> None:
    """Planes are 0.02 mm and cameras 0.01 px off, otherwise for each stripe; NEES averages to one."""
    off_mm = 0.02 * np.random.default_rng(0).choice([-1, 1], STRIPES)
    off_px = 0.01 * np.random.default_rng(1).choice([-1, 1], (STRIPES, 4))
    nees: dict[int, list[np.ndarray]] = {
        source: [] for source in (OpticalSource.STEREO, OpticalSource.ACTIVE_LEFT, JOINT)
    }
    for i, x_mm in enumerate(np.linspace(-90, 90, STRIPES)):
        scene = (matte, plate)[i % 2]()
        left, right = moved(camera_of(TRUTH.left), *off_px[i, :2]), moved(camera_of(TRUTH.right), *off_px[i, 2:])
        pipeline = OpticalPipeline.of(left, right, laser_of(), OpticalSettings(plane_sigma_mm=0.02, guide_sigma_mm=0.0))
        seen = pipeline.measure(*pair(scene, x_mm, i), x_mm + off_mm[i])
        column = true_stripe(scene, TRUTH, "left", x_mm).rows(1024)
        plane = triangulate.plane_from_pixel(
            VIEWS[0].centre_mm, VIEWS[0].ray_matrix, NORMAL, TRUTH.plane_offset_mm(x_mm)
        )
        lit = triangulate.active(plane, CAMERAS[0].undistort(np.column_stack([column, np.arange(1024.0)])))
        edge = np.any([np.abs(np.roll(lit[:, 2], k) - lit[:, 2]) >= 1 for k in range(-6, 7)], axis=0)
        rows = seen.points["row"][seen.points["source"] == OpticalSource.STEREO]
        placed = {
            source: (
                np.column_stack([seen.points[a][k] for a in ("x_mm", "y_mm", "z_mm")]),
                seen.matrices[k],
                seen.points["row"][k],
            )
            for source in (OpticalSource.STEREO, OpticalSource.ACTIVE_LEFT)
            for k in [seen.points["source"] == source]
        } | {JOINT: (seen.joint_mm.T, covariance.full(seen.joint_covariance), rows)}
        for source, (points, own, row) in placed.items():
            off = points - lit[row]
            known = np.isfinite(off[:, 0]) & ~edge[row]
            nees[source].append(np.einsum("ni,nij,nj->n", off[known], np.linalg.inv(own[known]), off[known]) / 3)
    for found in nees.values():
        assert 0.8 < np.concatenate(found).mean() < 1.25


def test_the_planes_covariance_enters_each_point_where_it_lies() -> None:
    """Tilt about z is known badly: far from the middle of the line the active points are less sure, stereo is not."""
    tilt = np.zeros((4, 4))
    tilt[2, 2] = 1e-3**2
    laser = msgspec.structs.replace(laser_of(), plane_covariance=tilt.tolist())
    pipeline = OpticalPipeline.of(camera_of(TRUTH.left), camera_of(TRUTH.right), laser)
    seen = pipeline.measure(*pair(plate(10.0), 5.0, 3), 5.0, 0.004)
    plain = OpticalPipeline.of(camera_of(TRUTH.left), camera_of(TRUTH.right), laser_of()).measure(
        *pair(plate(10.0), 5.0, 3), 5.0
    )
    np.testing.assert_allclose(seen.points["z_mm"], plain.points["z_mm"], atol=1e-3)
    stereo = seen.points["source"] == OpticalSource.STEREO
    assert np.array_equal(seen.points["z_mm"][stereo], plain.points["z_mm"][stereo])
    assert np.array_equal(seen.covariance[:, stereo], plain.covariance[:, stereo])
    left = np.flatnonzero(seen.points["source"] == OpticalSource.ACTIVE_LEFT)
    for k in (left[5], left[len(left) // 2], left[-5]):
        place = [float(seen.points[axis][k]) for axis in ("x_mm", "y_mm", "z_mm")]
        own_mm = laser.sigma_mm(5.0, place[1], place[2])
        assert own_mm is not None
        along = np.sqrt(NORMAL @ seen.matrices[k] @ NORMAL)
        assert 0.95 * own_mm < along < np.hypot(own_mm, 0.003), (
            "what the stripe's stereo points leave of the guide's 0.004"
        )
    assert pipeline.plane_limit_mm == pytest.approx(0.04)


@pytest.mark.parametrize("off_mm", [0.05, -0.03])
def test_a_carriage_that_is_not_where_it_says_does_not_move_the_active_points(off_mm: float) -> None:
    """The stripe's own stereo points tell where the plane was, also for what one camera alone sees."""
    pipeline = OpticalPipeline.of(camera_of(TRUTH.left), camera_of(TRUTH.right), laser_of())
    frames = pair(plate(10.0), 25.0, 4)
    right = pipeline.measure(*frames, 25.0, 0.01)
    wrong = pipeline.measure(*frames, 25.0 + off_mm, 0.03)
    assert np.array_equal(right.points["row"], wrong.points["row"])
    alone = pipeline.measure(frames[0], np.zeros_like(frames[1]), 25.0 + off_mm, 0.03)
    active = right.points["source"] != OpticalSource.STEREO
    assert np.abs(wrong.points["z_mm"] - right.points["z_mm"])[active].max() < 0.02
    assert np.abs(wrong.joint_mm - right.joint_mm).max() < 0.02
    stated = np.sqrt(NORMAL @ wrong.matrices[active] @ NORMAL)
    assert 0 < stated.max() < 0.005
    left = right.points["source"] == OpticalSource.ACTIVE_LEFT
    rows, mine, other = np.intersect1d(right.points["row"][left], alone.points["row"], return_indices=True)
    assert rows.size > 500
    unaided = np.median(alone.points["z_mm"][other] - right.points["z_mm"][left][mine])
    assert abs(unaided) > 1.5 * abs(off_mm), "one camera alone has nothing to tell it"


def sides_of(frames: list[Frame], x_mm: float) -> list[Candidates]:
    distance_mm = TRUTH.plane_offset_mm(x_mm)
    return [
        candidates_of(extract(frames[i]), VIEWS[i], VIEWS[1 - i], NORMAL, distance_mm, GATES_MM) for i in (0, 1)
    ]  # fmt: skip


def test_candidates_lie_on_the_plane_and_where_the_other_camera_sees_them() -> None:
    left, right = sides_of(pair(plate(20.0), 5.0), 5.0)
    known = np.isfinite(left.active_mm[2])
    points = left.active_mm[:, known].T
    assert np.abs(points @ NORMAL - TRUTH.plane_offset_mm(5.0)).max() < 1e-9
    expected = CAMERAS[1].project(points)
    assert np.abs(left.expected_px[1, known] - expected[:, 1]).max() < 1e-6
    assert np.abs(left.expected_px[0, known] - CAMERAS[1].undistort(expected)[:, 0]).max() < 1e-6
    assert np.array_equal(np.repeat(np.arange(1024), np.diff(left.start)), left.row)
    assert np.isfinite(right.active_mm[2]).sum() > 900


def test_matched_points_lie_on_the_epipolar_line_and_close_to_where_the_plane_predicts_them() -> None:
    left, right = sides_of(pair(plate(20.0), 5.0), 5.0)
    found = walk(left, right, VIEWS[0].f_to_other)
    known = found.partner >= 0
    assert known.sum() > 900
    lines = VIEWS[0].f_to_other @ np.vstack([left.points_px[:, known], np.ones(known.sum())])
    distance = np.sum(lines * np.vstack([found.points_px[:, known], np.ones(known.sum())]), axis=0)
    assert np.abs(distance / np.hypot(lines[0], lines[1])).max() < 1e-6
    assert np.median(np.abs(found.off_px[known])) < 0.3
    assert ((found.gain[known] > 0.4) & (found.gain[known] < 1.2)).all(), "two rows are better than one"
    assert np.abs(right.row[found.partner[known]] - left.expected_px[1, known]).max() < 2


def test_no_candidates_match_nothing() -> None:
    left, right = sides_of([pair(plate(), 0.0)[0], np.full((1024, 1280), 5, dtype=np.uint8)], 0.0)
    assert (walk(left, right, VIEWS[0].f_to_other).partner == -1).all()
    assert len(walk(right, left, VIEWS[1].f_to_other).partner) == len(right.row)


def test_flags_tell_points_that_both_cameras_see(pipeline: OpticalPipeline) -> None:
    scene = SceneBuilder("wall").box((10, 40), (-30, 30), 40.0).build()
    seen = pipeline.measure(*pair(scene, 4.0), 4.0)
    left = seen.points[seen.points["source"] == OpticalSource.ACTIVE_LEFT]
    hidden = np.abs(left["y_mm"]) < 25
    assert hidden.sum() > 100, "the wall hides the stripe from the right camera only"
    assert not (left["flags"][hidden] & 2).any()
    assert (left["flags"][(np.abs(left["y_mm"]) > 40) & (np.abs(left["y_mm"]) < 100)] & 2).all()
    assert (seen.points["flags"][seen.points["source"] == OpticalSource.STEREO] & 2).all()
    assert seen.counts["left"] == np.count_nonzero((left["flags"] & 2) == 0)
    assert seen.counts["both"] > 500


@pytest.mark.parametrize("edge_mm", [20.0, 33.0])
def test_a_surface_ends_where_it_ends_and_not_where_its_blur_does(pipeline: OpticalPipeline, edge_mm: float) -> None:
    block = SceneBuilder("block").box((-40, 40), (-edge_mm, edge_mm), 20.0).build()
    for seed, x_mm in enumerate((-20.0, 5.0, 30.0)):
        seen = pipeline.measure(*pair(block, x_mm, seed), x_mm)
        assert seen.counts["fading"] > 0
        for source in OpticalSource:
            points = seen.points[seen.points["source"] == source]
            top = points["y_mm"][np.abs(points["z_mm"] - 20) < 1]
            assert edge_mm - 0.7 < top.max() < edge_mm + 0.2
            assert edge_mm - 0.7 < -top.min() < edge_mm + 0.2


@pytest.mark.parametrize("share", [0.35, 0.45])
@pytest.mark.parametrize("rows", [4, 6, 9])
def test_a_darker_rim_is_no_blur(pipeline: OpticalPipeline, share: float, rows: int) -> None:
    """The last rows of a block's top are darker, as print or dirt makes them: all but the outermost stay."""
    block = SceneBuilder("block").box((-40, 40), (-30, 30), 20.0).build()
    frames = pair(block, 5.0, 3)
    seen = pipeline.measure(*frames, 5.0)
    left = seen.points[(seen.points["source"] == OpticalSource.ACTIVE_LEFT) & (np.abs(seen.points["z_mm"] - 20) < 1)]
    first = int(left["row"].min())
    for frame in frames:
        frame[first - 4 : first + rows] = np.rint(share * frame[first - 4 : first + rows].astype(np.float64))
    darker = pipeline.measure(*frames, 5.0)
    for source in (OpticalSource.ACTIVE_LEFT, OpticalSource.ACTIVE_RIGHT):
        mine = darker.points["row"][darker.points["source"] == source]
        assert np.isin(np.arange(first, first + rows), mine).sum() >= rows - 2


def test_a_camera_that_moved_makes_its_points_less_sure(pipeline: OpticalPipeline) -> None:
    """The shift may be a camera's as well: what neither the guide nor noise explains is stated."""
    frames = pair(plate(10.0), 0.0, 5)
    off = OpticalPipeline.of(camera_of(TRUTH.left), moved(camera_of(TRUTH.right), 0.8, 0.0), laser_of())
    for pipe, least_mm, most_mm in ((pipeline, 0.0, 0.006), (off, 0.05, 0.2)):
        seen = pipe.measure(*frames, 0.0)
        active = seen.points["source"] == OpticalSource.ACTIVE_LEFT
        stated_mm = np.sqrt(np.median(np.einsum("i,nij,j->n", NORMAL, seen.matrices[active], NORMAL)))
        assert least_mm < stated_mm < most_mm


def false_stripe(frame: Frame, rows: slice, column: float, crest: float, sigma_px: float) -> Frame:
    """The frame with one more stripe, upright."""
    out = frame.astype(np.float64)
    out[rows] += crest * np.exp(-0.5 * ((np.arange(frame.shape[1]) - column) / sigma_px) ** 2)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("rows", "crest", "sigma_px", "reason"),
    [
        (slice(400, 640), 40.0, 1.7, "weak"),
        (slice(400, 640), 120.0, 5.0, "odd"),
        (slice(500, 508), 120.0, 1.7, "short"),
        (slice(60, 200), 120.0, 1.7, "secondary"),
    ],
)
def test_a_false_stripe_in_one_camera_is_rejected_with_its_reason(
    pipeline: OpticalPipeline, rows: slice, crest: float, sigma_px: float, reason: str
) -> None:
    scene = SceneBuilder("black").box((-60, 60), (-60, 60), 5.0, Material.BLACK).build()
    left, right = pair(scene, 0.0)
    before = pipeline.measure(left, right, 0.0)
    middle = float(np.median(extract(left, 1).column_px[60:200, 0]))
    after = pipeline.measure(false_stripe(left, rows, middle + 25.0, crest, sigma_px), right, 0.0)
    assert after.counts[reason] - before.counts[reason] > 0.8 * len(range(*rows.indices(1024)))
    assert after.counts["left"] == before.counts["left"]
    assert abs(len(after.points) - len(before.points)) < 10


def test_two_false_stripes_that_tell_different_heights_contradict_each_other(pipeline: OpticalPipeline) -> None:
    scene = SceneBuilder("black").box((-60, 60), (-60, 60), 5.0, Material.BLACK).build()
    left, right = pair(scene, 0.0)
    own = [float(np.median(extract(f, 1).column_px[60:200, 0])) for f in (left, right)]
    rows = slice(400, 640)
    seen = pipeline.measure(
        false_stripe(left, rows, own[0] + 25.0, 120.0, 1.7), false_stripe(right, rows, own[1] + 10.0, 120.0, 1.7), 0.0
    )
    assert seen.counts["contradicted"] > 400
    assert seen.counts["left"] + seen.counts["right"] < 60


def test_every_candidate_meets_one_verdict(pipeline: OpticalPipeline) -> None:
    frames = pair(matte(), -40.0)
    seen = pipeline.measure(*frames, -40.0)
    for verdicts, side in zip(seen.verdicts, sides_of(frames, -40.0), strict=True):
        assert verdicts.shape == (len(Verdict),)
        assert verdicts.sum() == len(side.row)
    assert seen.counts["both"] == seen.verdicts[0][Verdict.BOTH] > 900
