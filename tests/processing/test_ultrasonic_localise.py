"""The 1 + N localiser, on synthetic envelopes and on real recordings."""

import argparse
import json
import os
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from echolume_messages.errors import ConfigError
from echolume_processing.commands import localise as command
from echolume_processing.ultrasonic import (
    arrival,
    localise,
    localise_calibrate,
    localise_score,
    pulse,
    recordings,
    setups,
)
from echolume_processing.ultrasonic.recordings import Recordings

DATA = Path(os.environ.get("ECHOLUME_DATA", Path(__file__).parents[3] / "shared" / "data"))
ECHOES = DATA / "spiel-echoes" / "echoes.npz"
ELEMENTS = np.array([[0, 0, 0], [-37.5, -64.95, 0], [75, 0, 0], [-37.5, 64.95, 0]], dtype=np.float64)
SAMPLES = 62
GRID = localise.search_grid(side_step_mm=8.0, depth_step_mm=4.0)
RISE, FALL = 1.7, 2.1
"""Samples from the crest of a synthetic echo; it is steeper in front, as real ones are."""


def shape_at(offset: np.ndarray) -> np.ndarray:
    return np.exp(-0.5 * (offset / np.where(offset < 0, RISE, FALL)) ** 2)


def clutter(rng: np.random.Generator, count: int, level: float) -> np.ndarray:
    """Complex background (4, SAMPLES) of one narrow band, shared by all recordings, and noise on top of it."""
    white = rng.normal(size=(4, SAMPLES + 16)) + 1j * rng.normal(size=(4, SAMPLES + 16))
    kernel = shape_at(np.arange(-8.0, 9.0))
    smooth = np.array([np.convolve(row, kernel, "valid") for row in white])
    return np.repeat((level * smooth / np.abs(smooth).mean())[None], count, axis=0)


def noise(rng: np.random.Generator, shape: tuple[int, ...], sigma: float) -> np.ndarray:
    return sigma * (rng.normal(size=shape) + 1j * rng.normal(size=shape))


def synthetic(
    count: int,
    delays: np.ndarray,
    seed: int = 4,
    level: float = 60.0,
    offset_mm: tuple[float, float, float] = (0, 0, 0),
) -> Recordings:
    """Magnitudes of background + echo + noise, each echo with a phase of its own, heights as sound spreads."""
    rng = np.random.default_rng(seed)
    target = np.column_stack([rng.uniform(-80, 80, (count, 2)), rng.uniform(100, 210, count)])
    answer = target + offset_mm
    reach = localise.paths_mm(answer, ELEMENTS) / 343.2e3 * 22e3 + delays
    height = np.exp(localise.level_terms(answer, ELEMENTS) @ np.array([17.3, -1.0, 0.5, 0.5]))
    phase = np.exp(2j * np.pi * rng.uniform(size=(count, 4, 1)))
    echo = height[:, :, None] * shape_at(np.arange(SAMPLES) - reach[:, :, None]) * phase
    background = clutter(rng, count, level)
    frames = np.abs(background + echo + noise(rng, echo.shape, 20))
    backgrounds = np.abs(background + noise(rng, echo.shape, 20))
    return Recordings(frames, backgrounds, target, ELEMENTS, 22e3)


@pytest.fixture(scope="module")
def calibrated() -> tuple[Recordings, localise.Localiser]:
    seen = synthetic(48, np.array([2.25, 1.5, 2.0, 1.75]))
    return seen, localise_calibrate.calibrate(seen)


def test_imposed_delays_are_recovered(calibrated: tuple[Recordings, localise.Localiser]):
    # An offset along the axis acts as a delay of all channels: the arrivals, not the two apart, are determined.
    seen, localiser = calibrated
    at, _ = localise.expected(localiser, seen.target_mm, np.zeros(48, dtype=np.intp))
    imposed = localise.paths_mm(seen.target_mm, ELEMENTS) / 343.2e3 * 22e3 + np.array([2.25, 1.5, 2.0, 1.75])
    assert len(localiser.setups) == 1
    np.testing.assert_allclose(np.median(at - imposed, axis=0), 0.0, atol=0.15)
    np.testing.assert_allclose(localiser.offset_mm[:2], 0.0, atol=3.0)


def test_an_imposed_sideways_offset_is_recovered():
    seen = synthetic(40, np.full(4, 2.0), level=30.0, offset_mm=(8.0, -6.0, 0.0))
    found = localise_calibrate.calibrate(seen)
    np.testing.assert_allclose(found.offset_mm[:2], [8.0, -6.0], atol=2.5)


def test_the_imposed_pulse_is_learned(calibrated: tuple[Recordings, localise.Localiser]):
    _, localiser = calibrated
    axis = arrival.pulse_axis()
    near = np.abs(axis) < 3.0
    for found in localiser.pulses:
        np.testing.assert_allclose(found[near], shape_at(axis[near]), atol=0.08)


def test_places_that_the_calibration_did_not_see_are_found(calibrated: tuple[Recordings, localise.Localiser]):
    _, localiser = calibrated
    held = synthetic(24, np.array([2.25, 1.5, 2.0, 1.75]), seed=11)
    found = localise.localise(localiser, held.frames, held.backgrounds, GRID)
    assert np.median(np.linalg.norm(found.place_mm - held.target_mm, axis=1)) < 9.0


