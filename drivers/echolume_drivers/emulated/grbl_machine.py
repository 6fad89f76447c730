"""The inside of the emulated Grbl 1.1 board: states, settings, modal words, limits and the laser's logic.

The board drives one axis. `machine` positions are the board's own count; the guide truly stands at
``x_mm = machine + offset``, and homing makes the offset ``x_home_mm``. With ``x_home_mm=155`` the machine range is
that of a stock board (-310 to 0); the default of 0 is a board built to count from the middle of the guide.

Laser mode (``$32=1``) follows the firmware: M4 is dark at rest; M3 is lit at rest only while the modal motion is G1
to G3, and dark during G0. So a step-and-shoot exposure is ``G1 ..``, ``G4``, ``M3 S``, ``G4``, ``M5``.
"""

from __future__ import annotations

import threading
import time
from typing import Final

from echolume_drivers.emulated.grbl_parser import LINE_LIMIT, Block, GrblError, parse, strip
from echolume_drivers.emulated.grbl_planner import DEPTH, Move, Planner
from echolume_drivers.emulated.grbl_settings import DEFAULTS, change, listing

SWITCH_MM: Final = 156.0
"""Where the limit switches are, to either side of the guide's middle."""
LOST_MM: Final = 0.2
BANNER: Final = "\r\nGrbl 1.1h ['$' for help]"
UNLOCK: Final = "[MSG:'$H'|'$X' to unlock]"


class ResetDuringLine(Exception):
    """The line in execution was wiped out by a reset."""


