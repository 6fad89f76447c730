"""Outlines of plates."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_processing.hybrid.outline import straightened

Y, X = np.mgrid[0:120, 0:120] + 0.5


def rounded(half_x: float, half_y: float, radius: float, turn_rad: float = 0.0) -> np.ndarray:
    """A rectangle with round corners about the middle."""
    x, y = X - 60.3, Y - 59.8
    u, v = x * np.cos(turn_rad) + y * np.sin(turn_rad), y * np.cos(turn_rad) - x * np.sin(turn_rad)
    outside = np.hypot(np.maximum(np.abs(u) - half_x + radius, 0), np.maximum(np.abs(v) - half_y + radius, 0))
    return outside <= radius if radius else (np.abs(u) <= half_x) & (np.abs(v) <= half_y)


@pytest.mark.parametrize("turn_rad", [0.0, 0.3, np.pi / 4])
def test_round_corners_of_a_rectangle_become_sharp(turn_rad: float) -> None:
    round_, sharp = rounded(35, 25, 5.0, turn_rad), rounded(35, 25, 0.0, turn_rad)
    missing = (round_ != sharp).sum()
    assert missing >= 16
    assert (straightened(round_, 1.0) != sharp).sum() <= 0.5 * missing


def test_a_disc_stays_round() -> None:
    disc = np.hypot(X - 60, Y - 60) <= 30
    assert (straightened(disc, 1.0) != disc).mean() < 0.01


def test_a_hole_stays_and_the_outline_around_it_becomes_straight() -> None:
    hole = np.hypot(X - 60, Y - 60) <= 15
    found = straightened(rounded(40, 35, 4.0) & ~hole, 1.0)
    assert (found & hole).sum() < 0.05 * hole.sum()
    assert (found != (rounded(40, 35, 0.0) & ~hole)).sum() < 60


def test_a_mask_with_sharp_corners_stays_as_it_is() -> None:
    sharp = np.zeros((80, 90), dtype=np.bool_)
    sharp[20:60, 10:75] = True
    assert (straightened(sharp, 1.0) == sharp).all()
