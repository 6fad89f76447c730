"""How well a fit over the plate predicts poses that are left out of it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from echolume_processing.ultrasonic.plate_problem import PlateProblem


def left_out(problem: PlateProblem, found: NDArray[np.float64], covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Chi-squared per path of each ping as the fit without it predicts it, (pings,).

    Parameters
    ----------
    problem : PlateProblem
    found : (unknowns,) float64
        Solution.
    covariance : (unknowns, unknowns) float64
        Their scatter taken into account.

    Notes
    -----
    With e the ping's residuals in their sigma and H = J C J' its block of the hat matrix, the fit without it leaves
    (1 - H)^-1 e with the covariance (1 - H)^-1.
    """
    n, worse = problem.receivers, problem.scatter(found)
    slopes = problem.jacobian(found)
    residuals = problem.residuals(found) / worse
    out = np.full(len(problem.known), np.nan)
    for k, known in enumerate(problem.known):
        if not known.any():
            continue
        rows = slice(k * n, (k + 1) * n)
        block = slopes[rows] / worse
        apart = np.eye(n) - block @ covariance @ block.T
        out[k] = float(residuals[rows] @ np.linalg.solve(apart, residuals[rows])) / int(known.sum())
    return out
