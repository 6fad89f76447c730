"""Light on sloping, bending, mirroring and smoky scenes: closed forms and an independent ray tracer."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.optimize import least_squares

from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import SCENES, Air, Material, Scene, SceneBuilder, named
from echolume_drivers.emulated.shapes import Body, level_at, plane_through, sphere_about
from echolume_drivers.emulated.stripe_image import (
    REFRACTIVE_INDEX,
    STRIPE_DN_PER_S,
    TRANSMISSION,
    render_stripe,
    smoke_veil,
    true_stripe,
)

TRUTH = optical_truth(7)


def with_plate(tilt_deg: tuple[float, float], thickness_mm: float) -> Scene:
    builder = SceneBuilder("plate")
    top = plane_through(0.0, 0.0, 40.0, (np.radians(tilt_deg[0]), np.radians(tilt_deg[1])))
    where = builder.rectangle((-80, 80), (-60, 60))
    return builder.put(Body(where, top, Material.GLASS, thickness_mm)).build()


def traced(
    start: np.ndarray, way: np.ndarray, normal: np.ndarray, thickness_mm: float
) -> tuple[np.ndarray, np.ndarray]:
    """A ray through a plate whose upper side holds (0, 0, 40), by Snell's law at both faces: a point on it, its way."""
    way = way / np.linalg.norm(way)
    for offset, ratio in ((0.0, 1 / REFRACTIVE_INDEX), (-thickness_mm, REFRACTIVE_INDEX)):
        face = np.array([0.0, 0.0, 40.0]) + offset * normal
        start = start + way * ((face - start) @ normal / (way @ normal))
        cosine = -(normal @ way)
        inner = np.sqrt(1 - ratio**2 * (1 - cosine**2))
        way = ratio * way + (ratio * cosine - inner) * normal
    return start, way


def to_bench(start: np.ndarray, way: np.ndarray) -> np.ndarray:
    return start - way * start[2] / way[2]


@pytest.mark.parametrize("tilt_deg", [(0.0, 0.0), (10.0, 0.0), (20.0, -15.0)])
@pytest.mark.parametrize("side", ["left", "right"])
def test_glass_bends_light_as_snell_says(side: str, tilt_deg: tuple[float, float]) -> None:
    scene = with_plate(tilt_deg, 4.0)
    stripe = true_stripe(scene, TRUTH, side, 3.0)
    camera, head = TRUTH.camera(side), TRUTH.head_mm(3.0)
    normal = np.array([-np.tan(np.radians(tilt_deg[0])), -np.tan(np.radians(tilt_deg[1])), 1.0])
    normal /= np.linalg.norm(normal)
    plane_x, plane_y, plane_z = TRUTH.laser_normal
    behind = np.flatnonzero(np.abs(stripe.points_mm[:, 1]) < 20)[::40]
    assert len(behind) >= 5
    for n in behind:
        seen = stripe.pixels[n]
        spot = stripe.points_mm[n]

        def misses(aim: np.ndarray, seen: np.ndarray = seen) -> np.ndarray:
            return camera.project(aim[None])[0] - seen

        # the camera's ray of this pixel, and the laser's ray in its plane that ends at the same y
        far = least_squares(lambda a: misses(np.array([a[0], a[1], 0.0])), spot[:2]).x
        seen_at = to_bench(*traced(camera.centre_mm, np.array([*far, 0.0]) - camera.centre_mm, normal, 4.0))
        offset_mm = TRUTH.plane_offset_mm(3.0)

        def lit(y_mm: float, offset_mm: float = offset_mm) -> np.ndarray:
            aim = np.array([(offset_mm - plane_y * y_mm) / plane_x, y_mm, 0.0])
            return to_bench(*traced(head, aim - head, normal, 4.0))

        y_mm = least_squares(lambda v, goal_mm=spot[1]: [lit(v[0])[1] - goal_mm], [spot[1]]).x[0]
        np.testing.assert_allclose(spot, lit(y_mm), atol=0.004)
        np.testing.assert_allclose(seen_at[:2], spot[:2], atol=0.008)
    assert plane_z != 0


