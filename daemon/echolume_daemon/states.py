"""The run states of a scan, as a table."""

from __future__ import annotations

from enum import StrEnum

from echolume_messages.errors import WrongStateError


class RunState(StrEnum):
    """Where the conductor stands."""

    IDLE = "idle"
    ARMING = "arming"
    RUNNING = "running"
    PAUSED = "paused"
    STOPPING = "stopping"
    ABORTING = "aborting"
    HALTING = "halting"
    FAULT = "fault"


class Event(StrEnum):
    """What moves it: commands of the operator, and what the worker reports."""

    START = "start"
    PAUSE = "pause"
    RESUME = "resume"
    ABORT = "abort"
    HALT = "halt"
    ARMED = "armed"
    REFUSED = "refused"
    PROMPT = "prompt"
    DONE = "done"
    FAIL = "fail"
    CLOSED = "closed"


COMMANDS = frozenset({Event.START, Event.PAUSE, Event.RESUME, Event.ABORT, Event.HALT})
"""Events that an operator sends; the others come from the conductor's own worker."""

_S, _E = RunState, Event

TABLE: dict[tuple[RunState, Event], RunState] = {
    (_S.IDLE, _E.START): _S.ARMING,
    (_S.ARMING, _E.ARMED): _S.RUNNING,
    (_S.ARMING, _E.REFUSED): _S.IDLE,
    (_S.ARMING, _E.ABORT): _S.ABORTING,
    (_S.ARMING, _E.HALT): _S.HALTING,
    (_S.ARMING, _E.FAIL): _S.FAULT,
    (_S.RUNNING, _E.PAUSE): _S.PAUSED,
    (_S.RUNNING, _E.PROMPT): _S.PAUSED,
    (_S.RUNNING, _E.DONE): _S.STOPPING,
    (_S.RUNNING, _E.ABORT): _S.ABORTING,
    (_S.RUNNING, _E.HALT): _S.HALTING,
    (_S.RUNNING, _E.FAIL): _S.FAULT,
    (_S.PAUSED, _E.PROMPT): _S.PAUSED,
    (_S.PAUSED, _E.RESUME): _S.RUNNING,
    (_S.PAUSED, _E.DONE): _S.STOPPING,
    (_S.PAUSED, _E.ABORT): _S.ABORTING,
    (_S.PAUSED, _E.HALT): _S.HALTING,
    (_S.PAUSED, _E.FAIL): _S.FAULT,
    (_S.STOPPING, _E.HALT): _S.HALTING,
    (_S.STOPPING, _E.FAIL): _S.FAULT,
    (_S.STOPPING, _E.CLOSED): _S.IDLE,
    (_S.ABORTING, _E.HALT): _S.HALTING,
    (_S.ABORTING, _E.FAIL): _S.FAULT,
    (_S.ABORTING, _E.CLOSED): _S.IDLE,
    (_S.HALTING, _E.FAIL): _S.FAULT,
    (_S.HALTING, _E.CLOSED): _S.IDLE,
    (_S.FAULT, _E.HALT): _S.HALTING,
    (_S.FAULT, _E.FAIL): _S.FAULT,
    (_S.FAULT, _E.CLOSED): _S.IDLE,
}
"""(state, event) -> next state. What is not here is refused."""


def accepted(state: RunState) -> frozenset[Event]:
    """Events that `state` takes."""
    return frozenset(event for at, event in TABLE if at is state)


def follow(state: RunState, event: Event) -> RunState:
    """Next state.

    Raises
    ------
    WrongStateError
        The table has no such row; the message names the commands that the state takes.
    """
    try:
        return TABLE[state, event]
    except KeyError:
        choices = ", ".join(sorted(accepted(state) & COMMANDS)) or "none"
        raise WrongStateError(f"conductor: cannot {event} while {state}; commands taken now: {choices}") from None
