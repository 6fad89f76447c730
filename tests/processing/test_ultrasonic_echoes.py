"""Envelope, matched filter, lobes, time of flight and contact points on synthetic echoes with known answers."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_messages.rig import ArrayElementLayout
from echolume_messages.types import EchoKind
from echolume_processing.ultrasonic import baseband, contact, envelope, flight, lobes, matched_filter

RATE_HZ = 250e3
RECEIVERS = np.array(ArrayElementLayout().receivers_mm)
ORIGIN = 100.0


def pulse(arrival: float, samples: int = 1024) -> np.ndarray:
    """A 30-60 kHz pulse centred on a fractional sample."""
    f = np.fft.rfftfreq(samples, 1 / RATE_HZ)
    band = np.exp(-(((f - 45e3) / 11e3) ** 4))
    return np.fft.irfft(band * np.exp(-2j * np.pi * f * arrival / RATE_HZ), samples)


def filter_bank(samples: int = 1024) -> matched_filter.MatchedFilter:
    template = np.tile(pulse(ORIGIN, 200), (1, 1)).astype(np.float32)
    return matched_filter.matched_filter(template, ORIGIN, RATE_HZ, (30e3, 60e3), samples)


def arrivals(waveform: np.ndarray, **keywords: bool) -> flight.Arrivals:
    bank = filter_bank()
    echoes = baseband.baseband(bank, waveform[None].astype(np.float32))
    threshold = np.full(echoes.magnitude.shape[1], 0.45, dtype=np.float32)
    return flight.first_arrivals(echoes, (100 / RATE_HZ, 1000 / RATE_HZ), threshold, **keywords)


def test_the_paper_envelope_of_a_tone_is_its_amplitude_without_delay():
    t = np.arange(2000) / RATE_HZ
    burst = np.where((t > 2e-3) & (t < 5e-3), 3.0 * np.sin(2 * np.pi * 40e3 * t), 0.0)
    out = envelope.paper_envelope(burst[None].astype(np.float32), RATE_HZ)[0]
    assert out.dtype == np.float32
    assert out[875] == pytest.approx(3.0, rel=0.05)
    rise = np.flatnonzero(out > 1.5)[0]
    assert rise / RATE_HZ == pytest.approx(2e-3, abs=0.1e-3)  # undelayed; uncompensated it would be 0.32 ms late


@pytest.mark.parametrize("kind", ["burst", "short pulse", "slow hump"])
def test_the_paper_envelope_survives_decimation(kind: str):
    t = np.arange(4096) / RATE_HZ
    waves = {
        "burst": np.where((t > 2e-3) & (t < 5e-3), np.sin(2 * np.pi * 40e3 * t), 0.0),
        "short pulse": pulse(1500.3, 4096),
        "slow hump": np.exp(-(((t - 8e-3) / 1e-3) ** 2)) * np.sin(2 * np.pi * 40e3 * t),
    }
    full = envelope.paper_envelope(waves[kind][None].astype(np.float32), RATE_HZ)
    few, rate = envelope.decimated(full, RATE_HZ)
    back = envelope.restored(few, rate, 4096, RATE_HZ)
    assert few.shape[1] == 410
    assert back.dtype == np.float32
    assert np.max(np.abs(back - full)[0, :4090]) < 0.002 * full.max()


@pytest.mark.parametrize("first", [0, 700])
def test_energy_from_the_band_is_that_below_the_paper_envelope(first: int):
    rng = np.random.default_rng(4)
    waves = np.stack([pulse(at, 2048) + h * pulse(at + 300.4, 2048) for at, h in ((850.2, 0.5), (1000.9, 1.3))])
    waves = (waves + rng.normal(0, 0.01, waves.shape)).astype(np.float32)
    bank = matched_filter.matched_filter(
        np.tile(pulse(ORIGIN, 200), (2, 1)).astype(np.float32), ORIGIN, RATE_HZ, (30e3, 60e3), 2048
    )
    defined = envelope.band_pass(waves, RATE_HZ, 30e3, 60e3)[:, first:]
    defined = envelope.energy(envelope.paper_envelope(defined, RATE_HZ), RATE_HZ)
    assert baseband.baseband(bank, waves).energy(first / RATE_HZ, 2048 / RATE_HZ) == pytest.approx(defined, rel=0.02)


def test_the_band_pass_keeps_the_band_and_its_timing():
    wave = pulse(400.3)[None].astype(np.float32) + np.float32(0.5)
    out = envelope.band_pass(wave, RATE_HZ, 30e3, 60e3)[0]
    assert np.argmax(out) == 400
    assert abs(float(out[700:900].mean())) < 1e-3


def test_energy_is_the_integral_of_the_square():
    assert envelope.energy(np.full((2, 500), 2.0, dtype=np.float32), RATE_HZ) == pytest.approx([8e-3, 8e-3])


@settings(max_examples=40, deadline=None)
@given(st.floats(250.0, 900.0), st.floats(0.6, 2.0))
def test_an_exact_copy_arrives_where_it_was_put(arrival: float, amplitude: float):
    found = arrivals(amplitude * pulse(arrival))
    assert found.time_s[0] * RATE_HZ == pytest.approx(arrival, abs=0.005)
    assert found.amplitude[0] == pytest.approx(amplitude, rel=0.01)
    assert abs(found.phase_rad[0]) < 0.2


def test_time_of_flight_at_40_db_is_good_to_5_um_of_path():
    rng = np.random.default_rng(3)
    errors = []
    for _ in range(40):
        at = rng.uniform(300, 800)
        wave = pulse(at)
        noisy = wave + rng.normal(0, np.sqrt(np.sum(wave**2)) / 100, wave.shape)
        errors.append((arrivals(noisy).time_s[0] - at / RATE_HZ) * 343.2e3)
    assert np.std(errors) < 0.02
    assert abs(np.mean(errors)) < 0.01


def test_the_first_echo_wins_over_a_stronger_later_one_10_mm_deeper():
    second = 400 + 20 / 343.2e3 * RATE_HZ
    wave = 0.6 * pulse(400) + pulse(second)
    assert arrivals(wave).time_s[0] * RATE_HZ == pytest.approx(400, abs=0.3)
    assert arrivals(wave, strongest=True).time_s[0] * RATE_HZ == pytest.approx(second, abs=0.3)
    assert arrivals(wave).lobes[0] == 2


def test_silence_has_no_arrival():
    assert not arrivals(np.zeros(1024)).found[0]


def test_lobes_are_counted_with_their_energies():
    t = np.arange(1000)
    wave = np.exp(-(((t - 300) / 40) ** 2)) + 0.6 * np.exp(-(((t - 600) / 40) ** 2))
    found = lobes.lobes(wave.astype(np.float32), 0.1, RATE_HZ)
    assert [lobe.peak for lobe in found] == [300, 600]
    assert found[1].energy / found[0].energy == pytest.approx(0.36, abs=0.01)
    total = envelope.energy(wave[None].astype(np.float32), RATE_HZ)[0]
    assert sum(lobe.energy for lobe in found) == pytest.approx(total, rel=0.01)


def plane_paths(normal: np.ndarray, distance_mm: float) -> np.ndarray:
    return np.linalg.norm(RECEIVERS - 2 * distance_mm * normal, axis=1)


@given(st.floats(-0.3, 0.3), st.floats(-0.3, 0.3), st.floats(60.0, 400.0))
def test_a_plane_is_recovered_from_its_paths(a: float, b: float, distance_mm: float):
    normal = np.array([a, b, 1.0]) / np.sqrt(1 + a * a + b * b)
    paths = plane_paths(normal, distance_mm)
    found = contact.contact(RECEIVERS, paths, np.full(8, 0.05))
    assert found.kind == EchoKind.PLANE
    np.testing.assert_allclose(found.normals, np.tile(-normal, (8, 1)), atol=1e-6)
    np.testing.assert_allclose(found.points_mm @ normal, distance_mm, atol=1e-6)
    lengths = np.linalg.norm(found.points_mm, axis=1) + np.linalg.norm(found.points_mm - RECEIVERS, axis=1)
    np.testing.assert_allclose(lengths, paths, atol=1e-6)


def test_a_point_is_told_from_a_plane_and_recovered():
    point = np.array([12.0, -7.0, 90.0])
    paths = np.linalg.norm(point) + np.linalg.norm(RECEIVERS - point, axis=1)
    found = contact.contact(RECEIVERS, paths, np.full(8, 0.02))
    assert found.kind == EchoKind.POINT
    np.testing.assert_allclose(found.points_mm, np.tile(point, (8, 1)), atol=1e-4)


def test_a_cycle_slip_in_one_channel_is_left_out():
    normal = np.array([0.1, -0.05, 1.0]) / np.sqrt(1.0125)
    paths = plane_paths(normal, 150.0) + np.random.default_rng(1).normal(0, 0.02, 8)
    paths[6] += 8.58
    found = contact.contact(RECEIVERS, paths, np.full(8, 0.05))
    assert found.kind == EchoKind.PLANE
    assert np.flatnonzero(~found.used).tolist() == [6]
    assert np.degrees(np.arccos(-found.normals[0] @ normal)) < 0.1


def test_paths_that_fit_no_model_stand_alone_perpendicular_to_the_axis():
    paths = plane_paths(np.array([0, 0, 1.0]), 150.0) + np.array([0, 20.0] * 4)
    found = contact.contact(RECEIVERS, paths, np.full(8, 0.05))
    assert found.kind == EchoKind.NONE
    np.testing.assert_allclose(found.points_mm[::2, 2], 150.0)


def test_too_few_channels_stand_alone():
    paths = np.full(8, np.nan)
    paths[2] = 300.0
    found = contact.contact(RECEIVERS, paths, np.full(8, 0.05))
    assert found.kind == EchoKind.NONE
    assert found.used.sum() == 1
