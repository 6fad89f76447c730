"""What the emulated pictures suffer from: each disturbance is as strong as physics says, and can be switched off."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scipy.special import j1

from echolume_drivers.emulated.board_image import board_at, board_light, board_poses, render_board
from echolume_drivers.emulated.flaws import BRIGHT_ROOM, DARK_LAB, FLAWLESS, Flaws, Lens
from echolume_drivers.emulated.optics import OpticalTruth, Side, optical_truth
from echolume_drivers.emulated.scene import Material, Scene, SceneBuilder, demo, plate
from echolume_drivers.emulated.sensor import READ_NOISE_DN, Sensor, expose
from echolume_drivers.emulated.speckle import speckle_tile
from echolume_drivers.emulated.stripe_image import SCENE_ALBEDO, STRIPE_DN_PER_S, render_stripe, true_stripe

SIDES: tuple[Side, Side] = ("left", "right")
SHARP = Lens(focus_mm=None)
EXPOSURE_S = 4e-3
CREST_DN = STRIPE_DN_PER_S * EXPOSURE_S


def rig(lens: Lens = SHARP, **flaws: object) -> OpticalTruth:
    """A rig with these disturbances only."""
    return optical_truth(3, replace(FLAWLESS, **flaws), lens)


def shot(scene: Scene, truth: OpticalTruth, x_mm: float, side: Side = "left", laser_on: bool = True) -> np.ndarray:
    return render_stripe(scene, truth, side, x_mm, np.random.default_rng(1), EXPOSURE_S, laser_on).astype(float)


def around(frame: np.ndarray, truth: OpticalTruth, side: Side, point_mm: tuple[float, float, float]) -> np.ndarray:
    """The frame's part within 3 px of where a point is seen."""
    u, v = truth.camera(side).project(np.array([point_mm]))[0].round().astype(int)
    return frame[v - 3 : v + 4, u - 3 : u + 4]


# --- speckle


def pixel_contrast(grain_px: float) -> float:
    """Contrast left after a square pixel averages the speckle of a round aperture (Goodman, section 4.6)."""
    d = np.linspace(-1, 1, 801)
    r = np.pi * np.hypot(d[:, None], d) / grain_px
    correlation = np.where(r > 0, 2 * j1(r) / np.where(r > 0, r, 1), 1.0) ** 2
    weight = np.outer(1 - np.abs(d), 1 - np.abs(d))
    return float(np.sqrt((correlation * weight).sum() / weight.sum()))


@pytest.mark.parametrize(
    ("wavelength_nm", "pixel_um", "grain_px"), [(660, 4.8, 1.12), (405, 4.8, 0.69), (660, 3.45, 1.56)]
)
def test_a_speckle_grain_is_wavelength_times_f_number_times_one_plus_magnification(
    wavelength_nm: float, pixel_um: float, grain_px: float
) -> None:
    truth = optical_truth(3, lens=Lens(wavelength_nm=wavelength_nm, f_number=8.0, pixel_um=pixel_um))
    assert truth.left.grain_px == pytest.approx(grain_px, rel=0.02)


@pytest.mark.parametrize("grain_px", [0.7, 1.1, 2.5])
def test_a_pixel_averages_over_the_grains_in_it(grain_px: float) -> None:
    tile = speckle_tile(grain_px, 4)
    assert tile.mean() == pytest.approx(1.0, abs=1e-5)
    assert tile.std() == pytest.approx(pixel_contrast(grain_px) / np.sqrt(4), rel=0.05)


def test_coarse_grain_is_alike_in_neighbouring_pixels_and_fine_grain_is_not() -> None:
    alike = {
        g: np.corrcoef(*(speckle_tile(g, 8)[a].ravel() for a in (slice(1, None), slice(-1))))[0, 1] for g in (0.7, 2.5)
    }
    assert alike[0.7] < 0.2
    assert alike[2.5] > 0.6