def test_a_level_plate_seems_to_raise_the_bench_by_a_third_of_its_thickness() -> None:
    scene = with_plate((0.0, 0.0), 6.0)
    camera = TRUTH.camera("left")
    stripe = true_stripe(scene, TRUTH, "left", 0.0)
    middle = np.flatnonzero(np.abs(stripe.points_mm[:, 1]) < 5)
    for n in middle[::20]:
        raised = least_squares(
            lambda z, n=n: camera.project((stripe.points_mm[n] + [0, 0, z[0]])[None])[0] - stripe.pixels[n], [0.0]
        ).x[0]
        away = camera.centre_mm - stripe.points_mm[n]
        cosine = away[2] / np.linalg.norm(away)
        expected = 6.0 * (1 - cosine / np.sqrt(REFRACTIVE_INDEX**2 - 1 + cosine**2))
        assert raised == pytest.approx(expected, abs=0.01)
        assert 0.33 < raised / 6.0 < 0.42


def test_a_film_of_glass_bends_nothing() -> None:
    bent, thin = with_plate((0.0, 0.0), 4.0), SceneBuilder("film").box((-80, 80), (-60, 60), 40.0, Material.GLASS)
    rows = slice(300, 700)
    shift_px = true_stripe(bent, TRUTH, "left", 0.0).rows(1024) - true_stripe(thin.build(), TRUTH, "left", 0.0).rows(
        1024
    )
    bare = true_stripe(SceneBuilder("bare").build(), TRUTH, "left", 0.0).rows(1024)
    np.testing.assert_array_equal(true_stripe(thin.build(), TRUTH, "left", 0.0).rows(1024)[rows], bare[rows])
    assert np.all(shift_px[rows] > 2.0)


def test_two_plates_above_each_other_weaken_the_light_twice() -> None:
    one, two = with_plate((0.0, 0.0), 3.0), SceneBuilder("two")
    for z_mm in (20.0, 40.0):
        two.put(Body(two.rectangle((-80, 80), (-60, 60)), level_at(z_mm), Material.GLASS, 3.0, level=True))
    single, double = (true_stripe(s, TRUTH, "left", 0.0) for s in (one, two.build()))
    levels = [s.brightness[np.abs(s.points_mm[:, 1]) < 20].mean() for s in (single, double)]
    assert levels[1] / levels[0] == pytest.approx(TRANSMISSION**2, rel=1e-3)


@pytest.mark.parametrize(("along_x_deg", "along_y_deg"), [(15.0, 0.0), (0.0, 15.0), (-10.0, 8.0)])
def test_a_slope_is_seen_as_a_plane_and_not_as_a_stair(along_x_deg: float, along_y_deg: float) -> None:
    builder = SceneBuilder("ramp")
    top = plane_through(0.0, 0.0, 40.0, (np.radians(along_x_deg), np.radians(along_y_deg)))
    scene = builder.put(Body(builder.rectangle((-60, 60), (-60, 60)), top)).build()
    points = true_stripe(scene, TRUTH, "right", 5.0).points_mm
    points = points[np.abs(points[:, 1]) < 58]
    assert len(points) > 500
    np.testing.assert_allclose(points[:, 2], top(points[:, 0], points[:, 1]), atol=1e-9)
    # and all of them lie in the laser's plane
    np.testing.assert_allclose(points @ TRUTH.laser_normal, TRUTH.plane_offset_mm(5.0), atol=1e-9)


def test_a_ball_is_round_to_the_sag_of_its_cells() -> None:
    builder = SceneBuilder("ball")
    scene = builder.put(Body(builder.disc(0.0, 0.0, 20.0), sphere_about(0.0, 0.0, 0.0, 20.0))).build()
    error_mm: list[float] = []
    for x_mm in (-14.0, -6.3, 0.0, 9.1):
        points = true_stripe(scene, TRUTH, "left", x_mm).points_mm
        off_mm = np.hypot(points[:, 0], points[:, 1])
        error_mm.extend(np.linalg.norm(points[off_mm < 16], axis=1) - 20.0)
    assert len(error_mm) > 400
    assert np.max(np.abs(error_mm)) < 0.02  # a plane over 1 mm of a slope of 53 degrees
    assert np.std(error_mm) < 0.005


