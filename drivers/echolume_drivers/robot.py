"""The gantry robot: six CiA 402 axes on CANopen, moved together in profile position mode.

Fail-safe: every axis watches the master's heartbeat (0x1016, read back at start), so when this program dies the axes
stop by themselves; the master watches theirs. The transport is never trusted for liveness: after a socketcand server
dies its client hears silence for ever.
"""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Callable, Sequence
from typing import Final, TypeAlias

import can
import canopen
import numpy as np
from numpy.typing import NDArray

from echolume_drivers import cia402_words as words
from echolume_drivers.cia402_words import DriveState
from echolume_drivers.robot_axis import MASTER_NODE, PRODUCE_MS, RobotAxis
from echolume_messages.errors import DeviceAbsentError, DeviceError, DeviceFaultError, DeviceSilentError
from echolume_messages.geometry import require_shape
from echolume_messages.rig import RobotSettings

Pose6: TypeAlias = NDArray[np.float64]

AXES: Final = ("x", "y", "z", "rx", "ry", "rz")
RAMP_S: Final = 0.2
"""Time from rest to full speed."""
PROFILE_POSITION: Final = 1
QUICK_STOP_RAMP: Final = 2
"""0x605A: brake on the quick stop ramp, then SWITCH ON DISABLED (brakes on)."""
IN_POSITION: Final = 0.05
"""Millimetres or degrees between target and counter at arrival."""
MARGIN_S: Final = 2.0
POLL_S: Final = 0.1
"""How long a status PDO may be missing before the axis is asked by SDO."""