def test_red_light_scatters_the_stripe_more_than_violet_light() -> None:
    error_px = {}
    for wavelength_nm in (405.0, 660.0):
        truth = rig(Lens(wavelength_nm=wavelength_nm, focus_mm=None), speckle_looks=20)
        frame, line = shot(plate(), truth, 0.0), true_stripe(plate(), truth, "left", 0.0).rows(1024)
        rows = np.arange(100, 900)
        window = line[rows].round().astype(int)[:, None] + np.arange(-8, 9)
        light = frame[rows[:, None], window] - np.median(frame)
        error_px[wavelength_nm] = np.std((light * window).sum(axis=1) / light.sum(axis=1) - line[rows])
    assert 0.06 < error_px[405.0] < error_px[660.0] / 1.2


# --- defocus


def test_blur_grows_with_the_distance_from_the_plane_of_focus_and_with_the_aperture() -> None:
    for f_number, far_sigma_px in ((8.0, 0.195), (2.8, 0.557)):
        lens = Lens(f_number=f_number)
        blur_px, focus_mm = lens.focus_row(2420.0)
        aperture_mm = 11.6 / f_number
        disc_um = aperture_mm * 11.6 / (focus_mm - 11.6) * 80 / (focus_mm + 80) * 1e3
        assert blur_px * (1 - focus_mm / (focus_mm + 80)) == pytest.approx(disc_um / 4 / lens.pixel_um, rel=0.01)
        assert blur_px * (1 - focus_mm / (focus_mm + 80)) == pytest.approx(far_sigma_px, rel=0.03)


def test_the_stripe_is_wider_and_dimmer_but_not_darker_away_from_the_plane_of_focus() -> None:
    def profile(lens: Lens) -> np.ndarray:
        truth = rig(lens)
        frame = shot(plate(), truth, -95.0, "right") - shot(plate(), truth, -95.0, "right", False).mean()
        centre = round(float(np.nanmedian(true_stripe(plate(), truth, "right", -95.0).rows(1024)[500:530])))
        return frame[500:530, centre - 15 : centre + 16].mean(axis=0)

    dark = SCENE_ALBEDO * FLAWLESS.ambient_dn_per_s * EXPOSURE_S
    lamp = shot(plate(), rig(), 0.0, "right", False).mean()
    sharp, blurred = (profile(lens) + lamp - dark for lens in (SHARP, Lens(f_number=1.4)))
    assert blurred.max() < 0.95 * sharp.max()
    assert blurred.sum() == pytest.approx(sharp.sum(), rel=0.02)


def test_the_edges_of_the_board_are_softer_where_it_is_out_of_focus() -> None:
    poses = [board_poses(3)[0], board_poses(3)[0].copy()]
    poses[1][2, 3] = 60.0  # the left camera's near corner is then 80 mm nearer than its plane of focus

    def steepest(lens: Lens, pose: np.ndarray) -> float:
        camera = rig(lens).left
        image = board_light(board_at(pose), camera)
        return float(np.abs(np.diff(around(image, rig(lens), "left", tuple(pose[:3, 3])), axis=1)).max())

    softer = [steepest(Lens(f_number=2.0), pose) / steepest(SHARP, pose) for pose in poses]
    assert 0.9 < softer[0] < 1.0
    assert softer[1] < 0.75


# --- room light, hot pixels, blooming


def test_the_dark_labs_light_is_faint_and_the_bright_rooms_is_not() -> None:
    dark, bright = (shot(plate(), optical_truth(3, flaws), -140.0) for flaws in (DARK_LAB, BRIGHT_ROOM))
    assert np.median(dark) == pytest.approx(SCENE_ALBEDO * 5.0, abs=1)
    assert np.median(bright) == pytest.approx(SCENE_ALBEDO * 60.0, abs=2)


@pytest.mark.parametrize("laser_on", [True, False])
def test_room_light_changes_evenly_over_the_image_around_its_mean(laser_on: bool) -> None:
    even, uneven = (
        shot(plate(), rig(ambient_dn_per_s=15000.0, ambient_gradient=g), 139.0, "left", laser_on)
        for g in ((0.0, 0.0), (0.5, -0.35))
    )
    change = (uneven - even)[:, :1200]
    u, v = np.arange(1200) / 1280 - 0.5, np.arange(1024)[:, None] / 1024 - 0.5
    assert np.abs(change.mean(axis=0) - 36 * 0.5 * u).max() < 0.6
    assert np.abs(change.mean(axis=1) - 36 * (0.5 * u.mean() - 0.35 * v[:, 0])).max() < 0.6


