"""The rendered stripe lies where an independent ray cast of the same boxes puts it, and is dark where it must be."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from echolume_drivers.emulated.flaws import FLAWLESS
from echolume_drivers.emulated.optics import Side, optical_truth
from echolume_drivers.emulated.scene import Material, SceneBuilder, demo, plate
from echolume_drivers.emulated.sensor import READ_NOISE_DN, expose
from echolume_drivers.emulated.stage import Stage
from echolume_drivers.emulated.stripe_image import (
    TRANSMISSION,
    _pieces,
    render_stripe,
    stripe_light,
    true_stripe,
)

SIDES: tuple[Side, Side] = ("left", "right")
TRUTH = optical_truth(7)
SCENE = demo()
# The demo's opaque boxes: x from, x to, y from, y to, height; and which of them is black.
BOXES = np.array(
    [[-90 + 20 * k, -70 + 20 * k, 30, 85, 10 * (k + 1)] for k in range(4)]
    + [[25, 45, 30, 85, 20], [65, 77, 30, 85, 20], [20, 70, -75, -25, 20]],
    dtype=float,
)
BLACK = len(BOXES) - 1


def first_hit(start: np.ndarray, ways: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Nearest hit of rays with the bench (-1) or a box: parameter along the ray, and which."""
    t = -start[:, 2] / ways[:, 2]
    t[t < 1e-9] = np.inf
    which = np.full(len(ways), -1)
    for k, (x0, x1, y0, y1, height) in enumerate(BOXES):
        low, high = np.array([x0, y0, -1.0]), np.array([x1, y1, height])
        a, b = (low - start) / ways, (high - start) / ways
        enter, leave = np.minimum(a, b).max(axis=1), np.maximum(a, b).min(axis=1)
        hit = (enter < leave) & (enter > 1e-9) & (enter < t)
        t[hit], which[hit] = enter[hit], k
    return t, which


def stripe_by_ray_cast(side: Side, x_mm: float, row: int) -> float:
    """Column where the row's viewing rays pass through the lit line; nan if none or several do."""
    camera = TRUTH.camera(side)
    normal, offset = TRUTH.laser_normal, TRUTH.plane_offset_mm(x_mm)
    rotation = camera.camera_from_rig[:3, :3]

    def look(u: np.ndarray) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        rays = camera.normalised(np.stack([u, np.full_like(u, row)], axis=1))
        ways = np.concatenate([rays, np.ones((len(u), 1))], axis=1) @ rotation
        t, which = first_hit(np.broadcast_to(camera.centre_mm, ways.shape), ways)
        points = camera.centre_mm + t[:, None] * ways
        return points @ normal - offset, points, which

    u = np.arange(-0.5, camera.width_px)
    side_of, points, which = look(u)
    crossings = np.flatnonzero((side_of[:-1] * side_of[1:] <= 0) & (which[:-1] == which[1:]))
    found = []
    for k in crossings:
        if np.linalg.norm(points[k + 1] - points[k]) > 2.0:
            continue
        low, high = u[k], u[k + 1]
        for _ in range(30):
            middle = np.array([0.5 * (low + high)])
            low, high = (middle[0], high) if look(middle)[0][0] * side_of[k] > 0 else (low, middle[0])
        _, point, hit = look(np.array([low]))
        if hit[0] == BLACK:
            continue
        towards_laser = TRUTH.head_mm(x_mm) - point[0]
        start = point + 1e-6 * towards_laser
        if first_hit(start, towards_laser[None])[0][0] >= 1.0:
            found.append(low)
    return found[0] if len(found) == 1 else np.nan


def centre_of_mass(image: np.ndarray, columns: np.ndarray, half: int = 8) -> np.ndarray:
    """Centre of mass of each row around the given columns; nan stays nan."""
    out = np.full(len(columns), np.nan)
    for row in np.flatnonzero(np.isfinite(columns)):
        c = round(columns[row])
        if half <= c < image.shape[1] - half:
            window = image[row, c - half : c + half + 1].astype(float)
            out[row] = window @ np.arange(c - half, c + half + 1) / window.sum()
    return out


@pytest.mark.parametrize("side", SIDES)
def test_cameras_project_as_opencv_does(side: Side) -> None:
    camera = TRUTH.camera(side)
    points = np.random.default_rng(0).uniform([-100, -100, 0], [100, 100, 60], (200, 3))
    vector = cv2.Rodrigues(camera.camera_from_rig[:3, :3])[0]
    theirs = cv2.projectPoints(points, vector, camera.camera_from_rig[:3, 3], camera.matrix, camera.distortion)[0]
    assert np.abs(camera.project(points) - theirs.reshape(-1, 2)).max() < 1e-9


@pytest.mark.parametrize("side", SIDES)
def test_pixels_become_the_rays_they_came_from(side: Side) -> None:
    camera = TRUTH.camera(side)
    pixels = np.random.default_rng(1).uniform([0, 0], [1279, 1023], (500, 2))
    rays = np.concatenate([camera.normalised(pixels), np.ones((500, 1))], axis=1)
    points = camera.centre_mm + 500 * rays @ camera.camera_from_rig[:3, :3]
    assert np.abs(camera.project(points) - pixels).max() < 1e-6


