"""Tables of how likely each arrival and level of an echo is, channel by channel, from envelopes without phase."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from echolume_messages.geometry import require_shape

from .localise_kernels import PULSE_FIRST, PULSE_STEP, echo_kernel
from .recordings import BLIND_SAMPLES

PULSE_SIZE = 400
ARRIVAL_STEP = 0.15
LEVEL_STEP = 0.12
LEVELS = np.arange(np.log(40.0), np.log(4000.0), LEVEL_STEP)
"""Logarithm of an echo's height, in the envelope's unit."""


@dataclass(frozen=True)
class EchoModel:
    """How envelopes scatter around |background + echo|; in samples and the envelope's unit."""

    noise: float = 20.0
    share: float = 0.02
    """Part of an echo's height by which its shape may differ from the pulse."""
    phase_walk_rad: float = 0.3
    """Standard deviation of the change of the phase between echo and background, from one sample to the next."""
    before: float = 5.0
    after: float = 3.0
    """Samples around the crest that are compared; what follows is the target's shadow and late echoes."""
    phases: int = 8
    tempering: float = 0.6
    """Power of a channel's likelihood: its samples are not independent."""
    arrival_spread: float = 0.25
    level_spread: float = 0.15
    """Standard deviations, in samples and as a logarithm, that the geometry leaves unexplained."""
    lost: float = 0.05
    """Probability that a channel does not hear the target."""


@cache
def phase_walk(phases: int, step_rad: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Cosines of the phases (phases,) of half a turn, and chance of each change (phases, phases), row: from."""
    at = (np.arange(phases) + 0.5) * np.pi / phases
    walk = np.zeros((phases, phases))
    for image in (1.0, -1.0):  # cos does not tell phi from -phi: what leaves half a turn comes back mirrored
        for turn in (-1, 0, 1):
            walk += np.exp(-0.5 * ((at[None] - image * at[:, None] - 2 * np.pi * turn) / step_rad) ** 2)
    return np.cos(at), walk / walk.sum(axis=1, keepdims=True)


def arrival_tables(
    frames: NDArray[np.float64],
    backgrounds: NDArray[np.float64],
    pulses: NDArray[np.float64],
    arrivals: NDArray[np.float64],
    model: EchoModel,
) -> NDArray[np.float64]:
    """Log likelihood of each arrival and level, (recordings, channels, arrivals, levels).

    Parameters
    ----------
    frames, backgrounds : (recordings, channels, samples) float64
    pulses : (channels, PULSE_SIZE) float64
        Envelope of an echo of height 1 with its crest at 0, from PULSE_FIRST in steps of PULSE_STEP samples.
    arrivals : (recordings, channels, arrivals) float64
        Where the crest may be, in samples.

    Notes
    -----
    A sample before the echo is the background, one in the pulse is |background + echo| with the phase a random walk,
    one behind it is nearly anything. The noise does not depend on height; another gain needs another model.
    """
    require_shape("frames", frames, (None, None, None))
    require_shape("pulses", pulses, (frames.shape[1], PULSE_SIZE))
    cosines, walk = phase_walk(model.phases, model.phase_walk_rad)
    settings = (model.noise, model.share, model.before, model.after, BLIND_SAMPLES)
    tables = np.empty((*arrivals.shape, len(LEVELS)))
    for r in range(len(frames)):
        for c, pulse in enumerate(pulses):
            echo_kernel(
                frames[r, c], backgrounds[r, c], pulse, arrivals[r, c], LEVELS, cosines, walk, settings, tables[r, c]
            )
    return tables


def smeared(tables: NDArray[np.float64], model: EchoModel) -> NDArray[np.float32]:
    """Likelihoods over their mean, tempered, and widened by what the geometry leaves unexplained; same shape."""
    likelihood = np.exp(model.tempering * (tables - tables.max(axis=(2, 3), keepdims=True)))
    likelihood = ndimage.gaussian_filter1d(likelihood, model.arrival_spread / ARRIVAL_STEP, axis=2, mode="constant")
    likelihood = ndimage.gaussian_filter1d(likelihood, model.level_spread / LEVEL_STEP, axis=3, mode="nearest")
    return (likelihood / likelihood.mean(axis=(2, 3), keepdims=True)).astype(np.float32)


def crests(
    tables: NDArray[np.float64], arrivals: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Most likely arrival and level of each channel, both (recordings, channels)."""
    flat = tables.reshape(*tables.shape[:2], -1).argmax(axis=2)
    first, second = np.divmod(flat, tables.shape[3])
    return np.take_along_axis(arrivals, first[:, :, None], axis=2)[:, :, 0], LEVELS[second]


def pulse_axis() -> NDArray[np.float64]:
    """Samples from the crest at which a pulse is kept, (PULSE_SIZE,)."""
    return PULSE_FIRST + PULSE_STEP * np.arange(PULSE_SIZE, dtype=np.float64)
