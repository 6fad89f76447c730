"""The usual stripe methods, differences of frames, the choice of a colour channel, and the line through the rows."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_processing.optical.frames import difference, grey, stripe_channel
from echolume_processing.optical.methods import METHODS
from echolume_processing.optical.stripe import extract
from echolume_processing.optical.trace import trace

ROWS, COLUMNS = 120, 320
OFF_PX = {"argmax": 0.51, "centre of mass": 0.1}
"""How far each method may be off a clean stripe; 0.05 px if not named."""
INNER = np.s_[10:-10]
"""Rows whose neighbours above and below, which Steger's method sees, are in the frame."""


def stripe(columns: np.ndarray, sigma_px: float = 1.5, crest: float = 160.0, background: float = 0.0) -> np.ndarray:
    away = np.arange(COLUMNS) - columns[:, None]
    return background + crest * np.exp(-(away**2) / (2 * sigma_px**2))


def straight(start: float = 150.3, slope: float = 0.0) -> np.ndarray:
    return start + slope * np.arange(ROWS)


@pytest.mark.parametrize("name", list(METHODS))
@pytest.mark.parametrize("dtype", [np.uint8, np.uint16])
@pytest.mark.parametrize("slope", [0.0, 0.15])
def test_each_method_finds_a_clean_stripe(name: str, dtype: type, slope: float) -> None:
    columns = straight(slope=slope)
    gain = 1 if dtype is np.uint8 else 20
    found = METHODS[name](np.rint(gain * stripe(columns)).astype(dtype))
    assert found.shape == (ROWS,)
    assert found.dtype == np.float64
    assert np.max(np.abs(found - columns)[INNER]) < OFF_PX.get(name, 0.05)


@pytest.mark.parametrize("name", [name for name in METHODS if name not in ("argmax", "blais-rioux-2")])
def test_each_method_gives_the_middle_of_a_symmetric_row(name: str) -> None:
    row = np.array([0, 0, 0, 0, 4, 20, 70, 120, 70, 20, 4, 0, 0, 0, 0], dtype=np.uint8)
    assert METHODS[name](np.tile(row, (9, 1)))[4] == pytest.approx(7.0, abs=1e-6)


@pytest.mark.parametrize("name", ["parabola", "gauss", "centre of mass"])
def test_a_dark_frame_has_no_column(name: str) -> None:
    assert np.isnan(METHODS[name](np.zeros((4, 30), dtype=np.uint8))).all()


def test_a_difference_neither_wraps_nor_loses_the_noise_below_zero() -> None:
    lit = np.array([[10, 100, 250, 255, 0]], dtype=np.uint8)
    dark = np.array([[14, 40, 10, 200, 60]], dtype=np.uint8)
    assert difference(lit, dark).tolist() == [[12, 76, 255, 255, 0]]
    assert difference(lit, dark).dtype == np.uint8


def test_a_difference_of_12_bits_ends_at_4095() -> None:
    lit = np.array([[100, 3900, 4095]], dtype=np.uint16)
    dark = np.array([[50, 0, 4000]], dtype=np.uint16)
    assert difference(lit, dark).tolist() == [[306, 4095, 4095]]


def test_a_difference_takes_the_lamp_away_and_keeps_the_saturation() -> None:
    columns = straight(slope=0.1)
    lamp = 60 * np.exp(-((np.arange(COLUMNS) - 40) ** 2) / 50)
    dark = np.rint(20 + lamp * np.ones((ROWS, 1))).astype(np.uint8)
    for crest, clipped in ((120.0, False), (600.0, True)):
        lit = np.clip(np.rint(dark + stripe(columns, crest=crest)), 0, 255).astype(np.uint8)
        found = extract(difference(lit, dark), 2)
        assert np.max(np.abs(found.column_px[:, 0] - columns)) < 0.05
        assert np.isnan(found.column_px[:, 1]).all()
        assert (found.saturated[:, 0] == clipped).all()


def test_frames_of_different_shape_have_no_difference() -> None:
    with pytest.raises(ValueError, match=r"dark: expected \(4, 5\) uint8 like lit, got \(4, 6\) uint8"):
        difference(np.zeros((4, 5), dtype=np.uint8), np.zeros((4, 6), dtype=np.uint8))


def test_the_brightest_channel_that_is_not_clipped_is_chosen() -> None:
    red, green, blue = (
        np.clip(np.rint(stripe(straight(), crest=crest, background=20)), 0, 255).astype(np.uint8)
        for crest in (900.0, 120.0, 60.0)
    )
    image = np.dstack([blue, green, red])
    assert stripe_channel(image) == 1
    assert (grey(image) == green).all()
    assert stripe_channel(np.dstack([red, red, red // 2])) == 2


def test_a_dark_image_has_a_channel_too() -> None:
    assert stripe_channel(np.zeros((20, 60, 3), dtype=np.uint8)) in (0, 1, 2)


def test_the_line_through_the_rows_passes_brighter_glints_and_takes_a_step() -> None:
    columns = straight(slope=0.2) + np.where(np.arange(ROWS) >= 70, 30.0, 0.0)
    frame = stripe(columns, crest=90, background=20)
    glint = 200 * np.exp(-((np.arange(COLUMNS) - 240.0) ** 2) / 18 - ((np.arange(ROWS)[:, None] - 30.0) ** 2) / 40)
    found = extract(np.clip(np.rint(frame + glint), 0, 255).astype(np.uint8), 3)
    assert np.abs(found.column_px[30, 0] - columns[30]) > 50
    chosen = trace(found)
    assert np.max(np.abs(found.column_px[np.arange(ROWS), chosen] - columns)) < 0.1


def test_rows_without_a_candidate_are_passed_over() -> None:
    frame = np.rint(stripe(straight(), background=20)).astype(np.uint8)
    frame[40:60] = 20
    chosen = trace(extract(frame, 2))
    assert (chosen[40:60] == -1).all()
    assert (np.delete(chosen, np.s_[40:60]) == 0).all()
    assert (trace(extract(np.full((5, 80), 20, dtype=np.uint8))) == -1).all()