def test_the_whole_scored_field_is_in_view_of_both_cameras_up_to_40_mm() -> None:
    corners = np.array([[x, y, z] for x in (-100, 100) for y in (-100, 100) for z in (0, 40)], dtype=float)
    for seed in range(10):
        truth = optical_truth(seed)
        for side in SIDES:
            pixels = truth.camera(side).project(corners)
            assert np.all((pixels > 0) & (pixels < [1279, 1023]))


def test_the_laser_is_off_by_a_few_milliradians_and_its_head_lies_in_its_plane() -> None:
    for seed in range(10):
        truth = optical_truth(seed)
        for tilt in (truth.laser_normal, truth.guide_direction):
            assert 1e-5 < np.arccos(tilt[0]) < 8e-3
        for x_mm in (-80.0, 55.0):
            assert abs(truth.laser_normal @ truth.head_mm(x_mm) - truth.plane_offset_mm(x_mm)) < 1e-9


def test_another_seed_is_another_rig_and_the_same_seed_the_same() -> None:
    assert np.array_equal(optical_truth(3).left.packed, optical_truth(3).left.packed)
    assert not np.array_equal(optical_truth(3).left.packed, optical_truth(4).left.packed)


@pytest.mark.parametrize("side", SIDES)
@pytest.mark.parametrize("x_mm", [-80.2, -40.3, 35.0, 50.5])
def test_the_stripe_lies_where_a_ray_cast_puts_it(side: Side, x_mm: float) -> None:
    rendered = true_stripe(SCENE, TRUTH, side, x_mm).rows(1024)
    rows = np.arange(3, 1024, 29)
    cast = np.array([stripe_by_ray_cast(side, x_mm, row) for row in rows])
    both = np.isfinite(cast) & np.isfinite(rendered[rows])
    assert np.mean(np.isfinite(cast) == np.isfinite(rendered[rows])) > 0.96
    apart = np.abs(cast - rendered[rows])[both]
    assert both.sum() >= 18
    assert np.median(apart) <= 0.005
    assert np.percentile(apart, 95) <= 0.01


@pytest.mark.parametrize("side", SIDES)
def test_the_noiseless_image_has_its_crest_on_the_stripe(side: Side) -> None:
    _, pieces, brightness = _pieces(SCENE, TRUTH, side, -40.3)
    image, touched = stripe_light(pieces, brightness, TRUTH, side)
    truth = true_stripe(SCENE, TRUTH, side, -40.3).rows(1024)
    apart = np.abs(centre_of_mass(image, truth) - truth)
    assert np.nanmedian(apart) <= 0.001
    columns = np.arange(1280)
    dark = (columns < touched[:, :1]) | (columns >= touched[:, 1:])
    assert image[dark].max() == 0


def test_a_plate_is_seen_at_its_height() -> None:
    stripe = true_stripe(plate(25.0), TRUTH, "left", 10.0)
    on_plate = np.abs(stripe.points_mm[:, 1]) < 100
    assert np.allclose(stripe.points_mm[on_plate, 2], 25.0)
    assert np.allclose(stripe.points_mm @ TRUTH.laser_normal, TRUTH.plane_offset_mm(10.0))


def test_behind_a_step_lies_the_lasers_shadow() -> None:
    # 40 mm step up to y = 85, laser 500 mm above y = 0: dark as far as 85 * 500 / 460 = 92.4 mm.
    y_mm = true_stripe(SCENE, TRUTH, "left", -20.0).points_mm[:, 1]
    assert not np.any((y_mm > 85.5) & (y_mm < 91.5))
    assert np.any((y_mm > 93.5) & (y_mm < 95))


def test_a_bar_hides_the_stripe_from_one_camera_only() -> None:
    seen = {side: true_stripe(SCENE, TRUTH, side, 50.5).points_mm[:, 1] for side in SIDES}
    between = {side: np.sum((y > 40) & (y < 80)) for side, y in seen.items()}
    assert between["left"] == 0
    assert between["right"] == 40 * 8


def test_walls_that_face_the_laser_are_lit() -> None:
    stripe = true_stripe(SCENE, TRUTH, "left", -20.0)
    wall = np.abs(stripe.points_mm[:, 1] - 30.0) < 1e-6
    assert np.ptp(stripe.points_mm[wall, 2]) > 35
    assert 0 < stripe.brightness[wall].max() < 0.3


@pytest.mark.parametrize("side", SIDES)
def test_black_returns_nothing(side: Side) -> None:
    stripe = true_stripe(SCENE, TRUTH, side, 50.0)
    y_mm = stripe.points_mm[:, 1]
    assert not np.any((y_mm > -74.9) & (y_mm < -25.1))
    frame = render_stripe(SCENE, optical_truth(7, FLAWLESS), side, 50.0, np.random.default_rng(0), 4e-3, True)
    rows = TRUTH.camera(side).project(np.array([[50.0, -70.0, 20.0], [50.0, -30.0, 20.0]]))[:, 1]
    assert frame[int(rows[1]) : int(rows[0])].max() < 20


