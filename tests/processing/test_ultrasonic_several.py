"""Overlapping echoes by variable projection, on echoes with known arrivals."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_processing.ultrasonic.baseband import baseband
from echolume_processing.ultrasonic.envelope import band_pass
from echolume_processing.ultrasonic.matched_filter import PLAIN, MatchedFilter, matched_filter
from echolume_processing.ultrasonic.several import Echoes, several_echoes
from processing.echo_pulses import ORIGIN, RATE_HZ, SAMPLES, SPEED_MM_PER_S, echoes, resonant

CHANNELS = 100
BAND_HZ = (36e3, 44e3)
GATE_S = (100 / RATE_HZ, 1000 / RATE_HZ)
MM = 0.5 * SPEED_MM_PER_S
PULSE = resonant()


@pytest.fixture(scope="module")
def bank() -> MatchedFilter:
    one = band_pass(echoes(PULSE, np.array([ORIGIN]))[:, :420].astype(np.float32), RATE_HZ, *BAND_HZ)
    return matched_filter(np.tile(one, (CHANNELS, 1)), ORIGIN, RATE_HZ, BAND_HZ, SAMPLES, whitening=PLAIN)


def found_in(waves: np.ndarray, noise: float, bank: MatchedFilter) -> list[Echoes]:
    return several_echoes(baseband(bank, waves.astype(np.float32)), GATE_S, noise * bank.noise_gain)


def two(apart_mm: float, rng: np.random.Generator, noise: float) -> tuple[np.ndarray, np.ndarray]:
    """Echoes (channels, samples) of random phase within 6 dB of each other, and their arrivals (channels, 2)."""
    at = rng.uniform(280, 320, CHANNELS)
    both = np.stack([at, at + apart_mm / MM * RATE_HZ], axis=1)
    height = 10 ** (rng.uniform(-6, 6, CHANNELS) / 20) * np.exp(2j * np.pi * rng.uniform(size=CHANNELS))
    waves = echoes(PULSE, both[:, 0]) + echoes(PULSE, both[:, 1], height)
    return waves + rng.normal(0, noise, waves.shape), both / RATE_HZ


def test_two_echoes_20_mm_of_range_apart_are_both_found_within_2_mm(bank: MatchedFilter):
    noise = 10 ** (-30 / 20)
    waves, truth = two(20.0, np.random.default_rng(1), noise)
    found = found_in(waves, noise, bank)
    right = [len(e.time_s) == 2 and np.all(np.abs(e.time_s - t) * MM < 2) for e, t in zip(found, truth, strict=True)]
    assert np.mean(right) >= 0.93  # 97 % of many


def test_the_sigma_of_overlapping_echoes_counts_their_neighbour(bank: MatchedFilter):
    noise = 10 ** (-40 / 20)
    waves, truth = two(40.0, np.random.default_rng(2), noise)
    pairs = [(e, t) for e, t in zip(found_in(waves, noise, bank), truth, strict=True) if len(e.time_s) == 2]
    score = np.concatenate([((e.time_s - t) / e.sigma_s) ** 2 for e, t in pairs])
    assert len(pairs) >= 0.95 * CHANNELS
    assert 0.75 < np.mean(score) < 1.3


def test_one_echo_stays_one(bank: MatchedFilter):
    noise = 10 ** (-30 / 20)
    rng = np.random.default_rng(3)
    at = rng.uniform(280, 320, CHANNELS)
    found = found_in(echoes(PULSE, at) + rng.normal(0, noise, (CHANNELS, SAMPLES)), noise, bank)
    assert np.mean([len(e.time_s) == 1 for e in found]) >= 0.98
    assert max(abs(float(e.amplitude[0]) - 1) for e in found) < 0.05


def test_noise_holds_no_echo(bank: MatchedFilter):
    waves = np.random.default_rng(4).normal(0, 0.1, (CHANNELS, SAMPLES))
    assert sum(len(e.time_s) for e in found_in(waves, 0.1, bank)) <= 1


def test_three_echoes_come_in_their_order_with_height_and_phase(bank: MatchedFilter):
    at = np.array([300.0, 420.0, 620.0])
    heights = np.array([0.5, -1.0, 0.8j])
    wave = sum(echoes(PULSE, np.array([a]), np.array([h])) for a, h in zip(at, heights, strict=True))
    found = found_in(np.tile(wave, (CHANNELS, 1)) + 1e-9, 1e-3, bank)[0]
    np.testing.assert_allclose(found.time_s[:3] * RATE_HZ, at, atol=0.05)
    np.testing.assert_allclose(found.amplitude[:3], np.abs(heights), rtol=0.01)
    turn = np.angle(heights) - found.phase_rad[:3]
    np.testing.assert_allclose(np.exp(1j * turn), 1.0, atol=0.1)
