"""Grbl 1.1's error and alarm numbers in words, after the tables of its manual."""

from __future__ import annotations

ERRORS: dict[int, str] = {
    1: "a G-code word has no letter",
    2: "a number is missing or malformed",
    3: "unknown or unsupported $ command",
    4: "negative value where a positive one is needed",
    5: "homing is not enabled in the settings ($22)",
    6: "minimum step pulse time must be over 3 us",
    7: "EEPROM read failed; default values restored",
    8: "$ command refused: the controller is not idle",
    9: "G-code locked out during alarm or jog",
    10: "soft limits need homing enabled",
    11: "line too long; not executed",
    12: "setting exceeds the maximum step rate",
    13: "safety door open",
    14: "build info or start-up line too long",
    15: "jog target beyond the machine's travel",
    16: "jog command without '=' or with forbidden G-code",
    17: "laser mode needs a PWM output",
    20: "unsupported or invalid G-code",
    21: "two commands of one modal group in a line",
    22: "feed rate not set",
    23: "G-code number must be an integer",
    24: "two commands in a line both use the axis words",
    25: "a word is repeated in the line",
    26: "axis words missing",
    27: "line number out of range",
    28: "a P or L value is missing",
    29: "only the coordinate systems G54 to G59 exist",
    30: "G53 needs G0 or G1",
    31: "axis words without use under G80",
    32: "arc without axis words in its plane",
    33: "invalid motion target",
    34: "arc radius cannot be computed",
    35: "arc without offset in its plane",
    36: "unused words left in the line",
    37: "tool length offset on the wrong axis",
    38: "tool number too large",
}

ALARMS: dict[int, str] = {
    1: "hard limit switch hit: position is likely lost, home again",
    2: "soft limit: the target is beyond the machine's travel; position kept",
    3: "reset while in motion: position lost, home again",
    4: "probe not in its expected state before probing",
    5: "probe did not touch within its travel",
    6: "homing failed: reset during homing",
    7: "homing failed: safety door opened",
    8: "homing failed: the limit switch did not clear at pull-off",
    9: "homing failed: the limit switch was not found",
    10: "homing failed: the second switch of the dual axis was not found",
}


def error_words(code: int) -> str:
    """``error:20 (unsupported or invalid G-code)``."""
    return f"error:{code} ({ERRORS.get(code, 'not in the manual')})"


def alarm_words(code: int) -> str:
    """``ALARM:3 (reset while in motion: ...)``."""
    return f"ALARM:{code} ({ALARMS.get(code, 'not in the manual')})"