def test_room_light_lies_unevenly_on_the_board_too() -> None:
    board = board_at(board_poses(3)[0])
    left, right = (
        render_board(board, rig(ambient_dn_per_s=15000.0, ambient_gradient=(g, 0.0)), "left", 0.0,
                     np.random.default_rng(0), EXPOSURE_S, False).astype(float)
        for g in (-0.5, 0.5)
    )  # fmt: skip
    ratio = left.mean(axis=0) / right.mean(axis=0)
    assert ratio[:100].mean() > 1.1
    assert ratio[-100:].mean() < 0.9


def test_hot_pixels_stay_where_they_are_and_grow_with_the_exposure() -> None:
    truth = optical_truth(3, replace(FLAWLESS, hot_share=1e-3))
    row, column = truth.left.hot[:, 0].astype(int), truth.left.hot[:, 1].astype(int)
    assert len(row) == round(1e-3 * 1280 * 1024)
    excess = []
    for exposure_s in (4e-3, 8e-3):
        frame = render_stripe(plate(), truth, "left", -140.0, np.random.default_rng(7), exposure_s, True)
        excess.append(frame[row, column].mean() - np.median(frame))
    assert excess[0] == pytest.approx(6000.0 * 4e-3, rel=0.15)
    assert excess[1] == pytest.approx(2 * excess[0], rel=0.1)


def test_each_camera_has_its_own_hot_pixels_drawn_by_the_seed() -> None:
    assert np.array_equal(optical_truth(3).left.hot, optical_truth(3).left.hot)
    assert not np.array_equal(optical_truth(3).left.hot, optical_truth(3).right.hot)
    assert not np.array_equal(optical_truth(3).left.hot, optical_truth(4).left.hot)


def test_a_full_pixel_leaks_into_its_four_neighbours() -> None:
    def develop(blooming: float) -> np.ndarray:
        laser, touched = np.zeros((9, 20), dtype=np.float32), np.zeros((9, 2), dtype=np.int64)
        laser[4, 10], touched[4] = 2280.0, (10, 11)
        return expose(np.random.default_rng(0), 0.0, laser, touched, Sensor(None, blooming, 280.0)).astype(float)

    none, some = develop(0.0), develop(0.2)
    for row, column in ((3, 10), (5, 10), (4, 9), (4, 11)):
        assert none[row, column] < 10
        assert some[row, column] == pytest.approx(100, abs=12)
    assert some[3, 9] < 10
    assert none[4, 10] == some[4, 10] == 255


def test_blooming_brightens_the_flanks_of_a_saturated_stripe_only() -> None:
    def exposed(blooming: float, exposure_s: float) -> np.ndarray:
        rng = np.random.default_rng(0)
        return render_stripe(plate(), rig(blooming=blooming), "left", 0.0, rng, exposure_s, True).astype(float)

    assert np.array_equal(exposed(0.0, EXPOSURE_S), exposed(0.2, EXPOSURE_S))
    none, some = exposed(0.0, 10 * EXPOSURE_S), exposed(0.2, 10 * EXPOSURE_S)
    flank = (none < 255) & (np.roll(none, 1, axis=1) == 255)
    assert 2 < (some - none)[flank].mean() < 20
    assert (some - none)[~flank & (none < 255)].mean() < 0.1


# --- glint


def body(material: Material) -> Scene:
    return SceneBuilder("body").box((-30, 30), (-30, 30), 20.0, material).build()


@pytest.mark.parametrize("material", [Material.BLACK, Material.GLASS, Material.GLOSSY])
def test_worn_edges_that_cross_the_stripe_glint(material: Material) -> None:
    shining = {}
    for strength in (0.0, 1.0):
        truth = rig(glint=strength)
        shining[strength] = max(
            around(shot(body(material), truth, x_mm, side), truth, side, (x_mm, y_mm, 20.0)).max()
            for x_mm in (-10.0, 0.0, 10.0) for y_mm in (-30.0, 30.0) for side in SIDES
        )  # fmt: skip
    assert shining[1.0] > shining[0.0] + 15


