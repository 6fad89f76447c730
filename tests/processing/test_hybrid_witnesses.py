"""Tables of the triggers that cells rest on: known answers, and no order of arrival matters."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_messages.plan import MapField
from echolume_messages.types import NO_TRIGGER, OPTICAL_POINT, OpticalSource
from echolume_processing.hybrid.grid import accumulate
from echolume_processing.hybrid.witnesses import Witnesses, tabled

FIELD = MapField(x_mm=(0.0, 3.0), y_mm=(0.0, 2.0), cell_mm=1.0)
PAIRS = st.lists(
    st.tuples(st.integers(0, 11), st.one_of(st.integers(0, 20), st.integers(NO_TRIGGER - 3, NO_TRIGGER - 1)))
)


def table(pairs: list[tuple[int, int]], cells: int = 12) -> Witnesses:
    cell, trigger = (np.array([pair[k] for pair in pairs], dtype=np.int64) for k in (0, 1))
    return tabled(cell, trigger, cells)


def test_each_cell_has_its_triggers_once_and_in_order() -> None:
    found = table([(3, 7), (0, 9), (3, 2), (3, 7), (11, 0)])
    assert [found.of(k).tolist() for k in range(12)] == [[9], [], [], [2, 7], *[[]] * 7, [0]]
    assert (found.start.dtype, found.which.dtype) == (np.int64, np.uint32)
    assert (found.first[3], found.last[3], found.first[1], found.last[11]) == (2, 7, NO_TRIGGER, 0)


def test_without_a_table_no_cell_has_any() -> None:
    assert Witnesses().of(5).size == 0
    assert Witnesses().pairs().size == 0
    assert Witnesses().only(np.zeros(12, dtype=np.bool_)).start.size == 1


@settings(max_examples=60, deadline=None)
@given(PAIRS, st.randoms())
def test_the_table_is_that_of_the_pairs_in_any_order(pairs: list[tuple[int, int]], mix: object) -> None:
    found = table(pairs)
    shuffled = list(pairs)
    mix.shuffle(shuffled)  # type: ignore[attr-defined]
    assert {(int(line["cell"]), int(line["trigger"])) for line in found.pairs()} == set(pairs)
    for name in ("start", "which"):
        assert getattr(found, name).tobytes() == getattr(table(shuffled), name).tobytes()


@settings(max_examples=60, deadline=None)
@given(PAIRS, st.lists(st.integers(0, 11)), st.sets(st.integers(0, 11)))
def test_cells_can_be_taken_out_and_emptied(pairs: list[tuple[int, int]], some: list[int], kept: set[int]) -> None:
    found = table(pairs)
    taken = found.taken(np.array(some, dtype=np.int64))
    assert [taken.of(k).tolist() for k in range(len(some))] == [found.of(cell).tolist() for cell in some]
    emptied = found.only(np.isin(np.arange(12), list(kept)))
    assert [emptied.of(k).tolist() for k in range(12)] == [found.of(k).tolist() if k in kept else [] for k in range(12)]


def test_light_names_the_stripes_whose_points_count() -> None:
    points = np.zeros(5, dtype=OPTICAL_POINT)
    points["x_mm"], points["y_mm"] = [0.5, 0.6, 2.5, 9.0, 1.5], [0.5, 0.5, 1.5, 0.5, 0.5]
    points["z_mm"], points["source"] = [1.0, 2.0, 3.0, 4.0, np.nan], OpticalSource.STEREO
    triggers = np.array([4, 0, 8, 5, 6], dtype=np.uint32)
    grid = accumulate(points, FIELD, triggers)
    assert [grid.stripes.of(k).tolist() for k in range(6)] == [[0, 4], [], [], [], [], [8]]
    back = accumulate(points[::-1], FIELD, triggers[::-1])
    assert back.stripes.which.tobytes() == grid.stripes.which.tobytes()
    assert accumulate(points, FIELD).stripes.start.size == 1
