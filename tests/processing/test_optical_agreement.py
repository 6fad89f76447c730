"""Both cameras' agreement: an imposed error of the laser plane is found, amplified by the geometry, and alarmed."""

from __future__ import annotations

import logging
from dataclasses import replace

import numpy as np
import pytest

from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import demo
from echolume_drivers.emulated.stripe_image import render_stripe
from echolume_messages.types import Frame
from echolume_processing.optical import triangulate
from echolume_processing.optical.agreement import Agreement, of_stripe, of_sweep, summary
from echolume_processing.optical.camera import Camera
from echolume_processing.optical.candidates import view_of
from echolume_processing.optical.pipeline import OpticalPipeline
from echolume_processing.optical.sweep import Sweep
from processing.test_optical_pipeline import camera_of, laser_of

TRUTH = optical_truth(1)
LOG = logging.getLogger("echolume.optical")
X_MM = (-80.0, -35.0, 10.0, 55.0, 90.0)
SPEED_MMPS = 50.0


@pytest.fixture(scope="module")
def pipeline() -> OpticalPipeline:
    return OpticalPipeline.of(camera_of(TRUTH.left), camera_of(TRUTH.right), laser_of())


@pytest.fixture(scope="module")
def frames() -> dict[float, tuple[Frame, Frame]]:
    rng = np.random.default_rng(3)
    return {
        x: (
            render_stripe(demo(), TRUTH, "left", x, rng, 4e-3, True),
            render_stripe(demo(), TRUTH, "right", x, rng, 4e-3, True),
        )
        for x in X_MM
    }


def sweep_of(pipeline: OpticalPipeline, frames: dict[float, tuple[Frame, Frame]], off_mm: float) -> Sweep:
    """A sweep whose guide positions are wrong by `off_mm`."""
    sweep = Sweep(LOG)
    for x, pair in frames.items():
        found = pipeline.measure(*pair, x + off_mm)
        sweep.add(("scan", "light"), pipeline.plane_limit_mm, found.agreement, x + off_mm, round(1e9 * x / SPEED_MMPS))
    return sweep


def test_cameras_agree_when_the_plane_is_right(
    pipeline: OpticalPipeline, frames: dict[float, tuple[Frame, Frame]], caplog: pytest.LogCaptureFixture
) -> None:
    sweep = sweep_of(pipeline, frames, 0.0)
    found = sweep.agreement
    assert not sweep.alarm
    assert not caplog.records
    assert found.points > 3000
    assert abs(found.plane_mm) < 0.01
    assert found.error_mm < 0.025
    assert found.median_mm == pytest.approx(found.noise_mm, rel=0.15)


@pytest.mark.parametrize("off_mm", [0.05, -0.05])
def test_a_plane_error_of_a_twentieth_of_a_millimetre_raises_the_alarm_once(
    pipeline: OpticalPipeline, frames: dict[float, tuple[Frame, Frame]], caplog: pytest.LogCaptureFixture, off_mm: float
) -> None:
    sweep = sweep_of(pipeline, frames, off_mm)
    report = sweep.report()
    assert sweep.alarm
    assert report["alarm"] is True
    assert sweep.agreement.plane_mm == pytest.approx(off_mm, abs=0.01)
    assert sweep.agreement.error_mm == pytest.approx(0.05, abs=0.015)
    assert sweep.sync_ms == pytest.approx(1.0 if off_mm > 0 else -1.0, abs=0.2), "0.05 mm at 50 mm/s"
    assert [r.levelname for r in caplog.records] == ["WARNING"]
    assert "the laser plane is off by 0.0" in caplog.text


def test_the_amplification_is_that_of_the_geometry() -> None:
    cameras = [Camera(c.matrix, c.distortion, c.camera_from_rig) for c in (TRUTH.left, TRUTH.right)]
    left, right = view_of(cameras[0], cameras[1]), view_of(cameras[1], cameras[0])
    normal = TRUTH.laser_normal
    points = np.random.default_rng(0).uniform([0, -90, 0], [0, 90, 40], (400, 3))
    points -= np.outer(points @ normal - 7.0, normal)
    pixels = [camera.undistort(camera.project(points)) for camera in cameras]
    for error_mm in (0.1, -0.3):
        planes = [
            triangulate.plane_from_pixel(v.centre_mm, v.ray_matrix, normal, 7.0 + error_mm) for v in (left, right)
        ]
        active = np.ascontiguousarray(triangulate.active(planes[0], pixels[0]).T)
        found = of_stripe(
            400,
            summary(active, np.ascontiguousarray(pixels[1].T), planes[1], left.centre_mm, right.centre_mm, normal),
        )
        assert 3.5 < abs(found.amplification) < 5.0
        assert found.plane_mm == pytest.approx(error_mm, rel=2e-2)
        assert found.median_mm == pytest.approx(abs(error_mm * found.amplification), rel=2e-2)


def test_a_sweep_is_the_median_of_its_stripes_and_a_new_pass_begins_anew() -> None:
    stripe = Agreement(900, 0.2, 0.12, -4.0, 0.01, 0.03)
    stripes = [replace(stripe, median_mm=value) for value in (0.2, 0.21, 0.9)]
    assert of_sweep(stripes).median_mm == 0.21
    sweep = Sweep(LOG)
    sweep.add(("s", "a"), 0.04, stripe, 0.0, 0)
    sweep.add(("s", "b"), 0.04, stripe, 0.0, 0)
    assert sweep.report()["stripes"] == 1


def test_stripes_that_one_camera_sees_say_nothing(
    pipeline: OpticalPipeline, frames: dict[float, tuple[Frame, Frame]]
) -> None:
    left, right = frames[10.0]
    sweep = Sweep(LOG)
    found = pipeline.measure(left, np.full_like(right, 5), 10.0)
    sweep.add(("s", "a"), 0.04, found.agreement, 10.0, 0)
    assert sweep.report() == {"stripes": 0, "alarm": False}


def test_a_guide_at_rest_has_no_timing_error() -> None:
    sweep = Sweep(LOG)
    for t_ns in range(4):
        sweep.add(("s", "a"), 0.04, Agreement(900, 0.2, 0.12, -4.0, 0.01, 0.03), 5.0, t_ns * 10**9)
    assert sweep.sync_ms is None
