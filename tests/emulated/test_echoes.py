"""The emulated echoes obey the wave physics that has closed forms: image sources, pistons, shadows."""

from __future__ import annotations

import dataclasses

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated import echoes, facets, scene, transducer
from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import echo_waveforms, simulate_ping
from echolume_messages.geometry import apply, rotation_from_euler, transform
from echolume_messages.rig import ArrayElementLayout, ArraySettings

AIR_C = 22.0
ARRAY = ArraySettings(port="none")
PAPER = ArraySettings(port="none", pulse="paper")


def looking_down(x_mm=0.0, y_mm=0.0, z_mm=150.0, rx_deg=0.0, ry_deg=0.0):
    rotation = rotation_from_euler(np.pi + np.radians(rx_deg), np.radians(ry_deg), 0.0)
    return transform(rotation, np.array([x_mm, y_mm, z_mm]))


def without_cross_talk(truth):
    """Closed forms know neither the direct sound nor how far the receivers are off their drawing."""
    return dataclasses.replace(truth, cross_talk=0 * truth.cross_talk, placement_mm=0 * truth.placement_mm)


TRUTH = without_cross_talk(array_truth(1, ARRAY))
FLAT = scene.plate()


@pytest.fixture(autouse=True)
def smooth_surfaces(monkeypatch):
    """Closed forms know no roughness."""
    monkeypatch.setattr(echoes, "SCATTER_MM", 0.0)
    monkeypatch.setattr(echoes, "_surfaces", {})


