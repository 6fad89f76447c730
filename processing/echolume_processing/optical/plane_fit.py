"""Robust least squares of a plane that moves with the guide, and how far to trust it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float64]

HUBER = 1.5
ROUNDS = 30
CUTOFF = 5.0


@dataclass(frozen=True)
class RobustFit:
    """Coefficients of ``design @ beta = target``, weights (1 used, 0 cut) and the residuals' robust scale."""

    weights: Values
    beta: Values
    sigma: float


def robust_fit(design: Values, target: Values) -> RobustFit:
    """Huber's estimate by reweighting, then plain least squares of what lies within `CUTOFF` scales."""
    weights = np.ones(len(target))
    beta, residual, sigma = _weighted(design, target, weights)
    for _ in range(ROUNDS):
        weights = np.minimum(1.0, HUBER * sigma / np.maximum(residual, 1e-12))
        before = beta
        beta, residual, sigma = _weighted(design, target, weights)
        if np.all(np.abs(beta - before) <= 1e-9 * (1 + np.abs(beta))):
            break
    weights = (residual < CUTOFF * sigma).astype(np.float64)
    beta, _, sigma = _weighted(design, target, weights)
    return RobustFit(weights, beta, sigma)


def _weighted(design: Values, target: Values, weights: Values) -> tuple[Values, Values, float]:
    """Solution, absolute residuals and their robust scale."""
    root = np.sqrt(weights)
    beta = np.asarray(np.linalg.lstsq(design * root[:, None], target * root, rcond=None)[0], dtype=np.float64)
    residual = np.abs(target - design @ beta)
    return beta, residual, max(1.4826 * float(np.median(residual)), 1e-6)


def grouped_covariance(
    fit: RobustFit, design: Values, target: Values, groups: Sequence[slice], floor: float
) -> tuple[Values, float]:
    """Covariance of the coefficients where points of one group share an error.

    Parameters
    ----------
    fit : RobustFit
    design, target : (n, p), (n,) float64
        As given to `robust_fit`.
    groups : sequence of slice
        Rows that belong together, such as those of one stripe.
    floor : float
        Least standard deviation of the shared error.

    Returns
    -------
    covariance : (p, p) float64
    shared : float
        Standard deviation of the error that a group's points share.

    Notes
    -----
    Residuals are modelled as independent noise plus one error a group. The latter's variance is the scatter of the
    groups' mean residuals less what the noise adds to it; each direction of the coefficients has taken one degree of
    freedom from the groups.
    """
    kept = fit.weights > 0
    residual = target - design @ fit.beta
    means, sizes, sums, within, freedom = [], [], [], 0.0, 0
    for group in groups:
        good = kept[group]
        count = int(good.sum())
        if count < 2:
            continue
        values = residual[group][good]
        mean = float(values.mean())
        within += float(np.sum((values - mean) ** 2))
        freedom += count - 1
        means.append(mean)
        sizes.append(count)
        sums.append(design[group][good].sum(axis=0))
    noise_square = within / max(freedom, 1)
    left = max(len(means) - design.shape[1], 1)
    scatter_square = float(np.sum(np.square(means))) / left - noise_square / max(float(np.mean(sizes)), 1.0)
    shared_square = max(scatter_square, floor**2)
    used = design[kept]
    inverse = np.linalg.inv(used.T @ used)
    middle = noise_square * (used.T @ used)
    for total in sums:
        middle += shared_square * np.outer(total, total)
    return np.asarray(inverse @ middle @ inverse, dtype=np.float64), float(np.sqrt(shared_square))
