"""Time of flight on its bound, its sigma, its cycles, and the onset as a witness, on echoes with known arrivals."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.types import EchoKind
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.baseband import baseband
from echolume_processing.ultrasonic.cycles import resolve_cycles
from echolume_processing.ultrasonic.envelope import band_pass
from echolume_processing.ultrasonic.flight import Arrivals, first_arrivals
from echolume_processing.ultrasonic.matched_filter import PLAIN, MatchedFilter, matched_filter
from echolume_processing.ultrasonic.onset import LeadingEdge, leading_edge, onsets
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline
from echolume_processing.ultrasonic.templates import cut_templates
from processing.echo_pulses import ORIGIN, RATE_HZ, SAMPLES, SPEED_MM_PER_S, bounds_s, echoes, resonant, wideband

CHANNELS = 300
NARROW_HZ, WIDE_HZ = (36e3, 44e3), (30e3, 60e3)
GATE_S = (100 / RATE_HZ, 1000 / RATE_HZ)
MM = 0.5 * SPEED_MM_PER_S
PULSES = {"resonant": (resonant(), NARROW_HZ), "wideband": (wideband(), WIDE_HZ)}
STEPS = (-37.5, 0.0, 37.5)
RECEIVERS = np.array([(x, y, 0.0) for x in STEPS for y in STEPS if x or y])


def template(spectrum: np.ndarray, band_hz: tuple[float, float], channels: int = CHANNELS) -> np.ndarray:
    one = echoes(spectrum, np.array([ORIGIN]))[:, :420].astype(np.float32)
    return np.tile(band_pass(one, RATE_HZ, *band_hz), (channels, 1))


def bank_of(name: str, whitening: float = PLAIN) -> MatchedFilter:
    spectrum, band = PULSES[name]
    return matched_filter(template(spectrum, band), ORIGIN, RATE_HZ, band, SAMPLES, whitening=whitening)


def found_in(waves: np.ndarray, bank: MatchedFilter) -> Arrivals:
    base = baseband(bank, waves.astype(np.float32))
    level = np.full(base.magnitude.shape[1], 0.45, dtype=np.float32)
    return first_arrivals(base, GATE_S, level, strongest=True)


def noisy(spectrum: np.ndarray, at: np.ndarray, snr_db: float, rng: np.random.Generator) -> np.ndarray:
    return echoes(spectrum, at) + rng.normal(0, 10 ** (-snr_db / 20), (len(at), SAMPLES))


@pytest.mark.parametrize("snr_db", [20, 40])
@pytest.mark.parametrize("name", PULSES)
def test_the_plain_matched_filter_sits_on_the_cramer_rao_bound_and_its_sigma_says_so(name: str, snr_db: int):
    bank, rng = bank_of(name), np.random.default_rng(1)
    envelope_s, phase_s, score = [], [], []
    for _ in range(4):
        at = rng.uniform(300, 400, CHANNELS)
        found = found_in(noisy(PULSES[name][0], at, snr_db, rng), bank)
        sure = ~found.doubtful
        envelope_s.append(found.envelope_s - at / RATE_HZ)
        phase_s.append((found.time_s - at / RATE_HZ)[sure])
        score.append((phase_s[-1] / found.sigma_s[sure]) ** 2)
    bound_s, phase_bound_s = bounds_s(PULSES[name][0], 10 ** (-snr_db / 20))
    assert np.std(np.concatenate(envelope_s)) == pytest.approx(bound_s, rel=0.1)
    assert np.std(np.concatenate(phase_s)) == pytest.approx(phase_bound_s, rel=0.1)
    assert 0.85 < np.mean(np.concatenate(score)) < 1.2


def test_flattening_the_template_leaves_the_bound():
    rng, at = np.random.default_rng(2), np.random.default_rng(3).uniform(300, 400, CHANNELS)
    waves = noisy(PULSES["wideband"][0], at, 30, rng)
    plain, short = (found_in(waves, bank_of("wideband", w)).envelope_s - at / RATE_HZ for w in (PLAIN, 0.05))
    assert np.std(short) > 1.15 * np.std(plain)


def test_a_cycle_that_envelope_and_phase_dispute_is_doubtful_and_keeps_the_envelope():
    rng = np.random.default_rng(4)
    bank, doubtful, slips = bank_of("resonant"), 0, 0
    for _ in range(5):
        at = rng.uniform(300, 400, CHANNELS)
        found = found_in(noisy(PULSES["resonant"][0], at, 20, rng), bank)
        doubtful += np.count_nonzero(found.doubtful)
        np.testing.assert_array_equal(found.time_s[found.doubtful], found.envelope_s[found.doubtful])
        assert np.all(found.sigma_s[found.doubtful] > 5e-6)
        slips += np.count_nonzero(~found.doubtful & (np.abs(found.time_s - at / RATE_HZ) > 12.5e-6))
    assert 0.005 < doubtful / (5 * CHANNELS) < 0.035  # 1.7 % by the bound
    assert slips == 0


def test_amplitude_does_not_move_an_echo():
    at, bank = np.linspace(320, 380, CHANNELS), bank_of("resonant")
    waves = echoes(PULSES["resonant"][0], at)
    moved = found_in(0.3 * waves, bank).time_s - found_in(waves, bank).time_s
    assert np.abs(moved).max() * MM < 1e-4


def edge_of(bank: MatchedFilter) -> LeadingEdge:
    return leading_edge(template(*PULSES["resonant"]), ORIGIN, RATE_HZ, bank.centre_hz)


@pytest.mark.parametrize(("changed", "bias_mm"), [({"quality": 24.0}, 2.26), ({"centre_hz": 39.2e3}, -2.35)])
def test_the_onset_contradicts_a_template_that_no_longer_holds(changed: dict[str, float], bias_mm: float):
    bank, at = bank_of("resonant"), np.linspace(300, 400, CHANNELS)
    waves = echoes(resonant(**changed), at)
    found = found_in(waves, bank)
    onset_s, _ = onsets(waves.astype(np.float32), edge_of(bank), found.envelope_s, found.white_noise)
    assert np.mean(found.envelope_s - at / RATE_HZ) * MM == pytest.approx(bias_mm, abs=0.1)
    assert abs(np.mean(onset_s - at / RATE_HZ)) * MM < 0.3
    assert np.mean(np.abs(onset_s - found.envelope_s)) * MM > 2.0


def test_the_onset_agrees_with_a_template_that_holds_and_knows_its_sigma():
    rng, bank = np.random.default_rng(5), bank_of("resonant")
    at = rng.uniform(300, 400, CHANNELS)
    waves = noisy(PULSES["resonant"][0], at, 35, rng)
    found = found_in(waves, bank)
    onset_s, sigma_s = onsets(waves.astype(np.float32), edge_of(bank), found.time_s, found.white_noise)
    assert 0.7 < np.std((onset_s - at / RATE_HZ) / sigma_s) < 1.3
    assert np.mean(np.abs(onset_s - found.time_s) * MM > 2.0) < 0.01


@pytest.mark.parametrize("changed", [{"quality": 24.0}, {"centre_hz": 39.2e3}])
def test_a_template_from_reference_pings_takes_the_bias_away(changed: dict[str, float]):
    spectrum, rng = resonant(**changed), np.random.default_rng(6)
    clean = 8000 * echoes(spectrum, np.full(8, 360.0))
    pings = [
        Ping(k, np.rint(clean + rng.normal(0, 80, clean.shape)).astype(np.int16), np.zeros(6), RATE_HZ, 0.0, 20.0)
        for k in range(8)
    ]
    cut = cut_templates(pings, list(range(8)), NARROW_HZ, 330 / RATE_HZ, 700 / RATE_HZ)
    bank = matched_filter(cut.waveforms / np.float32(8000), 360.0 - cut.first_sample, RATE_HZ, NARROW_HZ, SAMPLES)
    at = np.linspace(310, 380, 8) + 0.37
    found = found_in(echoes(spectrum, at), bank)
    assert abs(np.mean(found.envelope_s - at / RATE_HZ)) * MM < 0.05
    assert np.abs(found.time_s - at / RATE_HZ).max() * MM < 0.005


@pytest.mark.parametrize("model", ["plane", "point"])
def test_eight_channels_settle_cycles_that_some_of_them_missed(model: str):
    rng, wave_mm = np.random.default_rng(7), 8.58
    for _ in range(40):
        target = np.array([*rng.uniform(-30, 30, 2), rng.uniform(150, 400)])
        paths = np.linalg.norm(RECEIVERS - (2 if model == "plane" else 1) * target, axis=1)
        paths = paths + (np.linalg.norm(target) if model == "point" else 0.0)
        coarse = paths + rng.normal(0, 1.25, 8)
        fine = paths + rng.normal(0, 0.03, 8)
        slipped = fine + wave_mm * rng.integers(-1, 2, 8)
        found = resolve_cycles(RECEIVERS, slipped, np.full(8, 0.05), wave_mm, coarse, np.full(8, 1.25))
        np.testing.assert_allclose(found.paths_mm, fine, atol=1e-9)
        assert found.resolved


def test_paths_without_a_common_surface_settle_nothing():
    rng = np.random.default_rng(8)
    coarse = np.linalg.norm(RECEIVERS - np.array([0, 0, 500.0]), axis=1) + np.array([0, 30.0] * 4)
    fine = coarse + rng.uniform(-4, 4, 8)
    assert not resolve_cycles(RECEIVERS, fine, np.full(8, 0.05), 8.58, coarse, np.full(8, 1.0)).resolved


def array_of(spectrum: np.ndarray, band_hz: tuple[float, float]) -> ArrayCalibration:
    return ArrayCalibration(
        emitter_mm=(0.0, 0.0, 0.0), receivers_mm=[(x, y, z) for x, y, z in RECEIVERS.tolist()], radius_mm=6.2,
        low_hz=band_hz[0], high_hz=band_hz[1], delays_s=[0.0] * 8, gains=[8000.0] * 8,
        templates=(8000 * template(spectrum, band_hz, 8)).tolist(), template_origin=float(ORIGIN),
        sample_rate_hz=RATE_HZ, reference_mm=150.0, speed_of_sound_mps=343.2, temperature_c=20.0,
        flange_from_array=np.eye(4).tolist(), rig_from_robot=np.eye(4).tolist(), path_rms_mm=0.0,
    )  # fmt: skip


def test_a_plate_at_400_mm_and_20_db_is_ranged_to_a_third_of_what_barshan_and_sekmen_reached():
    pipeline = UltrasonicPipeline(array_of(*PULSES["resonant"]))
    rng, errors = np.random.default_rng(9), []
    for k in range(40):
        normal = np.append(rng.uniform(-0.05, 0.05, 2), 1.0)
        normal /= np.linalg.norm(normal)
        paths = np.linalg.norm(RECEIVERS - 800 * normal, axis=1)
        waves = 0.5 * (echoes(PULSES["resonant"][0], paths / SPEED_MM_PER_S * RATE_HZ) + rng.normal(0, 0.1, (8, 1024)))
        ping = Ping(k, np.rint(8000 * waves).astype(np.int16), np.zeros(6), RATE_HZ, 0.0, 20.0)
        points = pipeline.process(ping)
        assert len(points) == 8
        assert np.all(points["kind"] == EchoKind.PLANE)
        at = np.stack([points[n] for n in ("x_mm", "y_mm", "z_mm")], axis=1)
        errors.append(float(np.median(at @ normal)) - 400)
    assert np.abs(errors).max() < 0.06


def test_several_echoes_of_a_ping_have_their_paths():
    pipeline = UltrasonicPipeline(array_of(*PULSES["resonant"]))
    near = np.linalg.norm(RECEIVERS - np.array([0, 0, 400.0]), axis=1)
    waves = [echoes(PULSES["resonant"][0], (near + more) / SPEED_MM_PER_S * RATE_HZ) for more in (0.0, 60.0)]
    noise = np.random.default_rng(10).normal(0, 0.02, (8, 1024))
    counts = (8000 * (0.7 * waves[0] + 0.5 * waves[1] + noise)).astype(np.float32)
    found = pipeline.several_echoes(counts, RATE_HZ, 0.0, 20.0)
    for (echo, paths_mm), path in zip(found, near, strict=True):
        np.testing.assert_allclose(paths_mm, [path, path + 60], atol=3.0)
        np.testing.assert_allclose(echo.amplitude, [0.7, 0.5], atol=0.05)
