"""What else than noise the paths over the plate speak for: a bench that is not flat, a robot that was bumped."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_processing.ultrasonic.plate_problem import PlateProblem

MIN_GAIN = 60.0
"""A suspicion explains at least this much of chi-squared: some eight sigma."""
MIN_SIDE = 3
"""Pings on each side of a step."""
MIN_APART_MM = 5.0
WEAK = 1e8
"""Condition of what is left of a pattern beside the unknowns: a worse one is explained by them."""


@dataclass(frozen=True)
class Suspicion:
    """One cause that would explain residuals."""

    words: str
    amount_mm: float
    """Of height."""
    gain: float
    """By how much chi-squared falls with it."""
    share: float
    """Of all chi-squared."""


def strongest_suspicion(
    problem: PlateProblem, found: NDArray[np.float64], covariance: NDArray[np.float64]
) -> Suspicion | None:
    """The cause that explains most, None where none explains more than chance does.

    Parameters
    ----------
    problem : PlateProblem
        With all paths that were measured.
    found : (unknowns,) float64
    covariance : (unknowns, unknowns) float64
        Of the fit, in the problem's units.

    Notes
    -----
    Score tests: each cause shifts all paths of some pings by a pattern s. With the projector P = 1 - J C J' that takes
    away what the unknowns explain themselves, chi-squared falls by (s'P r)^2 / (s'P s). Nothing is fitted again.
    """
    rows = problem.known.size
    slopes = problem.jacobian(found)[:rows]
    left = problem.residuals(found)[:rows]
    whole = max(float(left @ left), 1e-12)
    best: Suspicion | None = None
    for words, pattern in _patterns(problem.data.poses):
        shift = problem.shared(pattern)
        clean = shift - slopes @ (covariance @ (slopes.T @ shift))
        curvature = clean.T @ shift
        if np.linalg.cond(curvature) > WEAK:
            continue
        amounts = np.linalg.solve(curvature, clean.T @ left)
        gain = float(amounts @ (clean.T @ left))
        if gain > MIN_GAIN and (best is None or gain > best.gain):
            height_mm = 0.5 * float(np.ptp(pattern @ amounts))
            best = Suspicion(f"{words} (about {height_mm:.2f} mm)", height_mm, gain, gain / whole)
    return best


def _patterns(poses: NDArray[np.float64]) -> Iterator[tuple[str, NDArray[np.float64]]]:
    """Words, and by how much each ping's paths are shifted, (pings, shapes)."""
    order = np.arange(len(poses))
    for k in range(MIN_SIDE, len(poses) - MIN_SIDE):
        yield f"the robot or the bench moved between pings {k - 1} and {k}", _step(order >= k)
    for axis, at in (("x", poses[:, 0]), ("y", poses[:, 1])):
        for low, high in zip(np.unique(at)[:-1].tolist(), np.unique(at)[1:].tolist(), strict=True):
            beyond = at >= high
            if high - low < MIN_APART_MM or min(beyond.sum(), (~beyond).sum()) < MIN_SIDE:
                continue
            yield f"the bench has a step between {axis} = {low:.0f} and {high:.0f} mm", _step(beyond)
    x, y = 1e-2 * poses[:, 0], 1e-2 * poses[:, 1]
    yield "the bench is bent", np.column_stack([x * x, x * y, y * y])


def _step(beyond: NDArray[np.bool_]) -> NDArray[np.float64]:
    return beyond.astype(np.float64)[:, None]
