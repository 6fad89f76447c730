"""The motion queue of the emulated Grbl board: trapezoids on a time line, read without a lock."""

from __future__ import annotations

import math
from dataclasses import dataclass

from echolume_drivers.emulated.motion_profile import Trapezoid

DEPTH = 15


@dataclass(frozen=True)
class Move:
    """A queued move in machine millimetres."""

    start_mm: float
    end_mm: float
    feed_mm_per_s: float
    rapid: bool

    @property
    def direction(self) -> float:
        """+1.0 or -1.0."""
        return 1.0 if self.end_mm >= self.start_mm else -1.0


@dataclass(frozen=True)
class Leg:
    """A move with its place on the time line (`time.monotonic` seconds)."""

    move: Move
    profile: Trapezoid
    start_s: float
    speed: float

    @property
    def end_s(self) -> float:
        """When it is done."""
        return self.start_s + self.profile.duration_s / self.speed

    def position_mm(self, now_s: float) -> float:
        """Where the axis is."""
        return self.profile.position((now_s - self.start_s) * self.speed)


class Planner:
    """Queue of up to `DEPTH` moves of one axis, blended at their joints.

    The moves that still wait are planned anew whenever one is added; the one in motion keeps its plan. All methods
    but the readers belong to the caller's lock.
    """

    def __init__(self, acceleration_mm_per_s2: float, speed: float) -> None:
        self.acceleration_mm_per_s2 = acceleration_mm_per_s2
        self._speed = speed
        self._track: tuple[float, tuple[Leg, ...]] = (0.0, ())

    def position_mm(self, now_s: float) -> float:
        """Machine position; safe from any thread."""
        rest_mm, legs = self._track
        for leg in legs:
            if now_s < leg.end_s:
                return leg.position_mm(now_s)
        return legs[-1].move.end_mm if legs else rest_mm

    def running(self, now_s: float) -> Leg | None:
        """The leg in motion; safe from any thread."""
        return next((leg for leg in self._track[1] if leg.start_s <= now_s < leg.end_s), None)

    def legs(self, now_s: float) -> list[Leg]:
        """Legs not finished yet; safe from any thread."""
        return [leg for leg in self._track[1] if now_s < leg.end_s]

    def leaves_s(self, low_mm: float, high_mm: float, now_s: float) -> float | None:
        """When the axis will pass `low_mm` downwards or `high_mm` upwards; None if it stays between."""
        for leg in self.legs(now_s):
            end_mm = leg.move.end_mm
            if not low_mm < end_mm < high_mm:
                at_s = leg.profile.time_at(low_mm if end_mm <= low_mm else high_mm)
                if at_s is not None:
                    return leg.start_s + at_s / self._speed
        return None

    @property
    def end_s(self) -> float:
        """When the queue will be empty; 0 when it is."""
        legs = self._track[1]
        return legs[-1].end_s if legs else 0.0

    @property
    def target_mm(self) -> float:
        """Where the last queued move ends."""
        rest_mm, legs = self._track
        return legs[-1].move.end_mm if legs else rest_mm

    def add(self, end_mm: float, feed_mm_per_s: float, rapid: bool, now_s: float) -> None:
        """Queue a move; one of no length vanishes."""
        legs = self.legs(now_s)
        start_mm = self.target_mm
        if start_mm == end_mm:
            return
        moving = [leg for leg in legs if leg.start_s <= now_s]
        moves = [leg.move for leg in legs if leg.start_s > now_s]
        moves.append(Move(start_mm, end_mm, feed_mm_per_s, rapid))
        begin_s = moving[-1].end_s if moving else now_s
        entry = moving[-1].profile.exit if moving else 0.0
        self._track = (start_mm, (*moving, *self._plan(moves, begin_s, entry)))

    def _plan(self, moves: list[Move], begin_s: float, entry: float) -> list[Leg]:
        exits = [0.0] * len(moves)
        for i in range(len(moves) - 2, -1, -1):
            after = moves[i + 1]
            if after.direction == moves[i].direction:
                reach = 2 * self.acceleration_mm_per_s2 * abs(after.end_mm - after.start_mm)
                exits[i] = min(moves[i].feed_mm_per_s, after.feed_mm_per_s, math.sqrt(exits[i + 1] ** 2 + reach))
        legs: list[Leg] = []
        for move, leave in zip(moves, exits, strict=True):
            reach = 2 * self.acceleration_mm_per_s2 * abs(move.end_mm - move.start_mm)
            leave = min(leave, math.sqrt(entry**2 + reach))
            profile = Trapezoid(
                move.start_mm, move.end_mm, move.feed_mm_per_s, self.acceleration_mm_per_s2, entry, leave
            )
            legs.append(Leg(move, profile, begin_s, self._speed))
            begin_s, entry = legs[-1].end_s, leave
        return legs

    def hold(self, now_s: float) -> list[Move]:
        """Brake to rest and take everything behind out of the queue; returns the moves to queue again."""
        legs = self.legs(now_s)
        if not legs:
            return []
        leg = legs[0]
        here_mm = leg.position_mm(now_s)
        speed = leg.profile.speed((now_s - leg.start_s) * self._speed)
        brake_mm = min(speed**2 / (2 * self.acceleration_mm_per_s2), abs(leg.move.end_mm - here_mm))
        rest_mm = here_mm + leg.move.direction * brake_mm
        move = Move(here_mm, rest_mm, leg.move.feed_mm_per_s, leg.move.rapid)
        profile = Trapezoid(here_mm, rest_mm, max(speed, 1e-9), self.acceleration_mm_per_s2, speed, 0.0)
        self._track = (rest_mm, (Leg(move, profile, now_s, self._speed),) if brake_mm > 0 else ())
        rest = [Move(rest_mm, leg.move.end_mm, leg.move.feed_mm_per_s, leg.move.rapid)]
        return rest + [later.move for later in legs[1:]]

    def stand(self, position_mm: float) -> None:
        """Empty the queue; the axis stands at `position_mm`."""
        self._track = (position_mm, ())