def test_the_stated_covariance_holds_the_error(calibrated: tuple[Recordings, localise.Localiser]):
    _, localiser = calibrated
    held = synthetic(30, np.array([2.25, 1.5, 2.0, 1.75]), seed=21)
    found = localise.localise(localiser, held.frames, held.backgrounds, GRID)
    away = found.place_mm - held.target_mm
    squares = np.einsum("ri,rij,rj->r", away, np.linalg.inv(found.covariance_mm2), away)
    assert np.mean(squares < localise_score.CHI2_90) >= 0.85
    assert np.mean(found.heard) > 0.9


def test_a_deaf_channel_widens_the_covariance_and_leaves_the_place_near(
    calibrated: tuple[Recordings, localise.Localiser],
):
    _, localiser = calibrated
    held = synthetic(12, np.array([2.25, 1.5, 2.0, 1.75]), seed=5)
    whole = localise.localise(localiser, held.frames, held.backgrounds, GRID)
    frames = held.frames.copy()
    frames[:, 2] = held.backgrounds[:, 2]
    found = localise.localise(localiser, frames, held.backgrounds, GRID)
    assert not found.heard[:, 2].any()
    assert np.median(localise_score.sigma_mm(found)) > 1.3 * np.median(localise_score.sigma_mm(whole))
    away = found.place_mm - held.target_mm
    squares = np.einsum("ri,rij,rj->r", away, np.linalg.inv(found.covariance_mm2), away)
    assert np.mean(squares < localise_score.CHI2_90) >= 0.75


def test_two_setups_are_told_apart_and_have_delays_of_their_own():
    first = synthetic(24, np.array([2.0, 2.0, 2.0, 2.0]), seed=1, level=200.0)
    second = synthetic(24, np.array([2.6, 2.0, 2.0, 2.0]), seed=2, level=200.0)
    both = Recordings(
        np.concatenate([first.frames, second.frames]),
        np.concatenate([first.backgrounds, second.backgrounds]),
        np.concatenate([first.target_mm, second.target_mm]),
        ELEMENTS,
        22e3,
    )
    means = setups.find_setups(both.backgrounds)
    label = setups.setup_of(both.backgrounds, means)
    assert len(means) == 2
    assert len(set(label[:24])) == len(set(label[24:])) == 1
    found = localise_calibrate.calibrate(both)
    late = setups.setup_of(both.backgrounds[-1:], found.setups)[0]
    assert found.delays[late, 0] - found.delays[1 - late, 0] == pytest.approx(0.6, abs=0.2)


def test_phase_walk_is_a_probability_and_stays_in_half_a_turn():
    for step_rad in (0.1, 0.3, 1.0):
        cosines, walk = arrival.phase_walk(8, step_rad)
        np.testing.assert_allclose(walk.sum(axis=1), 1.0)
        np.testing.assert_allclose(walk, walk.T, atol=1e-9)
        assert np.all(np.diff(cosines) < 0)


def test_arrival_is_sharper_where_the_phase_is_followed():
    # The scatter of the crests; a phase that is free at each sample hides the echo's edges.
    delays = np.full(4, 2.0)
    held = synthetic(40, delays, seed=3, level=150.0)
    at = localise.paths_mm(held.target_mm, ELEMENTS) / 343.2e3 * 22e3 + delays
    around = at[:, :, None] + np.arange(-3.0, 3.0, 0.1)
    axis = arrival.pulse_axis()
    shapes = np.tile(np.where(np.abs(axis) < 6, shape_at(axis), 0.0), (4, 1))
    spread = []
    for step_rad in (0.3, 20.0):
        model = replace(arrival.EchoModel(), phase_walk_rad=step_rad)
        tables = arrival.arrival_tables(held.frames, held.backgrounds, shapes, around, model)
        spread.append(np.median(np.abs(arrival.crests(tables, around)[0] - at)))
    assert spread[0] < spread[1]


def test_a_pulse_is_learned_from_crests_that_are_known():
    rng = np.random.default_rng(9)
    crest = rng.uniform(20, 40, 60)
    height = rng.uniform(300, 1500, 60)
    echo = (
        height[:, None] * shape_at(np.arange(SAMPLES) - crest[:, None]) * np.exp(2j * np.pi * rng.uniform(size=(60, 1)))
    )
    background = clutter(rng, 15, 60.0).reshape(60, SAMPLES)
    frames = np.abs(background + echo + noise(rng, echo.shape, 20))
    learned = pulse.learn_pulse(frames, np.abs(background), crest, height, arrival.EchoModel())
    axis = arrival.pulse_axis()
    near = (axis > -3.5) & (axis < 3.0)
    np.testing.assert_allclose(learned[near], shape_at(axis[near]), atol=0.05)


def test_a_file_of_another_shape_is_refused(tmp_path: Path):
    path = tmp_path / "echoes.npz"
    np.savez(path, frames=np.zeros((3, 2, 9)), background=np.zeros((3, 2, 9)), target_mm=np.zeros((3, 3)))
    with pytest.raises(ConfigError, match="expected frames"):
        recordings.load_recordings(path)
    with pytest.raises(ConfigError, match=r"missing\.npz"):
        recordings.load_recordings(tmp_path / "missing.npz")


@pytest.mark.skipif(not ECHOES.is_file(), reason=f"no real recordings at {ECHOES}; set ECHOLUME_DATA")
def test_real_recordings_are_localised_within_20_mm_by_half_and_45_mm_by_nine_in_ten(
    capsys: pytest.CaptureFixture[str],
):
    parser = argparse.ArgumentParser()
    command.configure(parser)
    assert command.run(parser.parse_args([str(ECHOES), "--json"])) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["scored_on"] == 146
    assert figures["median_mm"] <= 20.0
    assert figures["p90_mm"] <= 45.0
    assert figures["covered_90"] >= 0.8