class GrblMachine:
    """Executes lines (`execute`, blocking) and real-time commands (from any thread)."""

    def __init__(self, speed: float, x_home_mm: float, start_x_mm: float) -> None:
        self.changed = threading.Condition()
        self.settings = dict(DEFAULTS)
        self.planner = Planner(self.settings[120], speed)
        self.alarm: int | None = None
        self.homing_fails: int | None = None
        self.pending_says: list[str] | None = None
        """What an alarm raised inside a line wants to say."""
        self._speed = speed
        self._x_home_mm = x_home_mm
        self._offset_mm = start_x_mm
        self._generation = 0
        self._critical = False
        self._locked = True
        self._homing = False
        self._jogging = False
        self._held: list[Move] | None = None
        self._work_mm = 0.0
        self._modal()

    def _modal(self) -> None:
        self._motion, self._absolute, self._inches = 0, True, False
        self._spindle, self._power, self._feed_mm_per_min = 5, 0.0, 0.0

    # --- what the rest of the rig sees -----------------------------------------------------------------------

    def x_mm(self) -> float:
        """True position of the guide."""
        with self.changed:
            return self.planner.position_mm(time.monotonic()) + self._offset_mm

    def laser_demand(self, now_s: float) -> bool:
        """Whether the board's laser-enable output is on."""
        if self._locked or self._held is not None or self._spindle == 5 or self._power <= 0:
            return False
        if not self.settings[32]:
            return True
        leg = self.planner.running(now_s)
        if leg is not None:
            return not leg.move.rapid
        return self._spindle == 3 and self._motion == 1

    def next_event_s(self, now_s: float) -> float | None:
        """When `poll` should be called next at the latest; None if nothing is under way."""
        legs = self.planner.legs(now_s)
        if not legs:
            return None
        times = [edge for leg in legs for edge in (leg.start_s, leg.end_s) if edge > now_s]
        hit_s = self._limit_hit_s(now_s)
        return min(times if hit_s is None else [*times, hit_s])

    def poll(self, now_s: float) -> list[str]:
        """Watch the limit switches; returns what the board says unasked."""
        with self.changed:
            hit_s = self._limit_hit_s(now_s)
            if hit_s is None or now_s < hit_s:
                return []
            return self._crash(1, hit_s)

    def _limit_hit_s(self, now_s: float) -> float | None:
        if not self.settings[21] or self._homing:
            return None
        return self.planner.leaves_s(-SWITCH_MM - self._offset_mm, SWITCH_MM - self._offset_mm, now_s)

    # --- real-time commands ----------------------------------------------------------------------------------

    def trip(self, code: int) -> list[str]:
        """Raise an alarm from outside; returns what the board says."""
        with self.changed:
            return self._crash(code, time.monotonic())

    def _crash(self, code: int, now_s: float) -> list[str]:
        self._stand(now_s, lost_mm=LOST_MM if code == 1 else 0.0)
        self._held, self._locked, self.alarm = None, True, code
        self._spindle, self._power = 5, 0.0
        self._critical = code in (1, 2)
        self._wipe()
        return [f"ALARM:{code}", "[MSG:Reset to continue]" if self._critical else UNLOCK]

    def _stand(self, now_s: float, lost_mm: float) -> None:
        """Cut the motion; a motor stopped at speed loses steps, so the board's count is off by `lost_mm`."""
        self.planner.stand(self.planner.position_mm(now_s) - lost_mm)
        self._offset_mm += lost_mm

    def _wipe(self) -> None:
        self._generation += 1
        self.changed.notify_all()

    def hold(self) -> None:
        """Feed hold ``!``: brake, then wait; the laser is off until resume."""
        with self.changed:
            if not self._locked and self._held is None:
                self._held = self.planner.hold(time.monotonic())
                if self._jogging:
                    self._held, self._jogging = None, False
                self.changed.notify_all()

    def resume(self) -> None:
        """Cycle start ``~``."""
        with self.changed:
            now_s = time.monotonic()
            if self._held is not None and now_s >= self.planner.end_s:
                held, self._held = self._held, None
                for move in held:
                    self.planner.add(move.end_mm, move.feed_mm_per_s, move.rapid, now_s)
                self.changed.notify_all()

    def soft_reset(self) -> list[str]:
        """0x18: position is kept unless the axis was moving."""
        with self.changed:
            now_s = time.monotonic()
            said: list[str] = []
            lost_mm = 0.0
            if self._homing:
                self.alarm, self._locked = 6, True
                said = ["ALARM:6"]
            elif self.planner.running(now_s) is not None:
                self.alarm, self._locked = 3, True
                lost_mm = LOST_MM
                said = ["ALARM:3"]
            self._stand(now_s, lost_mm)
            self._homing = self._critical = self._jogging = False
            self._held = None
            self._modal()
            self._wipe()
            return [*said, BANNER, *([UNLOCK] if self._locked else [])]

    def power_on(self) -> list[str]:
        """A restart of the whole board (opening the port does this to an Uno): the position is forgotten."""
        with self.changed:
            x_mm = self.x_mm()
            self.planner.stand(0.0)
            self._offset_mm = x_mm
            self.alarm, self._locked = None, bool(self.settings[22])
            self._homing = self._critical = self._jogging = False
            self._held = None
            self._modal()
            self._wipe()
            return [BANNER, *([UNLOCK] if self._locked else [])]

    def status(self) -> str | None:
        """The answer to ``?``; None when the board does not answer (homing, or waiting for a reset)."""
        if self._critical or self._homing:
            return None
        now_s = time.monotonic()
        here_mm = self.planner.position_mm(now_s)
        leg = self.planner.running(now_s)
        speed = 0.0 if leg is None else leg.profile.speed((now_s - leg.start_s) * self._speed)
        return (
            f"<{self.state(now_s)}|{self._position_field(here_mm)}"
            f"|Bf:{DEPTH - len(self.planner.legs(now_s))},128|FS:{speed * 60:.0f},{self._power:.0f}"
            f"|WCO:{self._work_mm:.3f},0.000,0.000>"
        )

    def _position_field(self, here_mm: float) -> str:
        steps = self.settings[100]
        if int(self.settings[10]) & 1:
            return f"MPos:{round(here_mm * steps) / steps:.3f},0.000,0.000"
        return f"WPos:{round((here_mm - self._work_mm) * steps) / steps:.3f},0.000,0.000"

    def state(self, now_s: float) -> str:
        """The state's name in a status report."""
        if self._locked:
            return "Alarm"
        if self._held is not None:
            return "Hold:0" if now_s >= self.planner.end_s else "Hold:1"
        if self.planner.running(now_s) is not None:
            return "Jog" if self._jogging else "Run"
        return "Idle"

    # --- lines -----------------------------------------------------------------------------------------------

    def execute(self, line: str) -> list[str]:
        """Run one line and return its answer, ending in ``ok`` or ``error:n``; blocks as the board does.

        Raises
        ------
        ResetDuringLine
            When a reset or alarm wiped the line out: no answer is sent.
        """
        with self.changed:
            generation = self._generation
            if len(line) > LINE_LIMIT:
                return ["error:11"]
            try:
                text = strip(line)
                if text.startswith("$"):
                    said = self._system(text, generation)
                elif self._locked and text:
                    raise GrblError(9)
                else:
                    said = self._gcode(parse(text), generation)
            except GrblError as error:
                return [f"error:{error.code}"]
            self._alive(generation)
            return [*said, "ok"]

    def _alive(self, generation: int) -> None:
        if generation != self._generation:
            raise ResetDuringLine

    def _wait_motion(self, generation: int, room: int = 0) -> None:
        """Wait until at most `room` moves are queued and no hold is on."""
        while True:
            self._alive(generation)
            now_s = time.monotonic()
            legs = self.planner.legs(now_s)
            if self._held is None and len(legs) <= room:
                return
            timeout_s = None if self._held is not None else legs[len(legs) - room - 1].end_s - now_s
            self.changed.wait(timeout_s)

    def _dwell(self, dwell_s: float, generation: int) -> None:
        self._wait_motion(generation)
        left_s = dwell_s / self._speed
        while left_s > 0:
            self._alive(generation)
            begin_s = time.monotonic()
            if self._held is not None:
                self.changed.wait()
            else:
                self.changed.wait(left_s)
                left_s -= time.monotonic() - begin_s
        self._wait_motion(generation)

    def _gcode(self, block: Block, generation: int) -> list[str]:
        if block.units is not None:
            self._inches = block.units == 20
        if block.distance is not None:
            self._absolute = block.distance == 90
        unit_mm = 25.4 if self._inches else 1.0
        if block.feed is not None:
            self._feed_mm_per_min = block.feed * unit_mm
        motion = self._motion if block.motion is None else block.motion
        if block.motion == 1 and block.x is not None and self._feed_mm_per_min <= 0:
            raise GrblError(22)
        self._switch_spindle(block, motion, generation)
        if block.dwell_s is not None:
            self._motion = motion
            self._dwell(block.dwell_s, generation)
        elif block.once in (10, 92):
            self._set_work(block, unit_mm)
        else:
            self._move(block, motion, unit_mm, generation)
        if block.stop in (2, 30):
            self._wait_motion(generation)
            self._spindle, self._motion = 5, 1
        return []

    def _switch_spindle(self, block: Block, motion: int, generation: int) -> None:
        if block.spindle is None and (block.power is None or self._spindle == 5) and motion == self._motion:
            self._power = self._power if block.power is None else block.power
            return
        if block.spindle is not None or block.power is not None or self._spindle == 3:
            self._wait_motion(generation)
        self._motion = motion
        self._power = self._power if block.power is None else block.power
        self._spindle = self._spindle if block.spindle is None else block.spindle

    def _set_work(self, block: Block, unit_mm: float) -> None:
        if block.x is None:  # the other axes' offsets do not matter here
            return
        if block.once == 10 and block.l_value == 2:
            self._work_mm = block.x * unit_mm
        else:
            self._work_mm = self.planner.target_mm - block.x * unit_mm

    def _move(self, block: Block, motion: int, unit_mm: float, generation: int) -> None:
        self._motion = motion
        if block.x is None:
            return
        if block.once == 53:
            target_mm = block.x * unit_mm
        elif self._absolute:
            target_mm = block.x * unit_mm + self._work_mm
        else:
            target_mm = self.planner.target_mm + block.x * unit_mm
        rapid = motion == 0
        feed = self.settings[110] if rapid else min(self._feed_mm_per_min, self.settings[110])
        if self._beyond(target_mm):
            self._soft_alarm(generation)
        self._jogging = False
        self._queue(target_mm, feed, rapid, generation)

    def _queue(self, target_mm: float, feed_mm_per_min: float, rapid: bool, generation: int) -> None:
        self._wait_motion(generation, DEPTH - 1)
        steps = self.settings[100]
        self.planner.acceleration_mm_per_s2 = self.settings[120]
        self.planner.add(round(target_mm * steps) / steps, feed_mm_per_min / 60, rapid, time.monotonic())

    def _beyond(self, target_mm: float) -> bool:
        half_mm = self.settings[130] / 2
        return bool(self.settings[20]) and abs(target_mm + self._x_home_mm) > half_mm + 1e-9

    def _soft_alarm(self, generation: int) -> None:
        self._wait_motion(generation)
        self.pending_says = self._crash(2, time.monotonic())
        raise ResetDuringLine

    # --- $ commands ------------------------------------------------------------------------------------------

    def _system(self, text: str, generation: int) -> list[str]:
        if text.startswith("$J="):
            return self._jog(text[3:], generation)
        if text not in ("$", "$G") and (self._held is not None or self.planner.legs(time.monotonic())):
            raise GrblError(8)
        if text == "$H":
            return self._home(generation)
        if text == "$X":
            said = ["[MSG:Caution: Unlocked]"] if self._locked else []
            self._locked, self.alarm = False, None
            return said
        return self._report(text)

    def _report(self, text: str) -> list[str]:
        if text == "$":
            return ["[HLP:$$ $# $G $I $N $x=val $Nx=line $J=line $SLP $C $X $H ~ ! ? ctrl-x]"]
        if text == "$$":
            return listing(self.settings)
        if text == "$I":
            return ["[VER:1.1h.20190825:echolume-emulated]", "[OPT:V,15,128]"]
        if text == "$#":
            return [f"[G54:{self._work_mm:.3f},0.000,0.000]", "[G92:0.000,0.000,0.000]", "[TLO:0.000]"]
        if text == "$G":
            units, distance = (20 if self._inches else 21), (90 if self._absolute else 91)
            modes = f"G{self._motion} G54 G17 G{units} G{distance} G94 M{self._spindle} M9 T0"
            return [f"[GC:{modes} F{self._feed_mm_per_min:.0f} S{self._power:.0f}]"]
        change(text, self.settings)
        return []

    def _jog(self, text: str, generation: int) -> list[str]:
        if self._locked:
            raise GrblError(9)
        block = parse(text)
        if block.x is None or block.feed is None or block.motion is not None or block.spindle is not None:
            raise GrblError(16 if block.x is not None else 26)
        unit_mm = 25.4 if block.units == 20 or (block.units is None and self._inches) else 1.0
        relative = block.distance == 91 or (block.distance is None and not self._absolute)
        base_mm = self.planner.target_mm if relative else (0.0 if block.once == 53 else self._work_mm)
        target_mm = base_mm + block.x * unit_mm
        if self._beyond(target_mm):
            raise GrblError(15)
        self._jogging = True
        self._queue(target_mm, min(block.feed * unit_mm, self.settings[110]), True, generation)
        return []

    def _home(self, generation: int) -> list[str]:
        if not self.settings[22]:
            raise GrblError(5)
        self._homing, self._locked, self.alarm = True, False, None
        fails, self.homing_fails = self.homing_fails, None
        if fails is None:
            self._seek(SWITCH_MM - self._offset_mm, self.settings[25], generation)
            pull_off_mm = SWITCH_MM - self.settings[27]
            self._seek(pull_off_mm - self._offset_mm, self.settings[25], generation)
            self._offset_mm = self._x_home_mm
            self.planner.stand(pull_off_mm - self._x_home_mm)
        self._homing = False
        if fails is not None:
            self.pending_says = self._crash(fails, time.monotonic())
            raise ResetDuringLine
        return []

    def _seek(self, target_mm: float, feed_mm_per_min: float, generation: int) -> None:
        self.planner.add(target_mm, feed_mm_per_min / 60, True, time.monotonic())
        self._wait_motion(generation)
