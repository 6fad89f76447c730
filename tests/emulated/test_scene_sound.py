"""Sound over sloping scenes: the image source of a tilted mirror, rigid motion, holes, drifting and smoky air."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from echolume_drivers.emulated import echoes, facets, transducer
from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import echo_waveforms
from echolume_drivers.emulated.scene import SCENES, Air, Material, Scene, SceneBuilder, named
from echolume_drivers.emulated.shapes import Body, level_at, plane_through, sphere_about
from echolume_drivers.emulated.stage import PING_S, Stage
from echolume_messages.geometry import Matrix, apply, rotation_from_euler, transform
from echolume_messages.rig import ArraySettings

AIR_C = 22.0
ARRAY = ArraySettings(port="none")
TRUTH = dataclasses.replace(array_truth(1, ARRAY), cross_talk=np.zeros(8), placement_mm=np.zeros((8, 3)))
SPEED_MM_PER_S = transducer.speed_of_sound_mps(AIR_C) * 1e3


@pytest.fixture(autouse=True)
def smooth_surfaces(monkeypatch: pytest.MonkeyPatch) -> None:
    """Closed forms know no roughness."""
    monkeypatch.setattr(echoes, "SCATTER_MM", 0.0)
    monkeypatch.setattr(echoes, "_surfaces", {})


def looking_down(x_mm: float, y_mm: float, z_mm: float, ry_deg: float = 0.0) -> Matrix:
    rotation = rotation_from_euler(np.pi, np.radians(ry_deg), 0.0)
    return transform(rotation, np.array([x_mm, y_mm, z_mm]))


def tilted(tilt_deg: tuple[float, float], z_mm: float = 45.0) -> Scene:
    builder = SceneBuilder("tilted")
    top = plane_through(0.0, 0.0, z_mm, (np.radians(tilt_deg[0]), np.radians(tilt_deg[1])))
    return builder.put(Body(builder.rectangle((-120, 120), (-120, 120)), top, Material.GLASS)).build()


def normal_of(tilt_deg: tuple[float, float]) -> np.ndarray:
    normal = np.array([-np.tan(np.radians(tilt_deg[0])), -np.tan(np.radians(tilt_deg[1])), 1.0])
    return normal / np.linalg.norm(normal)


def image_source(pose: Matrix, normal: np.ndarray, foot_mm: np.ndarray) -> np.ndarray:
    """Record of the emitter's image in a mirror through `foot_mm`, with both pistons' beams and mean longer way."""
    f = np.arange(ARRAY.samples // 2 + 1) * ARRAY.sample_rate_hz / ARRAY.samples
    ka = 2 * np.pi * f / SPEED_MM_PER_S * TRUTH.radius_mm
    elements = apply(pose, np.array([ARRAY.layout.emitter_mm, *ARRAY.layout.receivers_mm]))
    image = elements[0] - 2 * ((elements[0] - foot_mm) @ normal) * normal
    rows = []
    for pulse, receiver in zip(transducer.channel_spectra(ARRAY, TRUTH, f), elements[1:], strict=True):
        path = np.linalg.norm(receiver - image)
        arriving = (receiver - image) / path
        leaving = arriving - 2 * (arriving @ normal) * normal
        cosines = [way @ pose[:3, 2] for way in (arriving, leaving)]
        beams = np.prod([transducer.directivity(np.full(len(f), 1 - c**2), ka) for c in cosines], axis=0)
        longer = TRUTH.radius_mm**2 / 8 * sum(1 + c**2 for c in cosines) / path
        rows.append(pulse * beams * np.exp(-2j * np.pi * f * (path + longer) / SPEED_MM_PER_S) / path)
    scale = echoes.REFERENCE_COUNTS * echoes.REFERENCE_PATH_MM * ARRAY.sample_rate_hz
    return scale * np.fft.irfft(np.array(rows), n=ARRAY.samples, axis=1)


def gain_and_delay_mm(found: np.ndarray, expected: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Best gain and delay (as path) of each row of `found` against `expected`."""
    f = np.fft.rfftfreq(found.shape[1], 1 / ARRAY.sample_rate_hz)
    lags_s = np.linspace(-3e-6, 3e-6, 6001)
    turn = np.exp(2j * np.pi * np.outer(f, lags_s))
    cross = np.real((np.fft.rfft(found) * np.conj(np.fft.rfft(expected))) @ turn)
    norm = np.sum(np.abs(np.fft.rfft(expected)) ** 2, axis=1)
    return cross.max(axis=1) / norm, lags_s[cross.argmax(axis=1)] * SPEED_MM_PER_S


