"""Localise a small target with one emitter and N receivers from envelopes alone, without phase.

Each channel says how likely each arrival and each level of the target's echo is; a place predicts both, by its path
and by how sound spreads. The channels' likelihoods are multiplied over a grid of places: the mean of that posterior
is the place, its covariance says how sure it is.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3, require_shape

from .arrival import ARRIVAL_STEP, LEVEL_STEP, LEVELS, EchoModel, arrival_tables, smeared
from .localise_kernels import place_kernel
from .setups import setup_of

HEARD = 4.0
"""Times the mean likelihood that a channel must give the best place to count as heard."""
TRUTH_MM = 1.0
"""Standard deviation of the grid and of the places themselves, added to each axis."""


@dataclass(frozen=True)
class Localiser:
    """What a calibration found."""

    elements_mm: Points3
    sample_rate_hz: float
    speed_mps: float
    pulses: NDArray[np.float64]
    """Envelope of an echo, (channels, PULSE_SIZE)."""
    setups: NDArray[np.float64]
    """Mean static background of each set-up of the apparatus, (set-ups, values)."""
    delays: NDArray[np.float64]
    """In samples, (set-ups, channels)."""
    offset_mm: NDArray[np.float64]
    """From the reported place to the place that answers, (3,)."""
    spreading: NDArray[np.float64]
    """Level of an echo by the columns of `level_terms`, (channels, 4)."""
    model: EchoModel


@dataclass(frozen=True)
class Places:
    """Where the targets are, and how sure that is."""

    place_mm: Points3
    covariance_mm2: NDArray[np.float64]
    """(recordings, 3, 3)."""
    heard: NDArray[np.bool_]
    """Channels that hear the target at that place, (recordings, channels)."""


def paths_mm(places_mm: Points3, elements_mm: Points3) -> NDArray[np.float64]:
    """Path origin -> place -> element, (places, channels)."""
    back = np.linalg.norm(places_mm[:, None, :] - elements_mm, axis=2)
    return np.linalg.norm(places_mm, axis=1)[:, None] + back


def level_terms(places_mm: Points3, elements_mm: Points3) -> NDArray[np.float64]:
    """What the logarithm of an echo's height depends on, (places, channels, 4).

    A constant, the two spherical spreadings, and the directivities of the emitter and of the receiver by the logarithm
    of the cosine of the angle.
    """
    out = np.linalg.norm(places_mm, axis=1)[:, None]
    back = np.linalg.norm(places_mm[:, None, :] - elements_mm, axis=2)
    depth = places_mm[:, 2, None] - elements_mm[:, 2]
    leave = np.broadcast_to(np.log(places_mm[:, 2, None] / out), back.shape)
    return np.stack([np.ones_like(back), np.log(out * back), leave, np.log(depth / back)], axis=2)


def expected(
    localiser: Localiser, places_mm: Points3, setup: NDArray[np.intp]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Arrival in samples and level of the echo of each place in its set-up (places,), both (places, channels)."""
    answer = places_mm + localiser.offset_mm
    per_mm = localiser.sample_rate_hz / (1e3 * localiser.speed_mps)
    arrival = paths_mm(answer, localiser.elements_mm) * per_mm + localiser.delays[setup]
    return arrival, np.einsum("pct,ct->pc", level_terms(answer, localiser.elements_mm), localiser.spreading)


def search_grid(
    low_mm: tuple[float, float, float] = (-110.0, -110.0, 60.0),
    high_mm: tuple[float, float, float] = (110.0, 110.0, 260.0),
    side_step_mm: float = 6.0,
    depth_step_mm: float = 2.5,
) -> Points3:
    """Places in a box in front of the emitter, (places, 3); finer in depth, which changes a path most."""
    steps_mm = (side_step_mm, side_step_mm, depth_step_mm)
    sides = [np.arange(lo, hi + 0.5 * step, step) for lo, hi, step in zip(low_mm, high_mm, steps_mm, strict=True)]
    return np.stack(np.meshgrid(*sides, indexing="ij"), axis=-1).reshape(-1, 3)


def grid_around(known_mm: Points3, margin_mm: float = 20.0) -> Points3:
    """Places in the box that holds the known ones, and this much around it, (places, 3)."""
    require_shape("known_mm", known_mm, (None, 3))
    x, y, z = (float(v) for v in known_mm.min(axis=0) - margin_mm)
    far_x, far_y, far_z = (float(v) for v in known_mm.max(axis=0) + margin_mm)
    return search_grid((x, y, z), (far_x, far_y, far_z))


def arrival_grid(localiser: Localiser, grid_mm: Points3) -> NDArray[np.float64]:
    """Arrivals that the places of a grid can cause, in samples, (arrivals,)."""
    reach = [expected(localiser, grid_mm, np.full(len(grid_mm), s))[0] for s in range(len(localiser.setups))]
    return np.arange(np.min(reach) - ARRIVAL_STEP, np.max(reach) + 2 * ARRIVAL_STEP, ARRIVAL_STEP)


def localise(
    localiser: Localiser, frames: NDArray[np.float64], backgrounds: NDArray[np.float64], grid_mm: Points3
) -> Places:
    """Place of the target in each recording, the mean of its posterior over a grid.

    Parameters
    ----------
    frames, backgrounds : (recordings, channels, samples) float64
    grid_mm : (places, 3) float64
        Where the target may be, each place as likely as the others.

    Notes
    -----
    Near the border of the grid the mean is drawn inwards. A target that only two channels hear is spread over an arc,
    and its place is the arc's mean; its covariance says so.
    """
    require_shape("frames", frames, (None, len(localiser.elements_mm), None))
    require_shape("grid_mm", grid_mm, (None, 3))
    arrivals = arrival_grid(localiser, grid_mm)
    setup = setup_of(backgrounds, localiser.setups)
    everywhere = np.broadcast_to(arrivals, (*frames.shape[:2], len(arrivals)))
    tables = smeared(
        arrival_tables(frames, backgrounds, localiser.pulses, everywhere, localiser.model), localiser.model
    )
    return places_of(localiser, tables, arrivals, setup, grid_mm)


def places_of(
    localiser: Localiser,
    tables: NDArray[np.float32],
    arrivals: NDArray[np.float64],
    setup: NDArray[np.intp],
    grid_mm: Points3,
) -> Places:
    """Posterior over a grid from the channels' tables (recordings, channels, arrivals, levels)."""
    indices = []
    for s in range(len(localiser.setups)):
        arrival, level = expected(localiser, grid_mm, np.full(len(grid_mm), s))
        indices.append(((arrival - arrivals[0]) / ARRIVAL_STEP, (level - LEVELS[0]) / LEVEL_STEP))
    places = np.empty((len(tables), 3))
    covariance = np.empty((len(tables), 3, 3))
    heard = np.empty(tables.shape[:2], dtype=np.bool_)
    score = np.empty(len(grid_mm))
    for r, table in enumerate(tables):
        at_arrival, at_level = indices[setup[r]]
        place_kernel(table, at_arrival, at_level, localiser.model.lost, score)
        weight = np.exp(score - score.max())
        weight /= weight.sum()
        places[r] = weight @ grid_mm
        away = grid_mm - places[r]
        covariance[r] = (away * weight[:, None]).T @ away + TRUTH_MM**2 * np.eye(3)
        best = int(score.argmax())
        x = np.clip(np.rint(at_arrival[best]).astype(np.int64), 0, table.shape[1] - 1)
        y = np.clip(np.rint(at_level[best]).astype(np.int64), 0, table.shape[2] - 1)
        heard[r] = table[np.arange(len(x)), x, y] > HEARD
    return Places(places, covariance, heard)
