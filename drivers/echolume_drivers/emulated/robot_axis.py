"""One emulated CANopen axis: NMT, heartbeats, emergency, PDOs, and a CiA 402 drive with modes 1, 6 and 8.

Time is handed in as `time.monotonic` seconds; only motion runs `speed` times faster, heartbeats do not.
"""

from __future__ import annotations

import struct
from typing import Final, TypeAlias

from echolume_drivers.emulated.axis_objects import ObjectDictionary
from echolume_drivers.emulated.cia402 import (
    CHANGE_AT_ONCE,
    NEW_SET_POINT,
    RELATIVE,
    Command,
    State,
    command,
    step,
)
from echolume_drivers.emulated.motion_profile import Trapezoid

Frame: TypeAlias = tuple[int, bytes]

PRE_OPERATIONAL: Final = 0x7F
OPERATIONAL: Final = 0x05
STOPPED: Final = 0x04
HEARTBEAT_LOST: Final = 0x8130
FOLLOWING_ERROR: Final = 0x8611
PROFILE_POSITION, HOMING, CYCLIC_POSITION = 1, 6, 8


class Axis:
    """Everything behind one node number; the caller's thread owns it, `position` may be read from any."""

    def __init__(self, node_id: int, speed: float, start: int, limits: tuple[int, int]) -> None:
        self.node_id = node_id
        self.objects = ObjectDictionary(node_id, self._live, self._written)
        self.objects.values[0x607D, 1], self.objects.values[0x607D, 2] = limits
        self._speed = speed
        self._motion: tuple[Trapezoid, float] = (Trapezoid(start, start, 1.0, 1.0), 0.0)
        self._now_s = 0.0
        self.frozen_heartbeat = self.stuck = self.dead = False
        self.lost_tpdos = 0
        self._boot()

    def _boot(self) -> None:
        self.nmt = PRE_OPERATIONAL
        self.state = State.SWITCH_ON_DISABLED
        self._controlword = 0
        self._acknowledged = self._limited = False
        self._next: int | None = None
        self._after_stop: State | None = None
        self._master_s: float | None = None
        self._beat_s = 0.0
        self._event_s = 0.0
        self._sent_status: int | None = None
        self._out: list[Frame] = [(0x700 + self.node_id, b"\0")]

    # --- motion ----------------------------------------------------------------------------------------------

    def position(self, now_s: float) -> float:
        """Actual position in counts."""
        profile, begin_s = self._motion
        return profile.start if self.stuck else profile.position((now_s - begin_s) * self._speed)

    def _end_s(self) -> float:
        profile, begin_s = self._motion
        return begin_s + profile.duration_s / self._speed

    def _moving(self) -> bool:
        return self._now_s < self._end_s()

    def _go(self, target: float) -> None:
        low, high = self.objects.values[0x607D, 1], self.objects.values[0x607D, 2]
        self._limited = not low <= target <= high
        target = min(max(target, low), high)
        cruise = float(max(1, self.objects.values[0x6081, 0]))
        ramp = float(max(1, self.objects.values[0x6083, 0]))
        profile, begin_s = self._motion
        here = self.position(self._now_s)
        speed = profile.speed((self._now_s - begin_s) * self._speed)
        ahead = (target - here) * profile.direction
        if speed > 0 and ahead < speed**2 / (2 * ramp):
            self._brake(ramp)
            self._next = round(target)
            return
        self._motion = (Trapezoid(here, target, cruise, ramp, speed), self._now_s)

    def _brake(self, ramp: float) -> None:
        profile, begin_s = self._motion
        here = self.position(self._now_s)
        speed = profile.speed((self._now_s - begin_s) * self._speed)
        end = here + profile.direction * speed**2 / (2 * ramp)
        self._motion = (Trapezoid(here, end, max(speed, 1.0), ramp, speed), self._now_s)
        self._next = None

    # --- drive -----------------------------------------------------------------------------------------------

    def statusword(self) -> int:
        """0x6041 as it is now."""
        still = not self._moving() and self._next is None
        word = self.state.value | 0x0200 | 0x0010
        word |= 0x0400 if still else 0
        word |= 0x0800 if self._limited else 0
        mode = self.objects.values[0x6060, 0]
        homed = mode == HOMING and still and bool(self._controlword & NEW_SET_POINT)
        word |= 0x1000 if homed or (mode != HOMING and self._acknowledged) else 0
        if self.objects.values[0x603F, 0] == FOLLOWING_ERROR:
            word |= 0x2000
        return word

    def _control(self, word: int) -> None:
        before, self._controlword = self._controlword, word
        asked = command(word, before)
        was, self.state = self.state, step(self.state, asked)
        if asked is Command.FAULT_RESET and was is State.FAULT:
            self.objects.values[0x603F, 0] = self.objects.values[0x1001, 0] = 0
            self.stuck = False
            self._out.append((0x80 + self.node_id, bytes(8)))
        if was is State.OPERATION_ENABLED and self.state is not was:
            self._leave_operation()
        if self.state is State.OPERATION_ENABLED and self.objects.values[0x6060, 0] != CYCLIC_POSITION:
            self._set_point(word, before)

    def _leave_operation(self) -> None:
        self._brake(float(self.objects.values[0x6085, 0]))
        self._acknowledged = False
        if self.state is State.QUICK_STOP_ACTIVE and self.objects.values[0x605A, 0] in (1, 2):
            self._after_stop = State.SWITCH_ON_DISABLED

    def _set_point(self, word: int, before: int) -> None:
        if not word & NEW_SET_POINT:
            self._acknowledged = False
        elif not before & NEW_SET_POINT:
            mode = self.objects.values[0x6060, 0]
            target = 0 if mode == HOMING else self.objects.values[0x607A, 0]
            if word & RELATIVE and mode == PROFILE_POSITION:
                target += round(self._motion[0].end)
            if self._moving() and not word & CHANGE_AT_ONCE:
                self._next = target
            else:
                self._next = None
                self._go(target)
            self._acknowledged = mode == PROFILE_POSITION

    def fault(self, code: int, register: int = 0x01) -> None:
        """Emergency message, braking, then the state FAULT."""
        self.objects.values[0x603F, 0], self.objects.values[0x1001, 0] = code, register
        self._out.append((0x80 + self.node_id, struct.pack("<HB5x", code, register)))
        self._brake(float(self.objects.values[0x6085, 0]))
        self.state, self._after_stop = State.FAULT_REACTION_ACTIVE, State.FAULT

    def _live(self, index: int) -> int | None:
        if index == 0x6041:
            return self.statusword()
        if index == 0x6064:
            return round(self.position(self._now_s))
        if index == 0x606C:
            profile, begin_s = self._motion
            return round(profile.direction * profile.speed((self._now_s - begin_s) * self._speed))
        if index == 0x60F4:
            return round(self._lag())
        return self.objects.values[0x6060, 0] if index == 0x6061 else None

    def _lag(self) -> float:
        profile, begin_s = self._motion
        demand = profile.position((self._now_s - begin_s) * self._speed)
        return demand - self.position(self._now_s)

    def _written(self, index: int, sub: int, value: int) -> None:
        del sub
        if index == 0x6040:
            self._control(value)
        elif index == 0x1016:
            self._master_s = None
        elif index == 0x607A and self.objects.values[0x6060, 0] == CYCLIC_POSITION:
            self._follow(value)

    def _follow(self, target: int) -> None:
        if self.state is not State.OPERATION_ENABLED:
            return
        here = self.position(self._now_s)
        if abs(target - here) > self.objects.values[0x6065, 0]:
            self.fault(FOLLOWING_ERROR, 0x21)
        else:
            self._motion = (Trapezoid(target, target, 1.0, 1.0), self._now_s)

    # --- network ---------------------------------------------------------------------------------------------

    def restart(self) -> list[Frame]:
        """The node boots: power stage off, PRE-OPERATIONAL, mappings and heartbeat times forgotten."""
        here = self.position(self._now_s)
        limits = self.objects.values[0x607D, 1], self.objects.values[0x607D, 2]
        self.objects = ObjectDictionary(self.node_id, self._live, self._written)
        self.objects.values[0x607D, 1], self.objects.values[0x607D, 2] = limits
        self._motion = (Trapezoid(here, here, 1.0, 1.0), 0.0)
        self._boot()
        return self._drain()

    def receive(self, cob_id: int, data: bytes, now_s: float) -> list[Frame]:
        """React to a frame on the bus."""
        self._now_s = now_s
        if self.dead:
            return []
        if cob_id == 0x000 and len(data) == 2 and data[1] in (0, self.node_id):
            self._network_command(data[0])
        elif cob_id == 0x600 + self.node_id and len(data) == 8:
            if data[0] >> 5 != 4:  # the client's abort wants no answer
                self._out.append((0x580 + self.node_id, self.objects.sdo(data)))
        elif cob_id == self.objects.values[0x1400, 1]:
            self._receive_pdo(data)
        elif cob_id == 0x700 + (self.objects.values[0x1016, 1] >> 16 & 0x7F):
            self._master_s = now_s
        self._settle()
        return self._drain()

    def _network_command(self, code: int) -> None:
        if code in (0x81, 0x82):
            self.restart()
            self._out = [(0x700 + self.node_id, b"\0")]
            return
        self.nmt = {0x01: OPERATIONAL, 0x02: STOPPED, 0x80: PRE_OPERATIONAL}.get(code, self.nmt)
        self._sent_status = None
        self._beat_s = 0.0

    def _receive_pdo(self, data: bytes) -> None:
        if self.nmt != OPERATIONAL:
            return
        values: list[tuple[int, int, bytes]] = []
        at = 0
        for k in range(self.objects.values[0x1600, 0]):
            entry = self.objects.values[0x1600, k + 1]
            size = (entry & 0xFF) // 8
            values.append((entry >> 16, entry >> 8 & 0xFF, data[at : at + size]))
            at += size
        if at > len(data):
            self._out.append((0x80 + self.node_id, struct.pack("<HB5x", 0x8210, 0x11)))
            return
        for index, sub, part in sorted(values, key=lambda value: value[0] == 0x6040):  # the controlword acts last
            self.objects.store(index, sub, part)

    def tick(self, now_s: float) -> list[Frame]:
        """Do what time alone brings: heartbeats, arrivals, watchdogs."""
        self._now_s = now_s
        if self.dead:
            return []
        self._watch_master()
        period_s = self.objects.values[0x1017, 0] / 1e3
        if period_s and now_s >= self._beat_s + period_s and not self.frozen_heartbeat:
            self._beat_s = now_s
            self._out.append((0x700 + self.node_id, bytes([self.nmt])))
        self._settle()
        return self._drain()

    def _watch_master(self) -> None:
        limit_s = (self.objects.values[0x1016, 1] & 0xFFFF) / 1e3
        if limit_s and self._master_s is not None and self._now_s > self._master_s + limit_s:
            self._master_s = None
            self.nmt = PRE_OPERATIONAL
            self.fault(HEARTBEAT_LOST, 0x11)

    def _settle(self) -> None:
        if self.stuck and abs(self._lag()) > self.objects.values[0x6065, 0] and self._after_stop is None:
            self.fault(FOLLOWING_ERROR, 0x21)
        if not self._moving():
            if self._after_stop is not None:
                self.state, self._after_stop = self._after_stop, None
            if self._next is not None and self.state is State.OPERATION_ENABLED:
                target, self._next = self._next, None
                self._go(target)
        self._report()

    def _report(self) -> None:
        link = self.objects.values[0x1800, 1]
        if self.nmt != OPERATIONAL or link & 0x8000_0000:
            return
        period_s = self.objects.values[0x1800, 5] / 1e3
        word = self.statusword()
        if word == self._sent_status and not (period_s and self._now_s >= self._event_s + period_s):
            return
        self._sent_status, self._event_s = word, self._now_s
        if self.lost_tpdos > 0:
            self.lost_tpdos -= 1
            return
        entries = [self.objects.values[0x1A00, k + 1] for k in range(self.objects.values[0x1A00, 0])]
        data = b"".join(self.objects.bytes_of(entry >> 16, entry >> 8 & 0xFF) for entry in entries)
        self._out.append((link & 0x7FF, data))

    def due_s(self) -> float:
        """When `tick` is needed next at the latest."""
        times = [self._now_s + 1.0]
        if self.stuck and self._moving():
            times.append(self._now_s + 0.001)
        if self._moving():
            times.append(self._end_s())
        if self.objects.values[0x1017, 0]:
            times.append(self._beat_s + self.objects.values[0x1017, 0] / 1e3)
        if self._master_s is not None:
            times.append(self._master_s + (self.objects.values[0x1016, 1] & 0xFFFF) / 1e3)
        if self.nmt == OPERATIONAL and self.objects.values[0x1800, 5]:
            times.append(self._event_s + self.objects.values[0x1800, 5] / 1e3)
        return min(times)

    def _drain(self) -> list[Frame]:
        out, self._out = self._out, []
        return out
