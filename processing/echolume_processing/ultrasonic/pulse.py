"""The envelope of an echo, channel by channel, learned from recordings whose crests are known."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import BSpline, make_lsq_spline

from echolume_messages.geometry import require_shape

from .arrival import PULSE_SIZE, EchoModel, pulse_axis

FIRST, LAST = -6.0, 4.5
"""Samples around the crest in which a pulse may differ from zero."""
KNOT_STEP = 0.75
FIRST_SIGMA = 2.0
"""Width, in samples, of the pulse assumed at first."""
ROUNDS = 3
SHAPE_SPREAD = 0.05


def first_pulse() -> NDArray[np.float64]:
    """A Gaussian to begin with, (PULSE_SIZE,)."""
    axis = pulse_axis()
    return np.where((axis > FIRST) & (axis < LAST), np.exp(-0.5 * (axis / FIRST_SIGMA) ** 2), 0.0)


def learn_pulse(
    frames: NDArray[np.float64],
    backgrounds: NDArray[np.float64],
    crest: NDArray[np.float64],
    height: NDArray[np.float64],
    model: EchoModel,
) -> NDArray[np.float64]:
    """Envelope of an echo of height 1 with its crest at 0, (PULSE_SIZE,).

    Parameters
    ----------
    frames, backgrounds : (recordings, samples) float64
        Of one channel.
    crest, height : (recordings,) float64
        In samples, and in the envelope's unit.

    Notes
    -----
    The phase between echo and background is any, so that |b + e|^2 - |b|^2 is |e|^2 on average, with a scatter of
    sqrt(2) |b| |e|. A spline through these powers, weighted by the scatter and deaf to outliers, gives the pulse. Fewer
    than about ten recordings, or crests that all fall on the same part of a sample, leave it undetermined.
    """
    require_shape("frames", frames, (None, None))
    offset = np.arange(frames.shape[1]) - crest[:, None]  # (recordings, samples)
    used = (offset > FIRST) & (offset < LAST)
    power = ((frames**2 - backgrounds**2) / height[:, None] ** 2)[used]
    relative = (backgrounds / height[:, None])[used]
    floor = model.noise / np.broadcast_to(height[:, None], frames.shape)[used]
    at = offset[used]
    order = np.argsort(at)
    at, power, relative, floor = at[order], power[order], relative[order], floor[order]
    inner = np.arange(FIRST + KNOT_STEP, LAST - 0.5 * KNOT_STEP, KNOT_STEP)
    knots = np.concatenate([[FIRST] * 4, inner, [LAST] * 4])
    first = np.exp(-0.5 * (at / FIRST_SIGMA) ** 2)
    spline = _fit(at, power, knots, first, np.ones_like(at), relative, floor)
    for _ in range(ROUNDS):
        shape = np.sqrt(np.maximum(spline(at), 0.0))
        variance = _variance(shape, relative, floor)
        spline = _fit(at, power, knots, shape, 1 / (1 + (power - shape**2) ** 2 / (4 * variance)), relative, floor)
    axis = pulse_axis()
    inside = (axis >= FIRST) & (axis <= LAST)
    pulse = np.zeros(PULSE_SIZE)
    pulse[inside] = np.sqrt(np.maximum(spline(axis[inside]), 0.0))
    return _centred(pulse)


def _variance(
    shape: NDArray[np.float64], relative: NDArray[np.float64], floor: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Of the added power, over the echo's height: interference, noise, and a shape that is not always the same."""
    return 2 * (relative * shape) ** 2 + (2 * floor * np.hypot(relative, shape)) ** 2 + SHAPE_SPREAD**2


def _fit(
    at: NDArray[np.float64],
    power: NDArray[np.float64],
    knots: NDArray[np.float64],
    shape: NDArray[np.float64],
    trust: NDArray[np.float64],
    relative: NDArray[np.float64],
    floor: NDArray[np.float64],
) -> BSpline:
    return make_lsq_spline(at, power, knots, k=3, w=np.sqrt(trust / _variance(shape, relative, floor)))


def _centred(pulse: NDArray[np.float64]) -> NDArray[np.float64]:
    """Moved and scaled so that its crest is 1 at 0."""
    axis = pulse_axis()
    near = np.where(np.abs(axis) < 2.5, pulse, 0.0)
    top = int(near.argmax())
    return np.interp(axis + axis[top], axis, pulse, left=0.0, right=0.0) / near[top]