class Cia402Robot:
    """Six axes as one pose; `quick_stop` and `pose` may be called from any thread."""

    def __init__(self, settings: RobotSettings) -> None:
        self._settings = settings
        self._where = f"robot ({settings.interface} {settings.host}:{settings.port} {settings.channel})"
        self._counts = np.array([settings.counts_per_mm] * 3 + [settings.counts_per_deg] * 3, dtype=np.float64)
        self._speeds = np.array([settings.speed_mm_per_s] * 3 + [settings.speed_deg_per_s] * 3, dtype=np.float64)
        self._news = threading.Condition()
        self._turn = threading.RLock()
        self._network: canopen.Network | None = None
        self._axes: list[RobotAxis] = []
        self._beating = threading.Event()
        self._heart: threading.Thread | None = None
        self._enabled = False

    # --- life ------------------------------------------------------------------------------------------------

    def open(self) -> None:
        """Join the bus and set up all six nodes; the drives stay without power.

        Raises
        ------
        DeviceError
            No bus, a node that does not answer, or one that refuses its configuration.
        """
        network = canopen.Network()
        network.NOTIFIER_CYCLE = 0.05
        network.bus = self._connect()
        network.connect()
        self._network = network
        try:
            self._beating.clear()
            self._heart = threading.Thread(target=self._beat, args=(network,), name="robot-heartbeat", daemon=True)
            self._heart.start()
            self._axes = [
                RobotAxis(network, node, f"robot axis {name} (node {node}, {self._settings.channel})", self._news)
                for name, node in zip(AXES, self._settings.nodes, strict=True)
            ]
            for axis in self._axes:
                self._command_network(network, 0x80, axis)
                axis.configure()
            for axis in self._axes:
                self._command_network(network, 0x01, axis)
                axis.supervise()
            self._wait(lambda: all(axis.is_operational for axis in self._axes), MARGIN_S, "to go OPERATIONAL")
        except DeviceError:
            self.close()
            raise

    def _connect(self) -> can.BusABC:
        settings = self._settings
        if settings.interface != "socketcand":
            try:
                return can.Bus(interface=settings.interface, channel=settings.channel)
            except (can.CanError, OSError) as error:
                raise DeviceAbsentError(f"{self._where}: cannot open the CAN interface: {error}") from error
        try:
            self._greet(settings.host, settings.port)
            return can.Bus(
                interface="socketcand", channel=settings.channel, host=settings.host, port=settings.port, tcp_tune=True
            )
        except (can.CanError, OSError) as error:
            raise DeviceAbsentError(f"{self._where}: no socketcand server: {error}. Is it running?") from error

    def _greet(self, host: str, port: int) -> None:
        """See that a socketcand server answers: python-can would wait for ever for its first word."""
        with socket.create_connection((host, port), 1.0) as probe:
            try:
                heard = probe.recv(256)
            except TimeoutError:
                heard = b""
        if not heard.startswith(b"< hi"):
            raise DeviceSilentError(
                f"{self._where}: expected the greeting '< hi >' of a socketcand server within 1 s, got {heard!r}; "
                "is the port in the rig file the right one?"
            )

    def _command_network(self, network: canopen.Network, code: int, axis: RobotAxis) -> None:
        try:
            network.send_message(0x000, bytes([code, axis.node_id]))
        except (can.CanError, OSError) as error:
            raise DeviceAbsentError(f"{self._where}: the bus is gone: {error}") from error

    def _beat(self, network: canopen.Network) -> None:
        while not self._beating.wait(PRODUCE_MS / 1e3):
            try:
                network.send_message(0x700 + MASTER_NODE, b"\x05")
            except (can.CanError, OSError):
                return  # whoever waits for the axes finds out by their silence

    def close(self) -> None:
        """Take the power off the drives and leave the bus."""
        network, self._network = self._network, None
        if network is None:
            return
        self._enabled = False
        try:
            for axis in self._axes:
                axis.send(words.DISABLE_VOLTAGE)
        except DeviceAbsentError:
            self._axes = []  # the drives stop by their own heartbeat watch
        self._beating.set()
        if self._heart is not None:
            self._heart.join(2.0)
        network.disconnect()
        self._axes = []

    # --- bring-up --------------------------------------------------------------------------------------------

    def enable(self) -> None:
        """Clear faults and bring all six drives to OPERATION ENABLED in profile position mode."""
        with self._turn:
            self._require_open()
            for k, axis in enumerate(self._axes):
                if not axis.is_operational or axis.trouble is not None:
                    self._recover(axis)
                self._set_motion(axis, k)
            deadline_s = time.monotonic() + MARGIN_S
            steps = [_BringUp(axis) for axis in self._axes]
            while [step for step in steps if not step.advance()]:
                if time.monotonic() > deadline_s:
                    raise self._late("to reach OPERATION ENABLED")
                with self._news:
                    self._news.wait(0.02)
            self._enabled = True

    def _recover(self, axis: RobotAxis) -> None:
        network = self._require_open()
        self._command_network(network, 0x80, axis)
        axis.configure()
        self._command_network(network, 0x01, axis)
        axis.supervise()

    def _set_motion(self, axis: RobotAxis, k: int) -> None:
        speed = round(float(self._speeds[k] * self._counts[k]))
        axis.write(0x6060, 0, "b", PROFILE_POSITION)
        axis.write(0x6081, 0, "I", speed)
        axis.write(0x6083, 0, "I", round(speed / RAMP_S))
        axis.write(0x6085, 0, "I", round(4 * speed / RAMP_S))
        axis.set(0x605A, 0, "h", QUICK_STOP_RAMP)
        if axis.read(0x6061, 0, "b") != PROFILE_POSITION:
            raise DeviceFaultError(f"{axis.where}: does not take profile position mode (0x6060)")

    # --- motion ----------------------------------------------------------------------------------------------

    def move(self, pose: Pose6 | Sequence[float]) -> Pose6:
        """Move all axes at once and wait until each has reached its target.

        Parameters
        ----------
        pose
            (6,): x, y, z in mm, rx, ry, rz in rad.

        Returns
        -------
        NDArray[np.float64]
            The pose reached (6,), mm and rad, from the drives' position counters.

        Raises
        ------
        DeviceError
            Not enabled, beyond a drive's limits, a fault on the way, or an axis that fell silent. The other axes
            are then stopped.
        """
        with self._turn:
            self._require_open()
            targets = self._targets(np.asarray(pose, dtype=np.float64))
            try:
                self._run(targets)
            except DeviceError:
                self.quick_stop()
                raise
            return self._pose()

    def _targets(self, pose: Pose6) -> list[int]:
        require_shape("pose", pose, (6,))
        if not self._enabled:
            raise DeviceFaultError(f"{self._where}: not enabled: enable the robot first")
        values = np.concatenate([pose[:3], np.degrees(pose[3:])])
        if not np.isfinite(values).all():
            raise DeviceFaultError(f"{self._where}: the pose {pose.tolist()} is not finite")
        for k, axis in enumerate(self._axes):
            count = values[k] * self._counts[k]
            if not axis.low <= count <= axis.high:
                low, high = axis.low / self._counts[k], axis.high / self._counts[k]
                unit = "mm" if k < 3 else "deg"
                raise DeviceFaultError(
                    f"{axis.where}: target {values[k]:.3f} {unit} is outside the drive's {low:g}..{high:g} (0x607D)"
                )
        return [round(float(count)) for count in values * self._counts]

    def _run(self, targets: list[int]) -> None:
        begin_s = time.monotonic()
        deadline_s = begin_s + self._travel_s(targets) + MARGIN_S
        moves = [_SetPoint(axis, target) for axis, target in zip(self._axes, targets, strict=True)]
        asked_s = begin_s
        while waiting := [move for move in moves if not move.advance()]:
            now_s = time.monotonic()
            if now_s > deadline_s:
                raise self._late(f"to reach {waiting[0].target} counts")
            if now_s - asked_s > POLL_S:
                asked_s = now_s
                for move in waiting:
                    move.axis.poll()
            else:
                with self._news:
                    if all(move.axis.status_count == move.seen for move in waiting):
                        self._news.wait(POLL_S / 2)
        for move, counts in zip(moves, self._counts, strict=True):
            move.verify(IN_POSITION * float(counts))

    def _travel_s(self, targets: list[int]) -> float:
        ways = [abs(target - axis.position) for axis, target in zip(self._axes, targets, strict=True)]
        return (
            max(float(way / (v * c)) for way, v, c in zip(ways, self._speeds, self._counts, strict=True)) + 2 * RAMP_S
        )

    def pose(self) -> Pose6:
        """Where the robot stands (6,), mm and rad; at most 0.3 s old."""
        self._require_open()
        if not all(axis.is_fresh for axis in self._axes):
            with self._turn:
                for axis in self._axes:
                    axis.check()
                    axis.poll()
        return self._pose()

    def _pose(self) -> Pose6:
        values = np.array([axis.position for axis in self._axes], dtype=np.float64) / self._counts
        return np.concatenate([values[:3], np.radians(values[3:])])

    def quick_stop(self) -> None:
        """Brake all axes at once; they need `enable` afterwards. Never waits for a move."""
        self._require_open()
        self._enabled = False
        for axis in self._axes:
            axis.send(words.QUICK_STOP)

    def check(self) -> None:
        """Raise what is wrong with any axis, if anything is."""
        self._require_open()
        for axis in self._axes:
            axis.check()

    # --- inside ----------------------------------------------------------------------------------------------

    def _require_open(self) -> canopen.Network:
        if self._network is None:
            raise DeviceAbsentError(f"{self._where}: not open")
        return self._network

    def _wait(self, done: Callable[[], bool], timeout_s: float, what: str) -> None:
        with self._news:
            if not self._news.wait_for(done, timeout_s):
                raise self._late(what)

    def _late(self, what: str) -> DeviceSilentError:
        states = ", ".join(f"{name} {axis.state.value}" for name, axis in zip(AXES, self._axes, strict=True))
        return DeviceSilentError(f"{self._where}: too late {what}; states: {states}")