def test_glass_shows_the_bench_below_it_twice_weakened() -> None:
    stripe = true_stripe(SCENE, TRUTH, "left", -50.0)
    y_mm = stripe.points_mm[:, 1]
    below, beside = (y_mm > -60) & (y_mm < -40), (y_mm > -8) & (y_mm < 8)
    assert np.allclose(stripe.points_mm[below, 2], 0.0)
    lit = (500 / np.hypot(500, 50)) ** 2  # slant and distance of the light at y = -50
    assert stripe.brightness[below].mean() / stripe.brightness[beside].mean() == pytest.approx(
        TRANSMISSION**2 * lit, rel=0.02
    )


def test_glass_hides_nothing() -> None:
    bare = SceneBuilder("bare").build()
    with_glass = true_stripe(SCENE, TRUTH, "left", -50.0).rows(1024)
    without = true_stripe(bare, TRUTH, "left", -50.0).rows(1024)
    rows = slice(560, 900)  # y = -10 to -90
    assert np.array_equal(with_glass[rows], without[rows])


def test_the_same_seed_position_and_attempt_give_the_identical_frame() -> None:
    def frames(seed: int) -> list[np.ndarray]:
        stage = Stage(seed, SCENE)
        return [
            render_stripe(SCENE, TRUTH, "left", 5.0, stage.noise("camera-left", np.array([5.0])), 4e-3, True)
            for _ in range(2)
        ]

    first, again = frames(1)
    assert np.array_equal(first, frames(1)[0])
    assert np.array_equal(again, frames(1)[1])
    assert not np.array_equal(first, again)
    assert not np.array_equal(first, frames(2)[0])


def test_noise_is_as_strong_as_the_sensor_says_and_unbiased() -> None:
    nothing = np.zeros((256, 1280), dtype=np.float32)
    touched = np.zeros((256, 2), dtype=np.int64)
    rng = np.random.default_rng(3)
    flat = expose(rng, 40.0, nothing, touched).astype(float)
    image = expose(rng, np.full_like(nothing, 40.0), nothing, touched).astype(float)
    expected = np.sqrt(READ_NOISE_DN**2 + 0.03 * 40 + 1 / 12)
    for frame in (flat, image):
        assert frame.mean() == pytest.approx(40.0, abs=0.02)
        assert frame.std() == pytest.approx(expected, rel=0.01)
        neighbours = np.corrcoef(frame[:, :-1].ravel(), frame[:, 1:].ravel())[0, 1]
        assert abs(neighbours) < 0.01


def test_a_long_exposure_saturates() -> None:
    frame = render_stripe(SCENE, TRUTH, "right", 0.0, np.random.default_rng(0), 20e-3, True)
    assert np.mean((frame == 255).any(axis=1)) > 0.8


def test_speckle_moves_the_centre_by_about_a_tenth_of_a_pixel() -> None:
    bench = SceneBuilder("bench").build()
    truth = true_stripe(bench, TRUTH, "left", 0.0).rows(1024)
    frame = render_stripe(bench, TRUTH, "left", 0.0, np.random.default_rng(0), 4e-3, True).astype(float)
    error = (centre_of_mass(frame - np.median(frame), truth) - truth)[100:900]
    assert 0.04 < np.std(error) < 0.2
    assert abs(np.mean(error)) < 0.01


def test_with_the_laser_off_there_is_no_stripe() -> None:
    frame = render_stripe(SCENE, TRUTH, "left", 0.0, np.random.default_rng(0), 4e-3, False)
    assert frame.std() < 4


def test_a_glossy_plate_shines_where_it_mirrors_the_laser_and_is_dim_elsewhere() -> None:
    shiny = SceneBuilder("shiny").box((-120, 120), (-120, 120), 0.0, Material.GLOSSY).build()
    stripe = true_stripe(shiny, TRUTH, "left", -110.0)
    matte = true_stripe(plate(0.0), TRUTH, "left", -110.0)
    ratio = stripe.brightness / matte.brightness
    middle, far = np.abs(stripe.points_mm[:, 1]) < 5, np.abs(stripe.points_mm[:, 1]) > 95
    assert ratio[middle].min() > 2
    assert ratio[far].max() < ratio[middle].min() / 1.5


def test_the_carriage_stands_a_hundredth_of_a_millimetre_from_where_its_controller_believes_it() -> None:
    here = [0.0]
    stage = Stage(seed=1, scene=plate(), guide_x_mm=lambda: here[0])
    errors_mm = []
    for here[0] in np.arange(-100.0, 100.0, 0.5):
        errors_mm.append(stage.carriage_mm() - here[0])
        assert stage.carriage_mm() - here[0] == errors_mm[-1]
    assert 0.0085 < np.std(errors_mm) < 0.0115
    assert abs(np.mean(errors_mm)) < 0.002
