"""The emulated gantry: six CiA 402 axes (x, y, z, rx, ry, rz) on a CAN bus behind a socketcand hub.

Faults for `RobotPeer.inject` (``node`` 1 to 6): ``lost_tpdo`` (``count``), ``emcy`` (``code``), ``frozen_heartbeat``,
``boot_up`` (the node restarts in the middle of the run), ``following_error`` (the axis sticks at its next move),
``silent`` (the node is dead), ``disconnect`` (every client is thrown out).
"""

from __future__ import annotations

import math
import os
import threading
import time
from collections.abc import Callable
from typing import Final

import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.robot_axis import Axis, Frame
from echolume_drivers.emulated.socketcand_hub import SocketcandHub
from echolume_drivers.emulated.stage import Stage

COUNTS: Final = 1000.0
"""Per mm and per degree, as the rig file's defaults."""
START: Final = (0.0, 0.0, 250.0, 0.0, 0.0, 0.0)
LIMITS: Final = ((-400, 400), (-400, 400), (20, 600), (-60, 60), (-60, 60), (-190, 190))
"""Of 0x607D: mm and degrees."""


class RobotPeer:
    """Six axes on one bus; `address` is (host, port) of the hub."""

    def __init__(self, stage: Stage) -> None:
        self._stage = stage
        self.axes = [
            Axis(k + 1, stage.speed, round(start * COUNTS), (round(low * COUNTS), round(high * COUNTS)))
            for k, (start, (low, high)) in enumerate(zip(START, LIMITS, strict=True))
        ]
        self._hub = SocketcandHub()
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._orders: list[Callable[[], list[Frame]]] = []
        self._stopping = False
        self._thread = threading.Thread(target=self._run, name="robot-bus", daemon=True)

    @property
    def address(self) -> tuple[str, int]:
        """Host and port."""
        return self._hub.address

    @property
    def url(self) -> str:
        """``host:port``."""
        return f"{self.address[0]}:{self.address[1]}"

    def pose(self) -> NDArray[np.float64]:
        """Actual pose (6,): x, y, z in mm, rx, ry, rz in rad."""
        now_s = time.monotonic()
        values = [axis.position(now_s) / COUNTS for axis in self.axes]
        return np.array(values[:3] + [math.radians(value) for value in values[3:]], dtype=np.float64)

    def start(self) -> None:
        """Put the robot on the stage and switch its bus on."""
        self._stage.robot_pose = self.pose
        self._thread.start()

    def close(self) -> None:
        """Switch the bus off."""
        if self._stopping:
            return
        self._stopping = True
        os.eventfd_write(self._wake, 1)
        if self._thread.is_alive():
            self._thread.join(5.0)
        self._hub.close()
        os.close(self._wake)

    def inject(self, fault: str, *, node: int = 1, count: int = 1, code: int = 0x4310) -> None:
        """Make something go wrong; see the module's list."""
        axis = self.axes[node - 1]

        def act() -> list[Frame]:
            if fault == "lost_tpdo":
                axis.lost_tpdos += count
            elif fault == "emcy":
                axis.fault(code)
            elif fault == "frozen_heartbeat":
                axis.frozen_heartbeat = True
            elif fault == "boot_up":
                return axis.restart()
            elif fault == "following_error":
                axis.stuck = True
            elif fault == "silent":
                axis.dead = True
            else:
                self._hub.disconnect()
            return []

        if fault not in FAULTS:
            raise ValueError(f"RobotPeer: unknown fault {fault!r}")
        self._orders.append(act)
        os.eventfd_write(self._wake, 1)

    def _run(self) -> None:
        while not self._stopping:
            wait_s = min(axis.due_s() for axis in self.axes) - time.monotonic()
            received = self._hub.poll(wait_s, self._wake)
            self._obey()
            now_s = time.monotonic()
            for cob_id, data in received:
                for axis in self.axes:
                    self._hub.broadcast(axis.receive(cob_id, data, now_s))
            for axis in self.axes:
                self._hub.broadcast(axis.tick(time.monotonic()))

    def _obey(self) -> None:
        try:
            os.eventfd_read(self._wake)
        except BlockingIOError:
            return
        while self._orders:
            self._hub.broadcast(self._orders.pop(0)())


FAULTS: Final = ("lost_tpdo", "emcy", "frozen_heartbeat", "boot_up", "following_error", "silent", "disconnect")
