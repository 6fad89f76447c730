"""The run states: the table is complete, closed, and refuses what it does not hold."""

from __future__ import annotations

import pytest

from echolume_daemon.states import COMMANDS, TABLE, Event, RunState, accepted, follow
from echolume_messages.errors import WrongStateError


@pytest.mark.parametrize(("row", "target"), TABLE.items(), ids=lambda value: str(value))
def test_each_row_leads_to_its_state(row: tuple[RunState, Event], target: RunState) -> None:
    assert follow(*row) is target


@pytest.mark.parametrize("state", RunState)
@pytest.mark.parametrize("event", Event)
def test_what_is_not_in_the_table_is_refused_and_names_what_is_taken(state: RunState, event: Event) -> None:
    if (state, event) in TABLE:
        return
    with pytest.raises(WrongStateError, match=f"cannot {event} while {state}") as caught:
        follow(state, event)
    for command in accepted(state) & COMMANDS:
        assert command in str(caught.value)


def reachable(start: RunState) -> set[RunState]:
    found, new = set(), {start}
    while new:
        found |= new
        new = {target for (state, _), target in TABLE.items() if state in new} - found
    return found


@pytest.mark.parametrize("state", RunState)
def test_every_state_is_reached_from_idle_and_leads_back_to_it(state: RunState) -> None:
    assert state in reachable(RunState.IDLE)
    assert RunState.IDLE in reachable(state)


@pytest.mark.parametrize("state", [s for s in RunState if s not in (RunState.IDLE, RunState.HALTING)])
def test_halt_is_taken_wherever_something_runs(state: RunState) -> None:
    assert follow(state, Event.HALT) is RunState.HALTING


@pytest.mark.parametrize("state", [s for s in RunState if s is not RunState.IDLE])
def test_a_failure_can_be_reported_wherever_a_scan_is_under_way(state: RunState) -> None:
    assert follow(state, Event.FAIL) is RunState.FAULT
