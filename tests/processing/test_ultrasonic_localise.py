"""The 1 + N localiser, on synthetic envelopes and on real recordings."""

import argparse
import json
import os
from pathlib import Path

import numpy as np
import pytest

from echolume_messages.errors import ConfigError
from echolume_processing.commands import localise as command
from echolume_processing.ultrasonic import localise

DATA = Path(os.environ.get("ECHOLUME_DATA", Path(__file__).parents[3] / "shared" / "data"))
ECHOES = DATA / "spiel-echoes" / "echoes.npz"
ELEMENTS = np.array([[0, 0, 0], [-37.5, -64.95, 0], [75, 0, 0], [-37.5, 64.95, 0]], dtype=np.float64)


def synthetic(count: int, delays: np.ndarray) -> localise.Recordings:
    rng = np.random.default_rng(4)
    target = np.column_stack([rng.uniform(-60, 60, (count, 2)), rng.uniform(110, 200, count)])
    arrival = localise.paths_mm(target, ELEMENTS) / 343.2e3 * 22e3 + delays
    frames = 1000 * np.exp(-0.5 * ((np.arange(62) - arrival[:, :, None]) / 1.6) ** 2)
    background = np.abs(rng.normal(0, 5, frames.shape))
    return localise.Recordings(frames + background, background, target, ELEMENTS, 22e3)


def test_delays_and_places_are_recovered_from_clean_envelopes():
    delays = np.array([2.25, 1.5, 2.0, 1.75])
    recordings = synthetic(40, delays)
    found = localise.score(recordings)
    np.testing.assert_allclose(found.delays, delays, atol=0.15)
    assert found.calibrated_on == found.scored_on == 20
    assert found.median_mm < 4.0


def test_a_file_of_another_shape_is_refused(tmp_path: Path):
    path = tmp_path / "echoes.npz"
    np.savez(path, frames=np.zeros((3, 2, 9)), background=np.zeros((3, 2, 9)), target_mm=np.zeros((3, 3)))
    with pytest.raises(ConfigError, match="expected frames"):
        localise.load_recordings(path)
    with pytest.raises(ConfigError, match=r"missing\.npz"):
        localise.load_recordings(tmp_path / "missing.npz")


@pytest.mark.skipif(not ECHOES.is_file(), reason=f"no real recordings at {ECHOES}; set ECHOLUME_DATA")
def test_real_recordings_are_localised_with_a_median_error_of_at_most_25_mm(capsys: pytest.CaptureFixture[str]):
    parser = argparse.ArgumentParser()
    command.configure(parser)
    assert command.run(parser.parse_args([str(ECHOES), "--json"])) == 0
    figures = json.loads(capsys.readouterr().out)
    assert figures["scored_on"] == 146
    assert figures["median_mm"] <= 21.0
