"""Scores of a map against the truth."""

from __future__ import annotations

import numpy as np
import pytest

from echolume import scoring
from echolume_messages.plan import MapField
from echolume_messages.types import Label

NAN = float("nan")


def truth(front: list[list[float]], glass: list[list[int]]) -> scoring.Truth:
    return scoring.Truth(front_mm=np.array(front), glass=np.array(glass, dtype=bool))


def test_codes_are_those_of_the_messages() -> None:
    assert scoring.TRANSPARENT == Label.TRANSPARENT


def test_a_perfect_map_scores_one() -> None:
    real = truth([[0, 10], [30, 0]], [[0, 0], [1, 0]])
    found = scoring.score(real["front_mm"], np.array([[1, 1], [2, 1]]), real)
    assert found == {
        "rmse_mm": 0.0,
        "f1_at_0p5mm": 1.0,
        "f1_at_1mm": 1.0,
        "f1_at_2mm": 1.0,
        "completeness": 1.0,
        "glass_recall": 1.0,
        "glass_precision": 1.0,
    }


def test_f1_counts_claimed_cells_and_all_cells() -> None:
    real = truth([[0, 0, 0, 0]], [[0, 0, 0, 0]])
    found = scoring.score(np.array([[0.0, 0.7, 5.0, NAN]]), None, real)
    assert found["completeness"] == 0.75
    assert found["f1_at_0p5mm"] == pytest.approx(2 * (1 / 3) * (1 / 4) / (1 / 3 + 1 / 4))
    assert found["f1_at_1mm"] == pytest.approx(2 * (2 / 3) * (2 / 4) / (2 / 3 + 2 / 4))
    assert found["rmse_mm"] == pytest.approx(np.sqrt((0.49 + 25) / 3))


def test_a_cell_on_the_tolerance_is_correct() -> None:
    found = scoring.score(np.array([[1.0]]), None, truth([[0]], [[0]]))
    assert found["f1_at_1mm"] == 1.0
    assert found["f1_at_0p5mm"] == 0.0


def test_a_map_that_claims_nothing_scores_nothing_and_divides_by_nothing() -> None:
    found = scoring.score(np.array([[NAN, NAN]]), np.array([[0, 0]]), truth([[0, 0]], [[0, 1]]))
    assert found["rmse_mm"] is None
    assert found["f1_at_1mm"] == 0.0
    assert found["glass_recall"] == 0.0
    assert found["glass_precision"] is None


def test_glass_recall_and_precision() -> None:
    real = truth([[0, 30, 30, 0]], [[0, 1, 1, 0]])
    found = scoring.score(real["front_mm"], np.array([[2, 2, 1, 1]]), real)
    assert found["glass_recall"] == 0.5
    assert found["glass_precision"] == 0.5


def test_scores_among_some_cells_leave_the_others_out() -> None:
    real = truth([[0, 0, 10, 10]], [[0, 0, 0, 0]])
    flat = scoring.away_from_edges(real["front_mm"])
    assert flat.tolist() == [[True, False, False, True]]
    assert scoring.score(np.array([[0.0, 9.0, NAN, 10.0]]), None, real, flat)["f1_at_0p5mm"] == 1.0


def test_the_truth_is_cut_to_the_field_of_the_map() -> None:
    front = np.arange(36.0).reshape(6, 6)
    material = np.full((6, 6), scoring.GLASS)
    cut = scoring.cut(front, material, -3.0, -3.0, 1.0, MapField(x_mm=(-1.0, 2.0), y_mm=(-2.0, 0.0), cell_mm=1.0))
    np.testing.assert_array_equal(cut["front_mm"], front[1:3, 2:5])
    assert cut["glass"].all()


@pytest.mark.parametrize(
    "field",
    [
        MapField(x_mm=(-1.0, 2.0), y_mm=(-2.0, 0.0), cell_mm=0.5),
        MapField(x_mm=(-1.5, 1.5), y_mm=(-2.0, 0.0), cell_mm=1.0),
        MapField(x_mm=(-9.0, 2.0), y_mm=(-2.0, 0.0), cell_mm=1.0),
    ],
)
def test_a_truth_on_another_raster_or_too_small_is_refused(field: MapField) -> None:
    with pytest.raises(ValueError, match=r"raster|beyond"):
        scoring.cut(np.zeros((6, 6)), np.zeros((6, 6), dtype=int), -3.0, -3.0, 1.0, field)


def test_shapes_that_differ_are_refused() -> None:
    with pytest.raises(ValueError, match="expected shape"):
        scoring.score(np.zeros((2, 2)), None, truth([[0]], [[0]]))