@pytest.mark.parametrize(
    ("tilt_deg", "ry_deg"),
    [
        ((5.0, 0.0), 0.0),
        ((5.0, 0.0), 5.0),
        ((10.0, 0.0), 0.0),
        ((10.0, 0.0), -4.0),
        ((0.0, -10.0), 0.0),
        ((7.0, 7.0), 0.0),
    ],
)
def test_a_tilted_plate_returns_the_echo_of_its_mirror_image(tilt_deg: tuple[float, float], ry_deg: float) -> None:
    pose = looking_down(10.0, 5.0, 195.0, ry_deg)
    found = echo_waveforms(tilted(tilt_deg), pose, ARRAY, TRUTH, AIR_C)
    gains, delays_mm = gain_and_delay_mm(found, image_source(pose, normal_of(tilt_deg), np.array([0.0, 0.0, 45.0])))
    np.testing.assert_allclose(gains, 1, atol=0.01)
    np.testing.assert_allclose(delays_mm, 0, atol=0.02)


def test_at_20_degrees_level_and_time_still_hold() -> None:
    pose = looking_down(10.0, 5.0, 195.0, 0.0)
    found = echo_waveforms(tilted((20.0, 0.0)), pose, ARRAY, TRUTH, AIR_C)
    gains, delays_mm = gain_and_delay_mm(found, image_source(pose, normal_of((20.0, 0.0)), np.array([0.0, 0.0, 45.0])))
    np.testing.assert_allclose(gains, 1, atol=0.05)
    np.testing.assert_allclose(delays_mm, 0, atol=0.06)


def test_plate_and_array_may_be_tilted_together() -> None:
    level = echo_waveforms(tilted((0.0, 0.0)), looking_down(0.0, 0.0, 195.0), ARRAY, TRUTH, AIR_C)
    turned = transform(rotation_from_euler(0.0, np.radians(-10.0), 0.0), np.zeros(3))
    lifted = transform(np.eye(3), np.array([0.0, 0.0, 45.0]))
    pose = lifted @ turned @ looking_down(0.0, 0.0, 150.0)
    gains, delays_mm = gain_and_delay_mm(echo_waveforms(tilted((10.0, 0.0)), pose, ARRAY, TRUTH, AIR_C), level)
    np.testing.assert_allclose(gains, 1, atol=0.01)
    np.testing.assert_allclose(delays_mm, 0, atol=0.01)


def test_a_tilt_of_nothing_is_the_level_plate() -> None:
    pose = looking_down(3.0, 5.0, 195.0)
    level, nearly = (echo_waveforms(tilted((t, 0.0)), pose, ARRAY, TRUTH, AIR_C) for t in (0.0, 1e-5))
    assert 10 * np.log10(np.sum((level - nearly) ** 2) / np.sum(level**2)) < -40


