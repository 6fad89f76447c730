"""Trapezoids and the motion queue."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from echolume_drivers.emulated.grbl_planner import Planner
from echolume_drivers.emulated.motion_profile import Trapezoid

moves = st.builds(
    Trapezoid,
    start=st.floats(-500, 500),
    end=st.floats(-500, 500),
    cruise=st.floats(0.1, 500),
    acceleration=st.floats(1, 5000),
    entry=st.floats(0, 100),
    exit=st.floats(0, 100),
)


@given(moves)
def test_a_move_starts_and_ends_where_it_should(move: Trapezoid) -> None:
    assert move.position(-1.0) == move.start
    assert move.position(0.0) == move.start
    assert move.position(move.duration_s) == move.end
    assert move.position(move.duration_s + 1) == move.end


@given(moves, st.floats(0, 1))
def test_a_move_never_leaves_its_ends_nor_exceeds_its_speed(move: Trapezoid, part: float) -> None:
    t_s = part * move.duration_s
    low, high = sorted((move.start, move.end))
    assert low - 1e-6 <= move.position(t_s) <= high + 1e-6
    assert move.speed(t_s) <= move.cruise * (1 + 1e-9)


@given(moves)
def test_position_is_the_integral_of_speed(move: Trapezoid) -> None:
    n = 400
    dt_s = move.duration_s / n
    way = sum(move.speed((k + 0.5) * dt_s) for k in range(n)) * dt_s
    assert way == pytest.approx(abs(move.end - move.start), rel=0.02, abs=0.02)


def test_known_answer_of_a_trapezoid() -> None:
    move = Trapezoid(0, 100, cruise=50, acceleration=100)  # 0.5 s up, 1.5 s flat, 0.5 s down
    assert move.duration_s == pytest.approx(2.5)
    assert move.position(0.5) == pytest.approx(12.5)
    assert move.position(1.25) == pytest.approx(50)
    assert move.time_at(50) == pytest.approx(1.25)
    assert move.time_at(101) is None


def test_moves_in_one_direction_blend_and_a_reversal_stops() -> None:
    planner = Planner(1000, speed=1.0)
    planner.add(10, 50, False, 0.0)
    for x in (20, 30, 20):
        planner.add(x, 50, False, 0.0)
    first, second, third, fourth = planner.legs(0.0)
    assert first.profile.exit == 0.0  # it was running before the others came
    assert second.profile.exit == 50.0
    assert third.profile.exit == 0.0
    assert fourth.profile.direction == -1.0
    assert planner.position_mm(fourth.end_s + 1) == 20


def test_a_hold_brakes_on_the_ramp_and_keeps_the_rest() -> None:
    planner = Planner(1000, speed=1.0)
    planner.add(100, 100, False, 0.0)
    rest = planner.hold(0.5)
    here_mm = 5 + 100 * 0.4  # 0.1 s of acceleration, then 0.4 s at 100 mm/s
    assert planner.position_mm(planner.end_s + 1) == pytest.approx(here_mm + 100**2 / 2000)
    assert [move.end_mm for move in rest] == [100]
    assert math.isclose(planner.end_s, 0.6)


def test_speed_shortens_the_time_line_only() -> None:
    slow, fast = Planner(1000, speed=1.0), Planner(1000, speed=50.0)
    for planner in (slow, fast):
        planner.add(37, 60, False, 0.0)
    assert slow.end_s == pytest.approx(50 * fast.end_s)
    assert slow.position_mm(0.1) == pytest.approx(fast.position_mm(0.1 / 50))
