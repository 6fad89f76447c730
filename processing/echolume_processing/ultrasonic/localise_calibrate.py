"""Calibrate a localiser on recordings whose targets are known: pulses, set-ups, delays, offset, levels."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from echolume_messages.geometry import Points3

from .arrival import ARRIVAL_STEP, EchoModel, arrival_tables, crests
from .localise import Localiser, level_terms, paths_mm
from .pulse import first_pulse, learn_pulse
from .recordings import BLIND_SAMPLES, Recordings
from .setups import find_setups, setup_of

ROUNDS = 3
WINDOW = 4.0
"""Samples around the expected arrival in which the crest is looked for."""
TYPICAL = 0.3
"""Residual of an arrival, in samples, and of a level, beyond which it counts less (Cauchy)."""
DELAY_SPREAD = 0.5
"""Prior standard deviation of a set-up's delays around the common ones, in samples."""
OFFSET_SPREAD_MM = 20.0
SPREADING = np.array([0.0, -1.0, 1.0, 1.0])
SPREADING_SPREAD = np.array([1e3, 0.5, 1.0, 1.0])
"""Prior of the terms of a level: spherical spreading, both elements as the cosine."""


def coarse_delays(recordings: Recordings, speed_mps: float) -> NDArray[np.float64]:
    """Delay of each channel from the largest mean of what the target adds, in samples, (channels,)."""
    added = np.sqrt(np.maximum(recordings.frames**2 - recordings.backgrounds**2, 0.0))
    added[:, :, :BLIND_SAMPLES] = 0.0
    path = paths_mm(recordings.target_mm, recordings.elements_mm)
    arrival = path * recordings.sample_rate_hz / (1e3 * speed_mps)
    candidates = np.arange(-4.0, 8.0, 0.25)
    samples = np.arange(added.shape[2])
    return np.array(
        [
            candidates[
                np.argmax(
                    [
                        np.mean(
                            [np.interp(a + d, samples, row) for a, row in zip(arrival[:, c], added[:, c], strict=True)]
                        )
                        for d in candidates
                    ]
                )
            ]
            for c in range(added.shape[1])
        ]
    )


def calibrate(recordings: Recordings, model: EchoModel | None = None, speed_mps: float = 343.2) -> Localiser:
    """Find what a localiser must know from recordings with known targets.

    Notes
    -----
    Pulses and crests are found in turn; then delays of each set-up and one offset of the target from its reported place
    by robust least squares, and the levels by a weighted regression with a prior. An offset along the axis and a delay
    common to all channels are nearly the same; the offset's prior parts them.
    """
    model = model or EchoModel()
    delays = coarse_delays(recordings, speed_mps)
    per_mm = recordings.sample_rate_hz / (1e3 * speed_mps)
    middle = paths_mm(recordings.target_mm, recordings.elements_mm) * per_mm + delays
    arrivals = middle[:, :, None] + np.arange(-WINDOW, WINDOW, ARRIVAL_STEP)
    pulses = np.tile(first_pulse(), (middle.shape[1], 1))
    for _ in range(ROUNDS):
        crest, level = crests(
            arrival_tables(recordings.frames, recordings.backgrounds, pulses, arrivals, model), arrivals
        )
        pulses = np.array(
            [
                learn_pulse(
                    recordings.frames[:, c],
                    recordings.backgrounds[:, c],
                    crest[:, c],
                    np.exp(level[:, c]),
                    model,
                )
                for c in range(len(pulses))
            ]
        )
    crest, level = crests(arrival_tables(recordings.frames, recordings.backgrounds, pulses, arrivals, model), arrivals)
    setups = find_setups(recordings.backgrounds)
    setup = setup_of(recordings.backgrounds, setups)
    found, offset = fit_delays(crest, recordings, setup, len(setups), delays, per_mm)
    answer = recordings.target_mm + offset
    unsure = np.abs(crest - paths_mm(answer, recordings.elements_mm) * per_mm - found[setup]) > 2 * TYPICAL
    spreading = fit_levels(level, level_terms(answer, recordings.elements_mm), ~unsure)
    return Localiser(
        recordings.elements_mm,
        recordings.sample_rate_hz,
        speed_mps,
        pulses,
        setups,
        found,
        offset,
        spreading,
        model,
    )


def fit_delays(
    crest: NDArray[np.float64],
    recordings: Recordings,
    setup: NDArray[np.intp],
    setups: int,
    first: NDArray[np.float64],
    per_mm: float,
) -> tuple[NDArray[np.float64], Points3]:
    """Delays (set-ups, channels) in samples and offset (3,) in mm from the crests (recordings, channels)."""
    channels = crest.shape[1]

    def split(x: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        return x[:channels] + x[channels + 3 :].reshape(setups, channels), x[channels : channels + 3]

    def residuals(x: NDArray[np.float64]) -> NDArray[np.float64]:
        delays, offset = split(x)
        away = crest - paths_mm(recordings.target_mm + offset, recordings.elements_mm) * per_mm - delays[setup]
        robust = np.sign(away) * np.sqrt(2 * np.log1p(0.5 * (away / TYPICAL) ** 2))
        return np.concatenate([robust.ravel(), offset / OFFSET_SPREAD_MM, x[channels + 3 :] / DELAY_SPREAD])

    start = np.concatenate([first, np.zeros(3 + setups * channels)])
    return split(np.asarray(least_squares(residuals, start).x, dtype=np.float64))


def fit_levels(level: NDArray[np.float64], terms: NDArray[np.float64], sure: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Coefficients (channels, 4) of `level_terms` from levels (recordings, channels) whose crests are sure."""
    out = np.empty((level.shape[1], terms.shape[2]))
    for c in range(len(out)):
        a, y = terms[sure[:, c], c], level[sure[:, c], c]
        weight = np.ones(len(y))
        for _ in range(20):
            root = np.sqrt(weight) / TYPICAL
            rows = np.concatenate([a * root[:, None], np.diag(1 / SPREADING_SPREAD)])
            out[c] = np.linalg.lstsq(rows, np.concatenate([y * root, SPREADING / SPREADING_SPREAD]), rcond=None)[0]
            weight = 1 / (1 + ((y - a @ out[c]) / TYPICAL) ** 2)
    return out