def test_matte_edges_do_not_glint() -> None:
    assert np.array_equal(shot(body(Material.MATTE), rig(glint=1.0), 0.0), shot(body(Material.MATTE), rig(), 0.0))


def test_an_edge_along_the_stripe_shines_into_the_camera_that_it_faces() -> None:
    def extra(side: Side) -> float:
        truths = rig(glint=1.0), rig()
        x_mm = 30.0 - truths[0].laser_offset_mm
        lit, unlit = (shot(body(Material.BLACK), truth, x_mm, side) for truth in truths)
        rows = truths[0].camera(side).project(np.array([[30.0, -25.0, 20.0], [30.0, 25.0, 20.0]]))[:, 1]
        return float((lit - unlit)[int(rows[1]) : int(rows[0])].max(axis=1).mean())

    assert extra("right") > 60
    assert extra("right") > 2 * extra("left")


def test_glass_returns_a_hundredth_of_the_light_and_mirrors_the_rest_past_the_cameras() -> None:
    scene = SceneBuilder("glass").box((-60, 60), (-60, 60), 20.0, Material.GLASS).build()

    def on_top(truth: OpticalTruth, x_mm: float, side: Side) -> float:
        seen = around(shot(scene, truth, x_mm, side), truth, side, (x_mm + truth.laser_offset_mm, 20.0, 20.0))
        return float(seen[:, 2:5].max(axis=1).mean())

    for flaws, expected in (({"glass_haze": 0.05}, 0.05), ({"glint": 1.0}, 0.0)):
        more = [on_top(rig(**flaws), x, s) - on_top(rig(), x, s) for x in (-20.0, 0.0, 20.0) for s in SIDES]
        assert np.median(more) == pytest.approx(expected * CREST_DN, abs=2.0)
    assert DARK_LAB.glass_haze * CREST_DN < READ_NOISE_DN, "the default stays in the read noise"


def test_a_camera_in_the_mirror_direction_is_dazzled_by_glass() -> None:
    scene = SceneBuilder("glass").box((-60, 60), (-60, 60), 20.0, Material.GLASS).build()
    truth = rig(glint=1.0)
    # With the head at z = 500 over y = 0, this eye sees it mirrored at (0, 0, 20).
    pose = truth.left.camera_from_rig.copy()
    pose[:3, 3] = -pose[:3, :3] @ np.array([-260.0, 0.0, 500.0])
    left = replace(truth.left, camera_from_rig=pose)
    head = truth.head_at_zero_mm.copy()
    head[0] += 260.0
    dazzled = replace(truth, left=left, laser_offset_mm=float(truth.laser_normal @ head), head_at_zero_mm=head)
    tilted = _fan_through(dazzled, np.array([0.0, 0.0, 20.0]))
    assert around(shot(scene, tilted, 0.0), tilted, "left", (0.0, 0.0, 20.0)).max() > 30


def _fan_through(truth: OpticalTruth, point_mm: np.ndarray) -> OpticalTruth:
    """The same head, its fan turned about y so that it meets a point."""
    way = truth.head_at_zero_mm - point_mm
    normal = np.cross([0.0, 1.0, 0.0], way)
    normal /= np.linalg.norm(normal)
    return replace(truth, laser_normal=normal, laser_offset_mm=float(normal @ point_mm))


# --- second stripes


def beside_a_wall(distance_mm: float, material: Material = Material.MATTE, **flaws: object) -> np.ndarray:
    """Brightness (41,) along a wall 30 mm high at x = 20, from its foot up, with the stripe `distance_mm` before it."""
    scene = SceneBuilder("wall").box((20, 60), (-60, 60), 30.0, material).build()
    truth = rig(ambient_dn_per_s=0.0, **flaws)
    frame = shot(scene, truth, 20.0 - distance_mm - truth.laser_offset_mm - 20 * (truth.laser_normal[0] - 1))
    heights = np.linspace(0, 10, 41)
    pixels = truth.left.project(np.stack([np.full(41, 20.0), np.zeros(41), heights], axis=1)).round().astype(int)
    return np.array([frame[v - 20 : v + 21, u].mean() for u, v in pixels])


