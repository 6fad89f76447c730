"""Fires the triggers of a scan through the services, and keeps its ledger."""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import cast

from echolume_daemon.body import Json
from echolume_daemon.ledger import Expected, Ledger
from echolume_messages.bus import Bus
from echolume_messages.errors import (
    ArchiveError,
    DeviceAbsentError,
    DeviceSilentError,
    EcholumeError,
    NoReplyError,
    ScanError,
)
from echolume_messages.plan import Step
from echolume_messages.rig import Rig
from echolume_messages.topics import CAMERA_LEFT, CAMERA_RIGHT, ECHOES, PASS_STREAMS

SERVICES_OF = {"snap": ("cameras",), "optical": ("guide", "cameras"), "ultrasonic": ("robot", "array")}
"""Services that a pass of a kind needs, besides the recorder."""
HELD_SHARE = 0.8
"""Unacknowledged records may fill this share of the journal; then the next trigger waits."""
HELD_LIMIT_S = 15.0
RECORDER_S = 2.0
READY_S = 8.0
DRAIN_S = 8.0
ERRORS_IN_A_ROW = 3
LOST_IN_A_ROW = 6
_log = logging.getLogger("echolume.acquisition")


class Interrupted(Exception):
    """The scan is to end now."""


@dataclass
class Acquisition:
    """One scan's way through the services.

    `gate` is called at every trigger boundary; it waits while the scan is paused and raises `Interrupted` when the
    scan is to end.
    """

    bus: Bus
    rig: Rig
    scan: str
    calibration: str
    ledger: Ledger
    gate: Callable[[], None]
    reopen: Callable[[], None] = lambda: None
    """Has the recorder open the archive again, after it was restarted."""
    changed: threading.Condition = field(default_factory=threading.Condition)
    durable_seq: dict[str, int] = field(default_factory=dict[str, int])
    _fired_s: dict[tuple[int, int], float] = field(default_factory=dict[tuple[int, int], float])
    _acknowledged: set[tuple[str, int, int, int]] = field(default_factory=set[tuple[str, int, int, int]])
    _recent: deque[tuple[int, int]] = field(default_factory=lambda: deque[tuple[int, int]](maxlen=8 * LOST_IN_A_ROW))
    _errors: int = 0
    _asked_s: float = 0.0
    _next_look_s: float = 0.0
    _recorder_heard_s: float = 0.0
    _recorder_error: str = ""

    # -- what the recorder says

    def durable(self, message: Json) -> None:
        """Take in a ``recorder/durable`` message."""
        if message.get("scan") != self.scan:
            return
        with self.changed:
            self._recorder_error = str(message.get("error") or "") or self._recorder_error
            self.durable_seq.update(cast("dict[str, int]", message.get("durable", {})))
            for topic, trigger, attempt, seq in cast("list[tuple[str, int, int, int]]", message.get("records", [])):
                record = (topic, trigger, attempt, seq)
                if record not in self._acknowledged:  # a restarted recorder says again what its archive holds
                    self._acknowledged.add(record)
                    self.ledger.durable(topic, trigger, attempt)
            self.changed.notify_all()

    # -- before the scan, and after a service came back

    def check(self, kinds: Iterable[str], wait_s: float | None = None) -> None:
        """Wait until every service that the passes need is alive and its devices are there (at most `READY_S`).

        Raises
        ------
        NoReplyError
            Services that are not running, by name.
        DeviceAbsentError
            Devices that are not there, each with its own error.
        """
        names = sorted({name for kind in kinds for name in SERVICES_OF[kind]} | {"recorder"})
        deadline_s = time.monotonic() + (READY_S if wait_s is None else wait_s)
        while True:
            dead = [name for name in names if name not in self.bus.alive()]
            ill = [] if dead else [text for name in names for text in self._ill(name)]
            if not dead and not ill:
                return
            if time.monotonic() > deadline_s:
                if dead:
                    raise NoReplyError(f"not running: {', '.join(dead)}; start them with `echolume serve NAME`")
                raise DeviceAbsentError("; ".join(ill))
            self.gate()
            with self.changed:
                self.changed.wait(0.1)

    def _ill(self, name: str) -> list[str]:
        devices = cast("dict[str, Json]", self._ask(name, "status", {}).get("devices", {}))
        return [f"{key}: {d.get('error')}" for key, d in devices.items() if d.get("state") == "absent"]

    def prepare(self, kind: str, *, begin: bool = False) -> None:
        """Bring the devices of a kind of pass to their starting state; `begin`: at the start of a scan."""
        for name in SERVICES_OF[kind]:
            if name == "guide" and not self._ask("guide", "status", {}).get("homed"):
                self._ask("guide", "home", {}, 90.0)
            elif name == "cameras" and (begin or self._ask("cameras", "status", {}).get("scan") != self.scan):
                self._ask("cameras", "begin", {"scan": self.scan, "calibration": self.calibration}, 20.0)
            elif name == "robot" and not self._ask("robot", "status", {}).get("enabled"):
                self._ask("robot", "enable", {}, 30.0)

    # -- the passes

    def run(self, steps: list[Step]) -> None:
        """Acquire steps; each failure only loses its own trigger, unless the device stays away."""
        self._recent.clear()
        for step in steps:
            self.gate()
            self._check_streak(step.kind)
            if self._recorder_error:
                self.watch_recorder()
            self._await_room(step)
            self._attempt(step)

    def drain(self, pass_name: str) -> list[Step]:
        """Wait until every fired record of a pass is durable or given up; returns the steps that are missing."""
        names = {s.trigger for s in self.ledger.steps if s.pass_name == pass_name}
        deadline_s = time.monotonic() + DRAIN_S
        before = -1
        while left := [e for e in self._open() if e.trigger in names]:
            self.gate()
            self._ask_for_missing()
            self.watch_recorder()
            if len(left) != before:
                before, deadline_s = len(left), time.monotonic() + DRAIN_S
            elif time.monotonic() > deadline_s:
                _log.warning("%s: given up after %.0f s: %s", pass_name, DRAIN_S, _named(left))
                self._lose(left)
            with self.changed:
                self.changed.wait(0.05)
        self._ask_for_missing(0.0)
        with self.changed:
            return self.ledger.missing(pass_name)

    def _check_streak(self, kind: str) -> None:
        """A device that takes its triggers and delivers nothing, time after time, is not worth waiting for."""
        if kind != "ultrasonic":
            self._ask_for_missing(1.0)
        for topic in PASS_STREAMS[kind]:
            with self.changed:
                waiting = self.ledger.open
                known = [fired for fired in self._recent if Expected(topic.name, *fired) not in waiting]
                silent = all(topic.name in self.ledger.lost_streams(*fired) for fired in known[-LOST_IN_A_ROW:])
            if silent and len(known) >= LOST_IN_A_ROW:
                raise DeviceSilentError(
                    f"{topic.name}: nothing came for the last {LOST_IN_A_ROW} triggers; is the device hung?"
                )

    def watch_recorder(self) -> None:
        """Fail as soon as the recorder's disk does; have a restarted recorder go on with the archive.

        Raises
        ------
        ArchiveError
            What the recorder says of its disk.
        """
        if self._recorder_error:
            raise ArchiveError(f"recorder: {self._recorder_error}")
        now_s = time.monotonic()
        if now_s < self._next_look_s:
            return
        self._next_look_s = now_s + 1.0
        try:
            archives = cast("Json", self._ask("recorder", "status", {}, 2.0).get("archives", {}))
            self._recorder_heard_s = time.monotonic()
            if self.scan not in archives:
                _log.warning("the recorder was restarted; it goes on with the archive of %s", self.scan)
                self.reopen()
        except NoReplyError as error:
            _log.warning("recorder: %s", error)

    def settle(self, timeout_s: float) -> None:
        """Wait until nothing is under way any more; what is left then stays open."""
        deadline_s = time.monotonic() + timeout_s
        while self._open() and time.monotonic() < deadline_s:
            self._ask_for_missing()
            with self.changed:
                self.changed.wait(0.05)

    def _attempt(self, step: Step) -> None:
        with self.changed:
            attempt = self.ledger.next_attempt(step.trigger)
            self.ledger.fired(step.trigger, attempt)
            self._fired_s[step.trigger, attempt] = time.monotonic()
            self._recent.append((step.trigger, attempt))
        try:
            if step.kind == "ultrasonic":
                self._ping(step, attempt)
            else:
                self._frame(step, attempt)
        except EcholumeError as error:
            self._lose(Expected(t.name, step.trigger, attempt) for t in PASS_STREAMS[step.kind])
            self.gate()
            self._errors += 1
            _log.warning("%s: trigger %d (attempt %d): %s", step.pass_name, step.trigger, attempt, error)
            if self._errors >= ERRORS_IN_A_ROW:
                raise
            self.check([step.kind])
            self.prepare(step.kind)
        else:
            self._errors = 0

    def _frame(self, step: Step, attempt: int) -> None:
        optical = step.guide_x_mm is not None
        body: Json = {
            "trigger": step.trigger,
            "pass": step.pass_name,
            "attempt": attempt,
            "exposure_s": step.exposure_s,
            "external": optical,
            "x_mm": step.guide_x_mm,
            "sigma_mm": self.rig.guide.position_sigma_mm,
            "laser_on": optical,
        }
        self._ask("cameras", "arm", body, 10.0)
        if not optical:
            return
        try:
            self._ask("guide", "expose", {"x_mm": step.guide_x_mm, "exposure_s": step.exposure_s}, 20.0)
        except EcholumeError:
            _quietly(self.bus, "cameras", "disarm")
            raise

    def _ping(self, step: Step, attempt: int) -> None:
        reached = self._ask("robot", "move", {"pose": step.pose}, 60.0)
        body: Json = {
            "scan": self.scan,
            "pass": step.pass_name,
            "trigger": step.trigger,
            "attempt": attempt,
            "robot_pose": reached["pose"],
            "pose_sigma_mm": reached["sigma_mm"],
            "calibration": self.calibration,
        }
        self._ask("array", "ping", body, 10.0)

    # -- back-pressure and losses

    def _await_room(self, step: Step) -> None:
        """Hold the trigger while what is not yet acknowledged fills most of the journal."""
        needed = sum(self._bytes(t.name) for t in PASS_STREAMS[step.kind])
        limit = HELD_SHARE * self.rig.bus.journal_mib * 2**20
        journal_s = self.rig.bus.journal_s
        deadline_s = time.monotonic() + HELD_LIMIT_S
        while waiting := self._open():
            held = sum(self._bytes(e.topic) for e in waiting)
            now_s = time.monotonic()
            ages_s = {e: now_s - self._fired_s.get((e.trigger, e.attempt), now_s) for e in waiting}
            if held + needed <= limit and max(ages_s.values()) <= HELD_SHARE * journal_s:
                return
            self._ask_for_missing()
            self.watch_recorder()
            if now_s - self._recorder_heard_s < RECORDER_S:
                # it listens, and no journal holds these any more: they can only be acquired again
                self._lose(e for e, age_s in ages_s.items() if age_s > journal_s + RECORDER_S)
            if now_s > deadline_s:
                raise ScanError(
                    f"recorder: acknowledged nothing of {_named(waiting)} for {HELD_LIMIT_S:.0f} s; is it running, "
                    "and is there room on its disk?"
                )
            self.gate()
            with self.changed:
                self.changed.wait(0.05)

    def _bytes(self, topic: str) -> int:
        cameras = self.rig.cameras
        sizes = {
            CAMERA_LEFT.name: cameras.left.width_px * cameras.left.height_px,
            CAMERA_RIGHT.name: cameras.right.width_px * cameras.right.height_px,
            ECHOES.name: 8 * self.rig.array.samples * 2,
        }
        return sizes[topic]

    def _open(self) -> frozenset[Expected]:
        with self.changed:
            return self.ledger.open

    def _lose(self, records: Iterable[Expected]) -> None:
        with self.changed:
            for topic, trigger, attempt in records:
                self.ledger.lost(topic, trigger, attempt)

    def _ask_for_missing(self, period_s: float = 0.2) -> None:
        """Learn from the cameras which frames will not come, if that is `period_s` ago."""
        now_s = time.monotonic()
        if now_s < self._asked_s + period_s:
            return
        self._asked_s = now_s
        if not any(step.kind != "ultrasonic" for step in self.ledger.steps):
            return
        try:
            status = self._ask("cameras", "status", {}, 2.0)
        except EcholumeError as error:
            _log.warning("cameras: %s", error)
            return
        if status.get("scan") != self.scan:
            return
        with self.changed:
            for topic, trigger, attempt in cast("list[tuple[str, int, int]]", status.get("missing", [])):
                self.ledger.lost(topic, trigger, attempt)
            for topic, trigger, attempt in cast("list[tuple[str, int, int]]", status.get("revoked", [])):
                self.ledger.revoked(topic, trigger, attempt)
            for name, kind, count in cast("list[tuple[str, str, int]]", status.get("counts", [])):
                if kind in ("duplicate", "extra"):
                    self.ledger.reported(name, kind, count)

    # -- commands

    def _ask(self, service: str, command: str, body: Json, timeout_s: float = 5.0) -> Json:
        return self.bus.request(service, command, body, timeout_s)


def make_safe(bus: Bus, kinds: Iterable[str], *, at_once: bool) -> None:
    """Laser off, trigger unit disarmed; `at_once`: stop guide and robot where they are. All side by side."""
    wanted = {name for kind in kinds for name in SERVICES_OF[kind]}
    commands = [("guide", "stop" if at_once else "laser_off"), ("cameras", "disarm")]
    if at_once:
        commands.append(("robot", "stop"))
    threads = [
        threading.Thread(target=_quietly, args=(bus, *pair), name=f"safe-{pair[0]}", daemon=True)
        for pair in commands
        if pair[0] in wanted
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(3.0)


def _quietly(bus: Bus, service: str, command: str) -> None:
    """A command whose failure changes nothing about what is done next; it is logged."""
    try:
        bus.request(service, command, {}, 2.0)
    except EcholumeError as error:
        _log.warning("%s.%s: %s", service, command, error)


def _named(records: Iterable[Expected]) -> str:
    """A few records by name."""
    found = sorted(records, key=lambda e: (e.trigger, e.topic))
    text = ", ".join(f"{e.topic} of trigger {e.trigger}" for e in found[:4])
    return text + (f" and {len(found) - 4} more" if len(found) > 4 else "")