def image_source(rig_from_array, mirror, shift_mm, array=ARRAY, truth=TRUTH):
    """Record of one image of the emitter: point x -> mirror * x + shift, with both pistons' directivity."""
    speed = transducer.speed_of_sound_mps(AIR_C) * 1e3
    f = np.arange(array.samples // 2 + 1) * array.sample_rate_hz / array.samples
    ka = 2 * np.pi * f / speed * truth.radius_mm
    elements = apply(rig_from_array, np.array([array.layout.emitter_mm, *array.layout.receivers_mm]))
    emitter = elements[0] * mirror + shift_mm
    pulses = transducer.channel_spectra(array, truth, f)
    rows, paths = [], []
    for pulse, receiver in zip(pulses, elements[1:], strict=True):
        way = receiver - emitter
        path = np.linalg.norm(way)
        leaving = way / path * mirror
        sines = [1 - (u @ rig_from_array[:3, 2]) ** 2 for u in (way / path, leaving)]
        beams = [transducer.directivity(np.full(len(f), s), ka) for s in sines]
        rows.append(pulse * beams[0] * beams[1] * np.exp(-2j * np.pi * f * path / speed) / path)
        paths.append(path)
    scale = echoes.REFERENCE_COUNTS * echoes.REFERENCE_PATH_MM * array.sample_rate_hz
    return scale * np.fft.irfft(np.array(rows), n=array.samples, axis=1), np.array(paths)


def floor_image(pose, **kwargs):
    return image_source(pose, np.array([1, 1, -1]), np.zeros(3), **kwargs)


def residual_db(found, expected):
    return 10 * np.log10(np.sum((found - expected) ** 2) / np.sum(found**2))


def gain_and_delay_mm(found, expected, rate_hz=250e3):
    """Best gain and delay (as path) of each row of `found` against `expected`."""
    f = np.fft.rfftfreq(found.shape[1], 1 / rate_hz)
    lags_s = np.linspace(-1.5e-6, 1.5e-6, 3001)
    turn = np.exp(2j * np.pi * np.outer(f, lags_s))
    cross = np.real((np.fft.rfft(found) * np.conj(np.fft.rfft(expected))) @ turn)
    best = cross.argmax(axis=1)
    norm = np.sum(np.abs(np.fft.rfft(expected)) ** 2, axis=1)
    return cross.max(axis=1) / norm, lags_s[best] * transducer.speed_of_sound_mps(AIR_C) * 1e3


class TestPlate:
    @pytest.mark.parametrize(
        ("z_mm", "rx_deg", "ry_deg"), [(150, 0, 0), (150, 5, 0), (150, 10, 6), (250, 0, 8), (100, 0, 0)]
    )
    @pytest.mark.parametrize("array", [ARRAY, PAPER], ids=["wideband", "paper"])
    def test_is_the_image_source(self, array, z_mm, rx_deg, ry_deg):
        truth = without_cross_talk(array_truth(1, array))
        pose = looking_down(3, 5, z_mm, rx_deg, ry_deg)
        found = echo_waveforms(FLAT, pose, array, truth, AIR_C)
        expected, _ = floor_image(pose, array=array, truth=truth)
        gains, delays_mm = gain_and_delay_mm(found, expected)
        assert np.all(np.abs(gains - 1) < 0.015)
        assert np.ptp(delays_mm) < 0.025 if array is PAPER else np.ptp(delays_mm) < 0.008

    def test_path_has_the_mean_extra_way_between_two_pistons(self):
        pose = looking_down()
        expected, paths_mm = floor_image(pose)
        _, delays_mm = gain_and_delay_mm(echo_waveforms(FLAT, pose, ARRAY, TRUTH, AIR_C), expected)
        np.testing.assert_allclose(delays_mm, TRUTH.radius_mm**2 / (2 * paths_mm), atol=0.006)

    def test_does_not_depend_on_where_the_field_ends(self):
        middle = echo_waveforms(FLAT, looking_down(0, 0), ARRAY, TRUTH, AIR_C)
        corner = echo_waveforms(FLAT, looking_down(101.3, 99.1), ARRAY, TRUTH, AIR_C)
        assert residual_db(corner, middle) < -40

    @pytest.mark.parametrize("tilt_deg", [10, 20])
    def test_loses_the_specular_echo_with_tilt_as_a_piston_does(self, tilt_deg):
        upright, tilted = (
            np.abs(echo_waveforms(FLAT, looking_down(rx_deg=t), ARRAY, TRUTH, AIR_C)).max() for t in (0, tilt_deg)
        )
        ka = 2 * np.pi * 45e3 / transducer.speed_of_sound_mps(AIR_C) * TRUTH.radius_mm * 1e-3
        beam = float(transducer.directivity(np.sin(np.radians(tilt_deg)) ** 2, ka))
        assert 20 * np.log10(tilted / upright) == pytest.approx(40 * np.log10(beam), abs=1.5)

    def test_moves_with_the_speed_of_sound(self):
        cold, warm = (echo_waveforms(FLAT, looking_down(), ARRAY, TRUTH, t) for t in (21.75, 22.25))
        _, delays_mm = gain_and_delay_mm(warm, cold)
        expected_mm = -300 * (
            transducer.speed_of_sound_mps(22.25) / transducer.speed_of_sound_mps(21.75) - 1
        )  # fmt: skip
        np.testing.assert_allclose(delays_mm, expected_mm, atol=0.02)


class TestEdgesAndWalls:
    def test_floor_and_wall_return_the_corner_image(self):
        corner = scene.SceneBuilder("corner").box((20, 120), (-120, 120), 120).build()
        for x_mm in (-20.0, -40.0):
            pose = looking_down(x_mm)
            found = echo_waveforms(corner, pose, ARRAY, TRUTH, AIR_C)
            floor, _ = floor_image(pose)
            double, _ = image_source(pose, np.array([-1, 1, -1]), np.array([40.0, 0, 0]))
            assert residual_db(found, floor) > -10
            assert residual_db(found, floor + double) < -20

    def test_first_echo_comes_from_the_top_of_a_plate(self):
        glass = scene.SceneBuilder("glass").box((-60, 60), (-60, 60), 30.0, scene.Material.GLASS).build()
        found = echo_waveforms(glass, looking_down(), ARRAY, TRUTH, AIR_C)
        top, _ = image_source(looking_down(), np.array([1, 1, -1]), np.array([0, 0, 60.0]))
        early = slice(0, 300)  # before the edges and the bench answer
        gains, delays_mm = gain_and_delay_mm(found[:, early], top[:, early])
        assert np.all(np.abs(gains - 1) < 0.1)
        assert np.all(np.abs(delays_mm) < 0.2)

    def test_material_makes_no_difference(self):
        records = [
            echo_waveforms(
                scene.SceneBuilder("s").box((-30, 30), (-30, 30), 20.0, material).build(),
                looking_down(10), ARRAY, TRUTH, AIR_C,
            )
            for material in (scene.Material.MATTE, scene.Material.GLASS, scene.Material.BLACK)
        ]  # fmt: skip
        np.testing.assert_array_equal(records[0], records[1])
        np.testing.assert_array_equal(records[0], records[2])

    def test_a_tall_wall_hides_what_is_behind_it(self):
        def with_and_without(wall_mm):
            plain = scene.SceneBuilder("a").box((30, 36), (-120, 120), wall_mm)
            small = scene.SceneBuilder("b").box((30, 36), (-120, 120), wall_mm).box((36, 50), (-10, 10), 8.0)
            a, b = (echo_waveforms(s.build(), looking_down(-60), ARRAY, TRUTH, AIR_C) for s in (plain, small))
            return np.sum((a - b) ** 2)

        assert with_and_without(80.0) < 0.02 * with_and_without(0.0)

    @pytest.mark.parametrize("name", ["demo", "block"])
    def test_facets_cover_every_surface_once(self, name):
        placed = scene.SCENES[name]()
        found = facets.build_facets(placed)
        area = found.size_mm.prod(axis=1)
        heights = np.pad(placed.front_mm, 1)
        walls_mm2 = np.abs(np.diff(heights, axis=0)).sum() + np.abs(np.diff(heights, axis=1)).sum()
        assert area[found.kind == facets.HORIZONTAL].sum() == pytest.approx((2 * facets.BENCH_MM) ** 2)
        assert area[found.kind != facets.HORIZONTAL].sum() == pytest.approx(walls_mm2)

    def test_emitter_and_receiver_may_change_places(self):
        ends = [(-11.0, 4.0, 0.0), (15.0, -3.0, 0.0)]
        records = []
        for emitter, receiver in (ends, ends[::-1]):
            layout = ArrayElementLayout(emitter_mm=emitter, receivers_mm=[receiver])
            array = msgspec.structs.replace(ARRAY, layout=layout)
            truth = without_cross_talk(array_truth(5, array))
            records.append(echo_waveforms(scene.demo(), looking_down(-20, 40), array, truth, AIR_C))
        assert residual_db(*records) < -60


class TestRecord:
    def test_signal_over_noise_is_45_db_after_the_matched_filter(self):
        clean = echo_waveforms(FLAT, looking_down(), ARRAY, TRUTH, AIR_C)
        noise = echoes.noise_counts(ARRAY, TRUTH)
        snr_db = 20 * np.log10(np.sqrt(np.sum(clean**2, axis=1)) / noise)
        np.testing.assert_allclose(snr_db, 45, atol=2)

    @pytest.mark.parametrize("array", [ARRAY, PAPER], ids=["wideband", "paper"])
    @pytest.mark.parametrize("seed", [1, 2, 3])
    def test_a_plate_at_100_mm_does_not_clip(self, array, seed):
        truth = array_truth(seed, array)
        block = simulate_ping(FLAT, looking_down(z_mm=100), array, truth, AIR_C, np.random.default_rng(seed))
        assert block.dtype == np.int16
        assert block.shape == (8, 1024)
        assert 9000 < np.abs(block.astype(int)).max() < 30000

    def test_cross_talk_comes_first_and_straight(self):
        truth = dataclasses.replace(array_truth(1, ARRAY), placement_mm=TRUTH.placement_mm)
        talk = echo_waveforms(FLAT, looking_down(), ARRAY, truth, AIR_C) - echo_waveforms(
            FLAT, looking_down(), ARRAY, TRUTH, AIR_C
        )
        peaks_s = np.abs(talk).argmax(axis=1) / ARRAY.sample_rate_hz
        way_s = np.linalg.norm(np.array(ARRAY.layout.receivers_mm), axis=1) * 1e-3 / 344
        np.testing.assert_allclose(peaks_s, way_s + truth.delays_s, atol=1.3e-5)

    def test_same_generator_gives_the_same_bytes_and_another_seed_others(self):
        demo, truth = scene.demo(), array_truth(1, ARRAY)
        pings = [
            simulate_ping(demo, looking_down(), ARRAY, truth, AIR_C, np.random.default_rng(seed)) for seed in (7, 7, 8)
        ]
        assert pings[0].tobytes() == pings[1].tobytes() != pings[2].tobytes()

    def test_jitter_and_roughness_are_there_and_small(self, monkeypatch):
        monkeypatch.setattr(echoes, "SCATTER_MM", 0.05)
        quiet = dataclasses.replace(TRUTH, snr_db=200.0)
        rough = simulate_ping(FLAT, looking_down(), ARRAY, quiet, AIR_C, np.random.default_rng(0)).astype(float)
        monkeypatch.setattr(echoes, "SCATTER_MM", 0.0)
        monkeypatch.setattr(echoes, "_surfaces", {})
        smooth = echo_waveforms(FLAT, looking_down(), ARRAY, TRUTH, AIR_C)
        assert -40 < residual_db(rough, smooth) < -20

    def test_the_papers_burst_is_long_and_centred_on_40_khz(self):
        spectra = [
            np.abs(np.fft.rfft(echo_waveforms(FLAT, looking_down(), a, without_cross_talk(array_truth(1, a)), AIR_C)))[
                0
            ]
            for a in (ARRAY, PAPER)
        ]
        f = np.fft.rfftfreq(1024, 4e-6)
        spans_hz = [np.ptp(f[s > s.max() / 2]) for s in spectra]
        assert f[spectra[1].argmax()] == pytest.approx(40e3, abs=600)
        assert spans_hz[1] < 5e3 < 24e3 < spans_hz[0]

    def test_what_comes_after_the_record_is_lost(self):
        short = msgspec.structs.replace(ARRAY, samples=128)
        found = echo_waveforms(FLAT, looking_down(), short, TRUTH, AIR_C)
        assert np.abs(found).max() < 0.02 * echoes.REFERENCE_COUNTS


class TestTruth:
    def test_is_drawn_from_the_seed(self):
        one, same, other = (array_truth(seed, ARRAY) for seed in (1, 1, 2))
        np.testing.assert_array_equal(one.delays_s, same.delays_s)
        np.testing.assert_array_equal(one.rig_from_robot, same.rig_from_robot)
        assert not np.array_equal(one.delays_s, other.delays_s)

    @pytest.mark.parametrize("seed", range(20))
    def test_spreads_as_real_parts_do(self, seed):
        truth = array_truth(seed, ARRAY)
        arms = np.array(ARRAY.layout.receivers_mm)
        assert 0.05 < np.std(truth.placement_mm[:, :2]) < 0.16
        assert 0.01 < np.std(truth.placement_mm[:, 2]) < 0.09
        np.testing.assert_allclose(np.cross(arms, truth.placement_mm).sum(axis=0), 0, atol=1e-12)
        nominal = transform(rotation_from_euler(np.pi, 0, 0), np.zeros(3))
        offsets = [truth.rig_from_robot, np.linalg.inv(nominal) @ truth.flange_from_array]
        assert np.all((truth.delays_s > 19e-6) & (truth.delays_s < 61e-6))
        assert np.all(np.abs(truth.gains - 1) <= 0.15)
        assert truth.radius_mm == pytest.approx(6.2, rel=0.0201)
        assert 0.2 < abs(truth.thermometer_error_k) < 0.4
        for offset in offsets:
            assert 0.05 < np.linalg.norm(offset[:3, 3]) < 3.5
            np.testing.assert_allclose(offset[:3, :3] @ offset[:3, :3].T, np.eye(3), atol=1e-12)
            assert np.degrees(np.arccos((np.trace(offset[:3, :3]) - 1) / 2)) < 1.5

    def test_pose_goes_through_robot_and_flange(self):
        truth = array_truth(3, ARRAY)
        found = truth.rig_from_array(np.array([10.0, -20, 150, 0, 0, 0]))
        np.testing.assert_allclose(found[:3, 3], [10, -20, 150], atol=5)
        np.testing.assert_allclose(found[:3, 2], [0, 0, -1], atol=0.05)


def test_directivity_is_one_on_axis_and_zero_at_the_first_zero_of_j1():
    found = transducer.directivity(np.array([0.0, (3.831706 / 5) ** 2]), 5.0)
    np.testing.assert_allclose(found, [1, 0], atol=1e-6)


def test_band_weights_carry_even_polynomials_exactly():
    bands = np.array(transducer.BANDS["wideband"])
    f = np.linspace(30e3, 60e3, 31)

    def beam(x):
        return 1 - (x / 5e4) ** 2 + 0.3 * (x / 5e4) ** 6

    np.testing.assert_allclose(beam(bands) @ transducer.band_weights(f, bands), beam(f), rtol=1e-9)
