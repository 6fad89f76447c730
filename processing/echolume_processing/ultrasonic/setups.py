"""Set-ups of the apparatus, told apart by what it hears of itself before any target: ringing, cross-talk, mount."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.cluster import hierarchy

from echolume_messages.geometry import require_shape

STATIC_SAMPLES = 20
"""First samples of a background, in which only the apparatus itself answers."""
RINGING_SAMPLES = 13
"""First samples of the emitting channel: it rings, and how much varies from one recording to the next."""
APART = 1000.0
"""Ward's distance of two groups of backgrounds, in the envelope's unit, from which they are different set-ups."""
FEWEST = 8
"""Recordings that make a set-up; stragglers join the nearest one."""


def static_part(backgrounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """What a background (recordings, channels, samples) holds of the apparatus itself, (recordings, values)."""
    require_shape("backgrounds", backgrounds, (None, None, None))
    early = backgrounds[:, :, :STATIC_SAMPLES].copy()
    early[:, 0, :RINGING_SAMPLES] = 0.0
    return early.reshape(len(early), -1)


def find_setups(backgrounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """Mean static part of each set-up among the backgrounds, (set-ups, values).

    Notes
    -----
    Backgrounds know nothing of the target, so that a recording's set-up may be looked up wherever the target is.
    """
    static = static_part(backgrounds)
    labels = hierarchy.fcluster(hierarchy.linkage(static, "ward"), APART, "distance")
    sizes = np.bincount(labels)
    large = np.flatnonzero(sizes >= min(FEWEST, sizes.max()))
    return np.array([static[labels == label].mean(axis=0) for label in large])


def setup_of(backgrounds: NDArray[np.float64], setups: NDArray[np.float64]) -> NDArray[np.intp]:
    """Index of the nearest set-up of each background, (recordings,)."""
    return np.argmin(np.linalg.norm(static_part(backgrounds)[:, None] - setups, axis=2), axis=1)