def test_a_ball_returns_from_its_nearest_point() -> None:
    builder = SceneBuilder("ball").box((-120, 120), (-120, 120), 0.0)
    ball = builder.put(Body(builder.disc(0.0, 0.0, 30.0), sphere_about(0.0, 0.0, 0.0, 30.0))).build()
    bare = SceneBuilder("bare").build()
    pose = looking_down(0.0, 0.0, 150.0)
    found, bench = (echo_waveforms(s, pose, ARRAY, TRUTH, AIR_C) for s in (ball, bare))
    elements = apply(pose, np.array([ARRAY.layout.emitter_mm, *ARRAY.layout.receivers_mm]))
    # the shortest way over the ball, and a mirror ball's divergence: R / 2 over the distance to its skin
    skin = np.array([[30 * np.sin(a), 0, 30 * np.cos(a)] for a in np.linspace(-0.5, 0.5, 2001)])
    for n in (3, 4):  # receivers on the x axis
        way_mm = np.min(np.linalg.norm(skin - elements[0], axis=1) + np.linalg.norm(skin - elements[1 + n], axis=1))
        arrival_s = way_mm / SPEED_MM_PER_S + TRUTH.delays_s[n]
        early = found[n, : round((arrival_s + 5e-5) * ARRAY.sample_rate_hz)]
        assert abs(np.abs(early).argmax() / ARRAY.sample_rate_hz - arrival_s) < 1.2e-5
        expected = (30 / 2) / 120 / 120 * 300 / (1 + 15 / 120)  # against a plate at 150 mm
        assert np.abs(early).max() / np.abs(bench[n]).max() == pytest.approx(expected, rel=0.2)


def test_every_surface_is_covered_once_by_level_and_tilted_facets() -> None:
    for name in ("glass-tilt-10", "bottle", "sphere"):
        found = facets.build_facets(named(name))
        level_mm2 = found.size_mm.prod(axis=1)[found.kind == facets.HORIZONTAL].sum()
        assert level_mm2 + np.sum(found.tilted[:, 3] ** 2) == pytest.approx((2 * facets.BENCH_MM) ** 2)


def test_a_tilted_plate_is_merged_and_joins_without_walls() -> None:
    found = facets.build_facets(tilted((10.0, 0.0)))
    assert set(found.tilted[:, 3]) == {4.0}
    inner = np.abs(found.centre_mm[found.kind != facets.HORIZONTAL, :2]).max(axis=1) < 119
    assert not inner.any()


def test_a_plate_in_the_air_has_walls_as_high_as_it_is_thick() -> None:
    builder = SceneBuilder("plate")
    plate = Body(builder.rectangle((-40, 40), (-30, 30)), level_at(25.0), Material.GLASS, 4.0, level=True)
    found = facets.build_facets(builder.put(plate).build())
    walls = found.kind != facets.HORIZONTAL
    assert found.size_mm[walls].prod(axis=1).sum() == pytest.approx(2 * (80 + 60) * 4.0)
    assert found.centre_mm[walls, 2].min() > 21.0
    assert set(found.floor_mm[walls]) == {0.0}


def test_through_a_hole_comes_the_echo_of_the_bench() -> None:
    def late_energy(scene: Scene) -> float:
        pose = looking_down(5.0, 0.0, 150.0)
        found = echo_waveforms(scene, pose, ARRAY, TRUTH, AIR_C)
        bench_s = 300 / SPEED_MM_PER_S + TRUTH.delays_s
        lags = np.arange(ARRAY.samples) / ARRAY.sample_rate_hz
        return float(np.sum(found[np.abs(lags - bench_s[:, None]) < 3e-5] ** 2))

    def plate(hole_mm: float) -> Scene:
        builder = SceneBuilder("plate")
        where = builder.rectangle((-60, 60), (-50, 50)) & ~builder.disc(5.0, 0.0, hole_mm / 2)
        return builder.put(Body(where, level_at(25.0), Material.GLASS, 4.0, level=True)).build()

    assert late_energy(plate(60.0)) > 5 * late_energy(plate(0.0))
    assert late_energy(plate(60.0)) > 2 * late_energy(plate(20.0))


def test_a_perforated_sheet_returns_less_than_a_whole_one() -> None:
    def first(perforated: bool) -> float:
        scene = named("perforated")
        if not perforated:
            builder = SceneBuilder("whole")
            scene = builder.put(Body(builder.rectangle((-60, 60), (-48, 48)), level_at(20.0), thickness_mm=2.0)).build()
        found = echo_waveforms(scene, looking_down(0.0, 0.0, 150.0), ARRAY, TRUTH, AIR_C)
        sheet_s = 260 / SPEED_MM_PER_S + TRUTH.delays_s
        lags = np.arange(ARRAY.samples) / ARRAY.sample_rate_hz
        return float(np.abs(found[np.abs(lags - sheet_s[:, None]) < 2e-5]).max())

    open_share = float(np.mean(named("perforated").front_mm[80:160, 80:160] == 0))
    assert 0.2 < open_share < 0.5
    assert first(True) / first(False) == pytest.approx(1 - open_share, abs=0.1)