class _BringUp:
    """Takes one axis to OPERATION ENABLED, a step at a time; a lost frame is sent again."""

    def __init__(self, axis: RobotAxis) -> None:
        self._axis = axis
        self._asked: DriveState | None = None
        self._asked_s = 0.0
        self._resets = 0

    def advance(self) -> bool:
        """Take the next step if it is due; True in OPERATION ENABLED."""
        axis = self._axis
        axis.check()
        late = time.monotonic() - self._asked_s > POLL_S
        if late and self._asked is not None and axis.state is not DriveState.OPERATION_ENABLED:
            axis.poll()
        state = axis.state
        if state is DriveState.OPERATION_ENABLED:
            return True
        if state is not self._asked or late:
            self._asked, self._asked_s = state, time.monotonic()
            self._ask(state)
        return False

    def _ask(self, state: DriveState) -> None:
        if state is DriveState.FAULT:
            if self._resets == 3:
                self._axis.raise_fault()
            self._resets += 1
            self._axis.send(words.DISABLE_VOLTAGE)
            self._axis.send(words.FAULT_RESET)
        elif state in words.NEXT_CONTROLWORD:
            self._axis.send(words.NEXT_CONTROLWORD[state])


class _SetPoint:
    """The new-set-point handshake of one axis: ask, see it acknowledged, take the bit back, arrive."""

    def __init__(self, axis: RobotAxis, target: int) -> None:
        self.axis = axis
        self.target = target
        self.seen = axis.status_count
        self._acknowledged = self._arrived = False
        axis.check()
        axis.send(words.NEW_SET_POINT_NOW, target)

    def advance(self) -> bool:
        """Take the next step if the axis has said something; True when it has arrived."""
        self.axis.check()
        if self._arrived or self.axis.status_count == self.seen:
            return self._arrived
        self.seen, word = self.axis.status_count, self.axis.statusword
        if words.drive_state(word) in (DriveState.FAULT, DriveState.FAULT_REACTION_ACTIVE):
            self.axis.raise_fault()
        if words.drive_state(word) is not DriveState.OPERATION_ENABLED:
            raise DeviceFaultError(f"{self.axis.where}: stopped on the way: {words.drive_state(word).value}")
        if not self._acknowledged and word & words.SET_POINT_ACKNOWLEDGED:
            self._acknowledged = True
            self.axis.send(words.ENABLE, self.target)
        taken_back = self._acknowledged and not word & words.SET_POINT_ACKNOWLEDGED
        self._arrived = taken_back and bool(word & words.TARGET_REACHED)
        return self._arrived

    def verify(self, tolerance: float) -> None:
        """Compare where the axis stands with where it was sent."""
        if abs(self.axis.position - self.target) > tolerance:
            raise DeviceFaultError(
                f"{self.axis.where}: says it has arrived but stands at {self.axis.position} instead of {self.target}"
            )