def test_slopes_are_lit_by_the_cosine() -> None:
    def level(tilt_deg: float) -> float:
        builder = SceneBuilder("ramp")
        top = plane_through(0.0, 0.0, 30.0, (np.radians(tilt_deg), 0.0))
        scene = builder.put(Body(builder.rectangle((-60, 60), (-60, 60)), top)).build()
        stripe = true_stripe(scene, TRUTH, "left", 0.0)
        return float(stripe.brightness[np.abs(stripe.points_mm[:, 1]) < 5].mean())

    for tilt_deg in (-20.0, 20.0, 30.0):
        assert level(tilt_deg) / level(0.0) == pytest.approx(np.cos(np.radians(tilt_deg)), rel=0.01)


def test_through_a_hole_light_reaches_the_bench_unbent_and_unweakened() -> None:
    holed = named("glass-hole")
    bare = true_stripe(SceneBuilder("bare").build(), TRUTH, "left", 5.0)
    stripe = true_stripe(holed, TRUTH, "left", 5.0)
    inside = np.abs(stripe.points_mm[:, 1]) < 8
    same = np.abs(bare.points_mm[:, 1]) < 8
    np.testing.assert_array_equal(stripe.pixels[inside], bare.pixels[same])
    np.testing.assert_array_equal(stripe.brightness[inside], bare.brightness[same])
    ring = (np.abs(stripe.points_mm[:, 1]) > 25) & (np.abs(stripe.points_mm[:, 1]) < 40)
    plain = (np.abs(bare.points_mm[:, 1]) > 25) & (np.abs(bare.points_mm[:, 1]) < 40)
    assert stripe.brightness[ring].mean() / bare.brightness[plain].mean() == pytest.approx(TRANSMISSION**2, rel=0.01)


def test_a_mirror_shows_nothing_of_the_stripe_that_falls_on_it() -> None:
    scene = named("mirror")
    x_mm = -30.0
    stripe = true_stripe(scene, TRUTH, "left", x_mm)
    on_it = np.abs(stripe.points_mm[:, 1]) < 38
    assert not on_it.any()
    frame = render_stripe(scene, TRUTH, "left", x_mm, np.random.default_rng(0), 4e-3, True).astype(float)
    bare = true_stripe(SceneBuilder("bare").build(), TRUTH, "left", x_mm)
    rows = np.unique(np.round(bare.pixels[np.abs(bare.points_mm[:, 1]) < 30, 1]).astype(int))
    assert frame[rows].max(axis=1).mean() < 20


def test_a_mirror_shows_the_stripe_on_a_wall_at_the_mirrored_place() -> None:
    def excess_dn(floor: Material) -> float:
        builder = SceneBuilder("wall").box((-60, 60), (60, 100), 40.0).box((-60, 60), (-60, 60), 5.0, floor)
        frame = render_stripe(builder.build(), TRUTH, "left", 0.0, np.random.default_rng(0), 20e-3, True).astype(float)
        wall_mm = np.array([(TRUTH.plane_offset_mm(0.0) - TRUTH.laser_normal[1] * 60) / TRUTH.laser_normal[0], 60.0])
        u, v = np.round(TRUTH.left.project(np.array([[*wall_mm, 2 * 5.0 - 25.0]]))[0]).astype(int)  # z = 25 on the wall
        return float(frame[v - 3 : v + 4, u - 4 : u + 5].mean() - np.median(frame[v - 3 : v + 4, u - 60 : u + 61]))

    assert excess_dn(Material.MIRROR) > 20
    assert abs(excess_dn(Material.BLACK)) < 5