def test_steep_glass_returns_no_more_than_its_rim() -> None:
    steep, gone = named("glass-steep"), named("glass-steep")
    level = np.where(steep.material == Material.GLASS, 0.0, steep.front_mm)
    gone = dataclasses.replace(
        gone, front_mm=level, optical_mm=level, front_slope=None, underside_mm=None, glass_mm=None, panes=None,
        material=np.zeros_like(steep.material),
    )  # fmt: skip
    flat = dataclasses.replace(gone, front_mm=np.where(steep.material == Material.GLASS, 30.0, level))
    for x_mm in (60.0, 80.0, 100.0):
        pose = looking_down(x_mm, 0.0, 150.0)
        records = [echo_waveforms(s, pose, ARRAY, TRUTH, AIR_C)[:, :212] for s in (steep, flat)]  # before the bench
        assert np.abs(records[0]).max() < 0.25 * np.abs(records[1]).max()


def test_a_kelvin_moves_every_path_by_a_sixth_of_a_percent() -> None:
    pose = looking_down(0.0, 0.0, 150.0)
    plate = SCENES["plate"]()
    cold, warm = (echo_waveforms(plate, pose, ARRAY, TRUTH, t) for t in (19.5, 20.5))
    _, delays_mm = gain_and_delay_mm(warm, cold)
    # `gain_and_delay_mm` counts in the speed at 22 degrees
    path_mm = 300 * transducer.speed_of_sound_mps(22.0) / transducer.speed_of_sound_mps(20.0)
    np.testing.assert_allclose(-delays_mm / path_mm, 0.00171, atol=0.00006)


def test_a_drifting_air_drifts_from_ping_to_ping_and_the_thermometer_lags() -> None:
    stage = Stage(1, named("drift"))
    seen = np.array([stage.next_air_c() for _ in range(481)])
    minutes = np.arange(481) * PING_S / 60
    np.testing.assert_allclose(seen[:, 0], 20.0 + minutes, atol=1e-9)
    lag_min = 2.0
    np.testing.assert_allclose(seen[:, 1], 20.0 + minutes - lag_min * (1 - np.exp(-minutes / lag_min)), atol=1e-9)
    assert seen[-1, 0] - seen[-1, 1] > 1.5
    stage.place(scene=named("drift"))
    assert stage.next_air_c() == (20.0, 20.0)
    stage.place(scene=named("demo"))
    assert {stage.next_air_c() for _ in range(3)} == {(22.0, 22.0)}


def test_smoke_takes_from_sound_what_its_file_says_and_no_more() -> None:
    plate = SCENES["plate"]()
    smoky = dataclasses.replace(plate, air=Air(smoke_per_m=1.0, sound_db_per_m=2.0))
    clean = dataclasses.replace(plate, air=Air(smoke_per_m=1.0))
    pose = looking_down(0.0, 0.0, 150.0)
    bare, weak, same = (echo_waveforms(s, pose, ARRAY, TRUTH, AIR_C) for s in (plate, smoky, clean))
    np.testing.assert_array_equal(bare, same)
    gains, delays_mm = gain_and_delay_mm(weak, bare)
    np.testing.assert_allclose(gains, 10 ** (-2.0 * 0.3 / 20), rtol=0.003)
    np.testing.assert_allclose(delays_mm, 0, atol=0.002)


@pytest.mark.parametrize("name", sorted(SCENES))
def test_every_scene_can_be_heard(name: str) -> None:
    record = echo_waveforms(SCENES[name](), looking_down(-30.0, 10.0, 150.0), ARRAY, TRUTH, AIR_C)
    assert np.isfinite(record).all()
    assert np.abs(record).max() > 1000