@pytest.mark.parametrize("distance_mm", [3.0, 5.0])
def test_a_matte_wall_beside_the_stripe_is_lit_as_lamberts_law_says(distance_mm: float) -> None:
    # Ten times as strong, to see it well above the noise.
    lit = (beside_a_wall(distance_mm, secondary=10.0) - beside_a_wall(distance_mm)) / 10
    crest_mm = np.linspace(0, 10, 41)[lit.argmax()]
    assert crest_mm == pytest.approx(distance_mm / np.sqrt(2), abs=0.6)
    line_mm = rig().stripe_sigma_px * 568 / rig().left.matrix[0, 0] * np.sqrt(2 * np.pi)
    expected = SCENE_ALBEDO * 0.5 * line_mm * 0.385 / distance_mm * CREST_DN
    assert lit.max() == pytest.approx(expected, rel=0.2)


def test_a_wall_shows_the_stripe_a_second_time_as_far_behind_it_as_the_stripe_lies_before() -> None:
    scene = SceneBuilder("wall").box((20, 60), (-60, 60), 30.0).build()
    truth, distance_mm = rig(sheen=0.2, ambient_dn_per_s=0.0), 4.0
    x_mm = 20.0 - distance_mm - truth.laser_offset_mm
    stripe = true_stripe(scene, truth, "left", x_mm)
    middle = stripe.points_mm[np.abs(stripe.points_mm[:, 1]).argmin()]
    behind = (40.0 - float(middle[0]), float(middle[1]), 0.0)
    found = around(shot(scene, truth, x_mm), truth, "left", behind).mean(axis=0)
    without = around(shot(scene, rig(ambient_dn_per_s=0.0), x_mm), truth, "left", behind).mean(axis=0)
    assert (found - without).argmax() in (2, 3, 4)
    assert (found - without).max() == pytest.approx(0.2 * CREST_DN, rel=0.15)


def test_black_walls_are_not_lit_but_mirror_a_little_more() -> None:
    assert np.abs(beside_a_wall(3.0, Material.BLACK, secondary=1.0) - beside_a_wall(3.0, Material.BLACK)).max() < 0.7
    black, matte = (beside_a_wall(3.0, m, sheen=0.2) - beside_a_wall(3.0, m) for m in (Material.BLACK, Material.MATTE))
    assert black.max() > matte.max() > 10


def test_the_camera_behind_a_wall_sees_nothing_of_it() -> None:
    scene = SceneBuilder("wall").box((20, 60), (-60, 60), 30.0).build()
    frames = [shot(scene, rig(**flaws), 16.0, "right") for flaws in ({}, {"secondary": 1.0, "sheen": 0.2})]
    assert np.array_equal(*frames)


def test_second_stripes_are_faint_beside_the_first() -> None:
    with_all = shot(demo(), optical_truth(3, replace(FLAWLESS, secondary=1.0, sheen=Flaws().sheen), SHARP), -72.0)
    extra = with_all - shot(demo(), rig(), -72.0)
    assert 5 < extra.max() < 0.25 * CREST_DN


# --- all of them


def test_the_same_noise_key_gives_the_same_picture_with_everything_switched_on() -> None:
    for truth in (optical_truth(3), optical_truth(3, BRIGHT_ROOM, Lens(wavelength_nm=660))):
        first, again = (shot(demo(), truth, -72.0) for _ in range(2))
        assert np.array_equal(first, again)


def test_disturbances_change_nothing_of_the_rigs_build() -> None:
    plain, full = optical_truth(3, FLAWLESS, SHARP), optical_truth(3)
    assert np.array_equal(plain.left.packed[:21], full.left.packed[:21])
    assert np.array_equal(plain.head_at_zero_mm, full.head_at_zero_mm)
    assert plain.stripe_sigma_px == full.stripe_sigma_px