def test_a_tilted_mirror_throws_the_stripe_onto_the_wall_beside_it() -> None:
    builder = SceneBuilder("thrower").box((30, 60), (-60, 60), 60.0)
    top = plane_through(0.0, 0.0, 20.0, (np.radians(-40.0), 0.0))
    scene = builder.put(Body(builder.rectangle((-20, 20), (-40, 40)), top, Material.MIRROR)).build()
    frame = render_stripe(scene, TRUTH, "left", 0.0, np.random.default_rng(0), 4e-3, True).astype(float)
    # upright light leaves at 80 degrees from upright, rising: from (0, 0, 20) to the wall at x = 30
    spot = np.array([30.0, 0.0, 20.0 + 30.0 / np.tan(np.radians(80.0))])
    u, v = np.round(TRUTH.left.project(spot[None])[0]).astype(int)
    assert frame[v - 8 : v + 9, u - 8 : u + 9].max() > 40


@pytest.mark.parametrize("smoke_per_m", [0.3, 1.0, 2.0])
@pytest.mark.parametrize("side", ["left", "right"])
def test_the_stripes_contrast_falls_with_the_extinction_along_its_way(side: str, smoke_per_m: float) -> None:
    def crest_dn(air: Air) -> float:
        scene = SceneBuilder("bench").build()
        object.__setattr__(scene, "air", air)
        frames = [
            render_stripe(scene, TRUTH, side, 0.0, np.random.default_rng(k), 4e-3, True).astype(float) for k in range(3)
        ]
        lit = true_stripe(SceneBuilder("bench").build(), TRUTH, side, 0.0).rows(1024)
        total = 0.0
        for frame in frames:
            for row in range(480, 545):
                u = round(lit[row])
                total += frame[row, u - 9 : u + 10].sum() - 19 * np.median(frame[row, u - 60 : u + 61])
        return total

    way_m = 1e-3 * (np.linalg.norm(TRUTH.head_mm(0.0)) + np.linalg.norm(TRUTH.camera(side).centre_mm))
    ratio = crest_dn(Air(smoke_per_m=smoke_per_m)) / crest_dn(Air())
    assert -np.log(ratio) == pytest.approx(smoke_per_m * way_m, abs=0.02 + 0.03 * smoke_per_m)


def test_smoke_shows_the_lasers_sheet_on_the_side_away_from_the_camera() -> None:
    scene = named("smoke")
    for side, away in (("left", 1), ("right", -1)):
        shown = smoke_veil(scene, TRUTH, side, 0.0)[512]
        at = round(float(TRUTH.camera(side).project(np.array([[TRUTH.plane_offset_mm(0.0), 0.0, 0.0]]))[0, 0]))
        near = shown[at + 40 * away]
        assert shown[at - 40 * away] == 0
        # E smoke w / (4 cos), against white that shows E / pi; the way there and back weakens both
        camera, head = TRUTH.camera(side), TRUTH.head_mm(0.0)
        width_mm = TRUTH.stripe_sigma_px * 568.0 / camera.matrix[0, 0] * np.sqrt(2 * np.pi)
        towards = np.array([head[0], 0.0, 40.0]) - camera.centre_mm
        cosine = abs(towards @ TRUTH.laser_normal) / np.linalg.norm(towards)
        expected = 1e-3 * width_mm / (4 * cosine) * np.exp(-1e-3 * (460 + np.linalg.norm(towards)))
        assert near == pytest.approx(expected, rel=0.1)
        assert near * STRIPE_DN_PER_S * 4e-3 < 0.2


def test_the_bright_scene_is_bright_whatever_the_room() -> None:
    frames = [
        render_stripe(named(name), TRUTH, "left", 0.0, np.random.default_rng(0), 4e-3, True).astype(float)
        for name in ("demo", "bright")
    ]
    assert np.median(frames[1]) > 8 * np.median(frames[0])


@pytest.mark.parametrize("name", sorted(SCENES))
def test_every_scene_can_be_seen_by_both_cameras(name: str) -> None:
    scene = SCENES[name]()
    for side in ("left", "right"):
        frame = render_stripe(scene, TRUTH, side, -25.0, np.random.default_rng(0), 4e-3, True)
        assert frame.shape == (1024, 1280)
        assert frame.max() > 40


def test_a_black_bench_shows_nothing_through_glass() -> None:
    stripe = true_stripe(named("nothing-shared"), TRUTH, "left", 0.0)
    assert not (np.abs(stripe.points_mm[:, 1]) < 100).any()
