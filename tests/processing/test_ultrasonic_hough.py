"""Straight edges of gray-level images whose sides are known."""

import numpy as np
import pytest

from echolume_processing.ultrasonic.gray import gaussian
from echolume_processing.ultrasonic.hough import edge_segments

LENGTH_PX, WIDTH_PX = 50.0, 20.0


def bars(gap_px: float, turn_rad: float = 0.0, teeth_px: float = 0.0) -> np.ndarray:
    """Two bars side by side, turned about the middle of the image; teeth as a coarse scan makes them."""
    u, v = on_bars(np.stack(np.meshgrid(np.arange(140.0), np.arange(140.0)), axis=-1), turn_rad)
    wave = teeth_px * np.sign(np.sin(2 * np.pi * v / 10))
    inside = (np.abs(v) < LENGTH_PX / 2) & (np.abs(np.abs(u) - gap_px / 2 - WIDTH_PX / 2) < WIDTH_PX / 2 + wave)
    return gaussian(np.where(inside, 180, 10).astype(np.uint8), 1.5)


def on_bars(at_px: np.ndarray, turn_rad: float) -> tuple[np.ndarray, np.ndarray]:
    """Places across and along the bars, from their middle."""
    dx, dy = np.moveaxis(at_px - 70.0, -1, 0)
    return np.cos(turn_rad) * dx + np.sin(turn_rad) * dy, np.cos(turn_rad) * dy - np.sin(turn_rad) * dx


def ends_on_bars(
    image: np.ndarray, turn_rad: float, min_length_px: int, votes: int = 20
) -> list[tuple[np.ndarray, np.ndarray]]:
    found = edge_segments(image, min_length_px, max_gap_px=8, votes=votes)
    return [on_bars(ends, turn_rad) for ends in found.reshape(-1, 2, 2)]


@pytest.mark.parametrize("turn_rad", [0.0, 0.3, 0.8, 1.2])
@pytest.mark.parametrize("teeth_px", [0.0, 1.0])
@pytest.mark.parametrize("gap_px", [6.0, 10.0, 14.0])
def test_two_parallel_bars_have_their_own_long_sides_and_no_line_joins_them(gap_px, teeth_px, turn_rad):
    sides = np.array([-gap_px / 2 - WIDTH_PX, -gap_px / 2, gap_px / 2, gap_px / 2 + WIDTH_PX])
    hit: list[int] = []
    for u, v in ends_on_bars(bars(gap_px, turn_rad, teeth_px), turn_rad, 28):
        side = int(np.argmin(np.abs(sides - u.mean())))
        assert np.abs(u - sides[side]).max() <= 2.5
        assert np.abs(v).max() <= LENGTH_PX / 2 + 1
        hit.append(side)
    assert sorted(hit) == [0, 1, 2, 3]


def test_ends_of_two_bars_in_one_line_stay_two_edges():
    ends = [(u, v) for u, v in ends_on_bars(bars(6.0), 0.0, 10, votes=10) if np.ptp(u) > np.ptp(v)]
    assert len(ends) == 4
    for u, v in ends:
        assert np.abs(np.abs(v) - LENGTH_PX / 2).max() < 1.5
        assert u.min() * u.max() > 0


def test_what_has_no_straight_side_has_no_straight_edges():
    x, y = np.meshgrid(np.arange(140.0), np.arange(140.0))
    disc = np.where(np.hypot(x - 70, y - 70) < 30, 180, 10).astype(np.uint8)
    assert edge_segments(gaussian(disc, 1.5), 30).shape == (0, 4)
    assert edge_segments(np.full((60, 80), 7, dtype=np.uint8), 10).shape == (0, 4)
