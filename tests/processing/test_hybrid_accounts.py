"""Which pings are near to which cells."""

from __future__ import annotations

import numpy as np

from echolume_messages.plan import MapField
from echolume_processing.hybrid.accounts import nearest, within
from echolume_processing.hybrid.model import cell_centres_mm

FIELD = MapField(x_mm=(-10.0, 10.0), y_mm=(-6.0, 6.0), cell_mm=0.5)


def test_every_cell_within_reach_of_a_place_and_no_other_is_found() -> None:
    rng = np.random.default_rng(2)
    place_mm, number = rng.uniform(-14, 14, (9, 2)), np.arange(40, 49)
    mask = rng.random(FIELD.shape) < 0.7
    found = within(place_mm, number, mask, FIELD, 3.3)
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(FIELD))
    away_mm = np.hypot(x_mm.ravel()[:, None] - place_mm[:, 0], y_mm.ravel()[:, None] - place_mm[:, 1])
    cell, which = np.nonzero((away_mm <= 3.3) & mask.ravel()[:, None])
    assert set(zip(found.cell.tolist(), found.ping.tolist(), strict=True)) == set(
        zip(cell.tolist(), number[which].tolist(), strict=True)
    )
    first = nearest(found, FIELD).ravel()
    away_mm = np.where(mask.ravel()[:, None] & (away_mm <= 3.3), away_mm, np.inf)
    there = np.isfinite(away_mm).any(axis=1)
    assert (first[~there] == -1).all()
    assert (first[there] == number[away_mm[there].argmin(axis=1)]).all()


def test_of_two_pings_as_near_the_earlier_one_counts() -> None:
    whole = np.ones(FIELD.shape, dtype=np.bool_)
    found = within(np.array([[1.0, 0.25], [-0.5, 0.25]]), np.array([5, 3]), whole, FIELD, 2.0)
    x_mm, y_mm = cell_centres_mm(FIELD)
    at = nearest(found, FIELD)[int(np.argmin(np.abs(y_mm - 0.25)))]
    assert at[int(np.argmin(np.abs(x_mm - 0.25)))] == 3


def test_without_pings_no_cell_has_one() -> None:
    nobody = within(np.zeros((0, 2)), np.zeros(0, np.int64), np.ones(FIELD.shape, np.bool_), FIELD, 2.0)
    assert (nearest(nobody, FIELD) == -1).all()
