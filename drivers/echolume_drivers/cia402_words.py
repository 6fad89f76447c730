"""CiA 402's statusword and error codes as the master reads them."""

from __future__ import annotations

from enum import Enum
from typing import Final


class DriveState(Enum):
    """State of a drive."""

    NOT_READY_TO_SWITCH_ON = "not ready to switch on"
    SWITCH_ON_DISABLED = "switch on disabled"
    READY_TO_SWITCH_ON = "ready to switch on"
    SWITCHED_ON = "switched on"
    OPERATION_ENABLED = "operation enabled"
    QUICK_STOP_ACTIVE = "quick stop active"
    FAULT_REACTION_ACTIVE = "fault reaction active"
    FAULT = "fault"


# Statusword under a mask, after the table of CiA 402: bit 5 (quick stop) counts only where the power stage is in play.
_MASKS: Final = (
    (0x4F, 0x00, DriveState.NOT_READY_TO_SWITCH_ON),
    (0x4F, 0x40, DriveState.SWITCH_ON_DISABLED),
    (0x6F, 0x21, DriveState.READY_TO_SWITCH_ON),
    (0x6F, 0x23, DriveState.SWITCHED_ON),
    (0x6F, 0x27, DriveState.OPERATION_ENABLED),
    (0x6F, 0x07, DriveState.QUICK_STOP_ACTIVE),
    (0x4F, 0x0F, DriveState.FAULT_REACTION_ACTIVE),
    (0x4F, 0x08, DriveState.FAULT),
)

TARGET_REACHED: Final = 0x0400
SET_POINT_ACKNOWLEDGED: Final = 0x1000

SHUTDOWN: Final = 0x06
SWITCH_ON: Final = 0x07
ENABLE: Final = 0x0F
DISABLE_VOLTAGE: Final = 0x00
QUICK_STOP: Final = 0x02
FAULT_RESET: Final = 0x80
NEW_SET_POINT_NOW: Final = 0x3F
"""Enabled, bit 4 new set-point, bit 5 change at once."""

NEXT_CONTROLWORD: Final[dict[DriveState, int]] = {
    DriveState.SWITCH_ON_DISABLED: SHUTDOWN,
    DriveState.READY_TO_SWITCH_ON: SWITCH_ON,
    DriveState.SWITCHED_ON: ENABLE,
    DriveState.QUICK_STOP_ACTIVE: DISABLE_VOLTAGE,
}
"""What brings a drive one step nearer to OPERATION ENABLED."""

ERROR_CODES: Final[dict[int, str]] = {
    0x2310: "continuous over-current",
    0x2320: "short circuit or earth leakage",
    0x3110: "mains over-voltage",
    0x3120: "mains under-voltage",
    0x3210: "DC link over-voltage",
    0x3220: "DC link under-voltage",
    0x4210: "device too hot",
    0x4310: "drive too hot",
    0x5113: "control supply too low",
    0x5441: "emergency stop input",
    0x6010: "software watchdog",
    0x6320: "parameter error",
    0x7121: "motor blocked",
    0x7305: "encoder fault",
    0x7500: "communication fault",
    0x8110: "CAN overrun",
    0x8120: "CAN error passive",
    0x8130: "the master's heartbeat was missing",
    0x8210: "PDO too short",
    0x8611: "following error: the axis does not follow its target",
    0x8612: "position limit",
}


def drive_state(statusword: int) -> DriveState:
    """State in a statusword; an unlisted pattern counts as not ready."""
    found = (state for mask, value, state in _MASKS if statusword & mask == value)
    return next(found, DriveState.NOT_READY_TO_SWITCH_ON)


def error_words(code: int) -> str:
    """``0x8611 (following error: ...)``."""
    return f"0x{code:04X} ({ERROR_CODES.get(code, 'see the drive manual')})"
