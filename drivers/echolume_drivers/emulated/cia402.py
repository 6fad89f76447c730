"""The CiA 402 drive state machine as tables: states, commands, transitions."""

from __future__ import annotations

from enum import Enum, auto
from typing import Final


class State(Enum):
    """States of the drive; the value is the statusword under mask 0x6F."""

    NOT_READY_TO_SWITCH_ON = 0x00
    SWITCH_ON_DISABLED = 0x40
    READY_TO_SWITCH_ON = 0x21
    SWITCHED_ON = 0x23
    OPERATION_ENABLED = 0x27
    QUICK_STOP_ACTIVE = 0x07
    FAULT_REACTION_ACTIVE = 0x0F
    FAULT = 0x08


class Command(Enum):
    """What a controlword asks for."""

    SHUTDOWN = auto()
    SWITCH_ON = auto()
    ENABLE_OPERATION = auto()
    DISABLE_VOLTAGE = auto()
    QUICK_STOP = auto()
    FAULT_RESET = auto()


FAULT_RESET_BIT: Final = 0x80
NEW_SET_POINT: Final = 0x10
CHANGE_AT_ONCE: Final = 0x20
RELATIVE: Final = 0x40

S, C = State, Command
TRANSITIONS: Final[dict[tuple[State, Command], State]] = {
    (S.SWITCH_ON_DISABLED, C.SHUTDOWN): S.READY_TO_SWITCH_ON,  # transition 2
    (S.READY_TO_SWITCH_ON, C.SWITCH_ON): S.SWITCHED_ON,  # 3
    (S.READY_TO_SWITCH_ON, C.ENABLE_OPERATION): S.OPERATION_ENABLED,  # 3 and 4 in one
    (S.SWITCHED_ON, C.ENABLE_OPERATION): S.OPERATION_ENABLED,  # 4
    (S.OPERATION_ENABLED, C.SWITCH_ON): S.SWITCHED_ON,  # 5, disable operation
    (S.SWITCHED_ON, C.SHUTDOWN): S.READY_TO_SWITCH_ON,  # 6
    (S.READY_TO_SWITCH_ON, C.DISABLE_VOLTAGE): S.SWITCH_ON_DISABLED,  # 7
    (S.READY_TO_SWITCH_ON, C.QUICK_STOP): S.SWITCH_ON_DISABLED,  # 7
    (S.OPERATION_ENABLED, C.SHUTDOWN): S.READY_TO_SWITCH_ON,  # 8
    (S.OPERATION_ENABLED, C.DISABLE_VOLTAGE): S.SWITCH_ON_DISABLED,  # 9
    (S.SWITCHED_ON, C.DISABLE_VOLTAGE): S.SWITCH_ON_DISABLED,  # 10
    (S.SWITCHED_ON, C.QUICK_STOP): S.SWITCH_ON_DISABLED,  # 10
    (S.OPERATION_ENABLED, C.QUICK_STOP): S.QUICK_STOP_ACTIVE,  # 11
    (S.QUICK_STOP_ACTIVE, C.DISABLE_VOLTAGE): S.SWITCH_ON_DISABLED,  # 12
    (S.QUICK_STOP_ACTIVE, C.ENABLE_OPERATION): S.OPERATION_ENABLED,  # 16
    (S.FAULT, C.FAULT_RESET): S.SWITCH_ON_DISABLED,  # 15
}


def command(controlword: int, before: int) -> Command:
    """The command in a controlword; the fault reset is the rising edge of its bit."""
    if controlword & ~before & FAULT_RESET_BIT:
        return Command.FAULT_RESET
    if not controlword & 0x02:
        return Command.DISABLE_VOLTAGE
    if not controlword & 0x04:
        return Command.QUICK_STOP
    if not controlword & 0x01:
        return Command.SHUTDOWN
    return Command.ENABLE_OPERATION if controlword & 0x08 else Command.SWITCH_ON


def step(state: State, asked: Command) -> State:
    """The state after a command; unchanged where the standard has no transition."""
    return TRANSITIONS.get((state, asked), state)
