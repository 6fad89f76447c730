"""The paper's Table I: widths of twelve curves of energy over angle, from one radius and one level of cross-talk."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from echolume_processing.ultrasonic.cross_talk import CrossTalk
from echolume_processing.ultrasonic.plate_energy import GaussianFit, fit_gaussian, plate_energy

TABLE_I: tuple[tuple[float, float, float, float, float], ...] = (
    (200.0, 30.0, 1.00, 0.56, 21.2),
    (200.0, 100.0, 1.02, 2.18, 18.7),
    (200.0, 150.0, 0.95, 0.39, 18.27),
    (400.0, 30.0, 0.99, -2.11, 17.81),
    (400.0, 100.0, 0.97, -1.86, 18.02),
    (400.0, 150.0, 0.99, -2.13, 18.03),
    (600.0, 30.0, 0.97, 3.74, 17.84),
    (600.0, 100.0, 0.98, 2.54, 18.15),
    (600.0, 150.0, 0.96, 3.22, 17.61),
    (800.0, 30.0, 0.98, 5.05, 17.96),
    (800.0, 100.0, 0.97, 3.61, 19.5),
    (800.0, 150.0, 0.95, 2.28, 18.6),
)
"""The paper's Table I: distance_mm, separation_mm, a, b in deg, c in deg."""
ANGLES_RAD: NDArray[np.float64] = np.radians(np.linspace(-45, 45, 91))
"""Angles of the plate in the paper's figure 6."""
START_RADIUS = 4.5
START_LEVEL = 0.02
_DISTANCES, _SEPARATIONS, _A, _B_DEG, _C_DEG = (np.array(column) for column in zip(*TABLE_I, strict=True))


@dataclass(frozen=True)
class TableFit:
    """Table I as physics gives it."""

    wavenumber_radius: float
    cross_talk: CrossTalk | None
    gaussians: tuple[GaussianFit, ...]
    """Fits to the twelve curves; their b is 0, as the set-up's offsets are not physics."""

    @cached_property
    def offsets_deg(self) -> NDArray[np.float64]:
        """Set-up offset b of each row, (12,): the mean of the paper's b over the three rows of a distance."""
        return np.repeat(_B_DEG.reshape(4, 3).mean(axis=1), 3)

    @cached_property
    def residuals_a(self) -> NDArray[np.float64]:
        """Ours less the paper's, (12,)."""
        return np.array([g.a for g in self.gaussians]) - _A

    @cached_property
    def residuals_b_deg(self) -> NDArray[np.float64]:
        """The distance's offset less the paper's b, (12,)."""
        return self.offsets_deg - _B_DEG

    @cached_property
    def residuals_c_deg(self) -> NDArray[np.float64]:
        """Ours less the paper's, (12,)."""
        return np.degrees([g.c_rad for g in self.gaussians]) - _C_DEG

    @property
    def level(self) -> float:
        """Of cross-talk, 0 without."""
        return 0.0 if self.cross_talk is None else self.cross_talk.level

    @property
    def rms_c_deg(self) -> float:
        """Over all twelve rows."""
        return float(np.sqrt(np.mean(self.residuals_c_deg**2)))

    @property
    def rms_c_without_row_1_deg(self) -> float:
        """Over the other eleven, with the parameters fitted to all twelve."""
        return float(np.sqrt(np.mean(self.residuals_c_deg[1:] ** 2)))


def table_gaussians(wavenumber_radius: float, cross_talk: CrossTalk | None = None) -> tuple[GaussianFit, ...]:
    """Gaussians of Table I's twelve rows as one k R, and cross-talk if there is any, predict them."""
    return tuple(
        fit_gaussian(ANGLES_RAD, plate_energy(ANGLES_RAD, row[0], row[1], wavenumber_radius, cross_talk))
        for row in TABLE_I
    )


def fit_table() -> TableFit:
    """The k R that reproduces the widths of Table I best, and nothing else."""

    def residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.degrees([g.c_rad for g in table_gaussians(float(p[0]))]) - _C_DEG

    found = float(least_squares(residuals, [START_RADIUS], diff_step=1e-4).x[0])
    return TableFit(found, None, table_gaussians(found))


def fit_table_with_cross_talk(start: CrossTalk | None = None, rows: slice = slice(None)) -> TableFit:
    """The k R and the level of cross-talk that reproduce the widths of Table I best.

    Parameters
    ----------
    start : CrossTalk, optional
        Burst and transducers to assume, and the level to start from.
    rows : slice
        Of the table, that the fit rests on.

    Notes
    -----
    That cross-talk widens the first row is a hypothesis: the paper says nothing of it. Row 1 (nearest plate, nearest
    receivers) needs it; the eleven others are fitted better with it too, and by themselves ask for about as much of it.
    """
    first = start or CrossTalk(START_LEVEL)

    def talk(logarithm: float) -> CrossTalk:
        return CrossTalk(first.level * float(np.exp(logarithm)), first.quality, first.cycles)

    def residuals(p: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.degrees([g.c_rad for g in table_gaussians(float(p[0]), talk(float(p[1])))])[rows] - _C_DEG[rows]

    solved = least_squares(residuals, [START_RADIUS, 0.0], diff_step=1e-4)
    wavenumber_radius, cross_talk = float(solved.x[0]), talk(float(solved.x[1]))
    return TableFit(wavenumber_radius, cross_talk, table_gaussians(wavenumber_radius, cross_talk))


def table_lines(plain: TableFit, with_cross_talk: TableFit) -> list[str]:
    """Table I and ours beside it as lines of text, residuals last."""
    lines = [
        "distance  separation |  a: paper  ours  |  b: paper  set-up |  c: paper   k R alone     with cross-talk",
        "     mm         mm   |                  |    deg      deg   |    deg      deg  (off)      deg  (off)",
    ]
    for k, (distance, separation, a, b_deg, c_deg) in enumerate(TABLE_I):
        alone, with_talk = plain.residuals_c_deg[k], with_cross_talk.residuals_c_deg[k]
        lines.append(
            f"{distance:7.0f}{separation:11.0f}   |{a:9.2f}{with_cross_talk.gaussians[k].a:8.2f} |{b_deg:9.2f}"
            f"{plain.offsets_deg[k]:9.2f}   |{c_deg:9.2f}{c_deg + alone:9.2f} ({alone:+.2f}){c_deg + with_talk:9.2f} "
            f"({with_talk:+.2f})"
        )
    return lines
