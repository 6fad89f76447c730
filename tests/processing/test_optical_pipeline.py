"""Emulated camera pairs to points, against the emulated scene's truth."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_drivers.emulated.optics import CameraTruth, optical_truth
from echolume_drivers.emulated.scene import Material, Scene, SceneBuilder, demo, plate
from echolume_drivers.emulated.stripe_image import render_stripe
from echolume_messages.calibration import CameraCalibration, LaserCalibration
from echolume_messages.types import OPTICAL_POINT, OpticalSource
from echolume_processing.optical.pipeline import OpticalPipeline

TRUTH = optical_truth(1)


def camera_of(truth: CameraTruth) -> CameraCalibration:
    return CameraCalibration(
        width_px=truth.width_px,
        height_px=truth.height_px,
        camera_matrix=truth.matrix.tolist(),
        distortion=truth.distortion.tolist(),
        camera_from_rig=truth.camera_from_rig.tolist(),
        rms_px=0.0,
    )


def laser_of() -> LaserCalibration:
    n, g = TRUTH.laser_normal.tolist(), TRUTH.guide_direction.tolist()
    return LaserCalibration(
        normal=(n[0], n[1], n[2]), offset_mm=TRUTH.laser_offset_mm, guide_direction=(g[0], g[1], g[2]), rms_mm=0.0
    )


@pytest.fixture(scope="module")
def pipeline() -> OpticalPipeline:
    return OpticalPipeline.of(camera_of(TRUTH.left), camera_of(TRUTH.right), laser_of())


def frames(scene: Scene, x_mm: float, seed: int = 0) -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng([seed, round(1000 * (x_mm + 200))])
    return (
        render_stripe(scene, TRUTH, "left", x_mm, rng, 4e-3, True),
        render_stripe(scene, TRUTH, "right", x_mm, rng, 4e-3, True),
    )


def off_surface_mm(points: np.ndarray, scene: Scene) -> np.ndarray:
    """How far each point lies above or below the surface within 1 mm around it; walls count as surface."""
    heights = []
    for dx in (-1, 0, 1):
        for dy in (-1, 0, 1):
            ix = np.floor((points["x_mm"] + dx - scene.x0_mm) / scene.cell_mm).astype(int)
            iy = np.floor((points["y_mm"] + dy - scene.y0_mm) / scene.cell_mm).astype(int)
            inside = (ix >= 0) & (iy >= 0) & (ix < scene.optical_mm.shape[1]) & (iy < scene.optical_mm.shape[0])
            heights.append(np.where(inside, scene.optical_mm[np.where(inside, iy, 0), np.where(inside, ix, 0)], 0.0))
    low, high = np.min(heights, axis=0), np.max(heights, axis=0)
    return np.maximum(np.maximum(points["z_mm"] - high, low - points["z_mm"]), 0.0)


def with_clutter(frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """A dozen glints and some hundred hot pixels."""
    out = frame.astype(np.float64)
    yy, xx = np.mgrid[-25:26, -25:26]
    for _ in range(12):
        y, x = rng.integers(30, frame.shape[0] - 30), rng.integers(30, frame.shape[1] - 30)
        size = rng.uniform(2, 7)
        out[y - 25 : y + 26, x - 25 : x + 26] += rng.uniform(60, 220) * np.exp(-(xx**2 + yy**2) / (2 * size**2))
    out.ravel()[rng.integers(0, out.size, 300)] = rng.uniform(150, 255, 300)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


@pytest.mark.parametrize("z_mm", [0.0, 35.0])
def test_a_flat_matte_plate_is_measured_within_a_tenth_of_a_millimetre(pipeline: OpticalPipeline, z_mm: float) -> None:
    points = np.concatenate([pipeline.process(*frames(plate(z_mm), x), x) for x in (-90.0, -20.0, 45.0, 95.0)])
    assert points.dtype == OPTICAL_POINT
    points = points[np.abs(points["y_mm"]) < 110]  # the plate ends at 120
    for source, limit_mm in (
        (OpticalSource.STEREO, 0.06),
        (OpticalSource.ACTIVE_LEFT, 0.1),
        (OpticalSource.ACTIVE_RIGHT, 0.1),
    ):
        mine = points[points["source"] == source]
        error_mm = mine["z_mm"] - z_mm
        assert len(mine) > 2800
        assert np.sqrt(np.mean(error_mm**2)) < limit_mm
        assert abs(error_mm.mean()) < 0.01
        assert 0.7 < np.sqrt(np.mean((error_mm / mine["sigma_z_mm"]) ** 2)) < 1.2, "sigmas are honest"


def test_points_lie_on_the_laser_plane(pipeline: OpticalPipeline) -> None:
    points = pipeline.process(*frames(plate(), 30.0), 30.0)
    xyz = np.column_stack([points[axis] for axis in ("x_mm", "y_mm", "z_mm")]).astype(np.float64)
    off_mm = xyz @ TRUTH.laser_normal - TRUTH.plane_offset_mm(30.0)
    active = points["source"] != OpticalSource.STEREO
    assert np.ptp(off_mm[active]) < 1e-4, "float32"
    assert np.abs(off_mm[active]).max() < 2e-3, "its stereo points move the plane by what they know of it"
    assert np.sqrt(np.mean(off_mm[~active] ** 2)) < 0.05


def test_no_point_of_the_demo_scene_is_wrong(pipeline: OpticalPipeline) -> None:
    scene = demo()
    points = np.concatenate([pipeline.process(*frames(scene, x), x) for x in np.arange(-96.0, 97, 16)])
    wrong = off_surface_mm(points, scene) > 1
    assert len(points) > 30_000
    assert wrong.mean() < 1e-3


def test_clutter_in_both_images_leaves_few_wrong_points(pipeline: OpticalPipeline) -> None:
    scene = demo()
    rng = np.random.default_rng(2)
    clean = dirty = 0
    wrong: list[np.ndarray] = []
    for x in np.arange(-90.0, 91, 20):
        pair = frames(scene, x)
        clean += len(pipeline.process(*pair, x))
        points = pipeline.process(with_clutter(pair[0], rng), with_clutter(pair[1], rng), x)
        dirty += len(points)
        wrong.append(off_surface_mm(points, scene) > 1)
    assert np.concatenate(wrong).mean() < 2e-3
    assert dirty > 0.97 * clean


def test_a_camera_that_sees_nothing_leaves_the_other_ones_active_points(pipeline: OpticalPipeline) -> None:
    left, right = frames(plate(), 0.0)
    points = pipeline.process(left, np.full_like(right, 5), 0.0)
    assert set(points["source"]) == {OpticalSource.ACTIVE_LEFT}
    assert len(points) > 900


def test_a_stripe_that_the_laser_plane_forbids_is_no_point(pipeline: OpticalPipeline) -> None:
    assert len(pipeline.process(*frames(plate(), 80.0), -80.0)) == 0


def test_dark_frames_give_no_points(pipeline: OpticalPipeline) -> None:
    dark = np.full((1024, 1280), 5, dtype=np.uint8)
    assert len(pipeline.process(dark, dark, 0.0)) == 0


def test_a_black_block_returns_no_point(pipeline: OpticalPipeline) -> None:
    scene = SceneBuilder("black").box((-30, 30), (-30, 30), 20.0, Material.BLACK).build()
    points = pipeline.process(*frames(scene, 0.0), 0.0)
    assert not ((np.abs(points["x_mm"]) < 28) & (np.abs(points["y_mm"]) < 28)).any()


def test_the_same_frames_give_the_same_points(pipeline: OpticalPipeline) -> None:
    pair = frames(demo(), 30.0)
    assert pipeline.process(*pair, 30.0).tobytes() == pipeline.process(*pair, 30.0).tobytes()


def test_a_frame_of_another_size_is_refused(pipeline: OpticalPipeline) -> None:
    with pytest.raises(
        ValueError, match=r"right frame: expected shape \(1024, 1280\) of the calibration, got \(10, 10\)"
    ):
        pipeline.process(np.zeros((1024, 1280), np.uint8), np.zeros((10, 10), np.uint8), 0.0)
