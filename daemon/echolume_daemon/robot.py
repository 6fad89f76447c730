"""The robot service: moves the ultrasonic array from pose to pose."""

from __future__ import annotations

import threading
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from echolume_daemon.body import Json, pose6
from echolume_daemon.device import Slot
from echolume_daemon.service import Service, run_service
from echolume_messages.bus import Bus
from echolume_messages.errors import DeviceAbsentError, DeviceError
from echolume_messages.rig import Rig, RobotSettings

_COMMAND_LIMIT_S = 120.0


class Robot(Protocol):
    """Six axes, as the service needs them; poses are x, y, z in mm and rx, ry, rz in rad, shape (6,)."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def enable(self) -> object: ...
    def move(self, pose: NDArray[np.float64]) -> NDArray[np.float64]: ...
    def pose(self) -> NDArray[np.float64]: ...
    def quick_stop(self) -> object: ...


class RobotService:
    """Commands of the robot."""

    def __init__(self, service: Service, device: Robot | None = None) -> None:
        self._service, self._settings = service, service.rig.robot
        self._enabled = False
        self._slot = Slot("robot", lambda: device or _driver(self._settings), self._prepare, lambda d: d.pose())
        self._slot.watch(service)
        service.serve({"enable": self._enable, "move": self._move}, _COMMAND_LIMIT_S)
        service.serve({"stop": self._stop, "status": self._status}, 15.0)

    def health(self) -> Json:
        """Device state."""
        return {"devices": {"robot": self._slot.status()}, "enabled": self._enabled}

    def close(self) -> None:
        """Stop where it is, then let go of the bus."""
        if self._slot.present:
            try:
                self._stop({})
            except DeviceError as error:
                self._service.log.error("quick stop at the end failed: %s", error)
        self._slot.close()

    def _prepare(self, _device: Robot) -> None:
        self._enabled = False

    def _enable(self, _body: Json) -> Json:
        with self._slot.use() as device:
            device.enable()
        self._enabled = True
        return {}

    def _move(self, body: Json) -> Json:
        target = np.array(pose6(body, "pose"), dtype=np.float64)
        try:
            with self._slot.use() as device:
                reached = device.move(target)
        except DeviceError:
            self._enabled = False
            raise
        return {"pose": [float(v) for v in reached], "sigma_mm": self._settings.pose_sigma_mm}

    def _stop(self, _body: Json) -> Json:
        """Brake at once, also in the middle of a move."""
        device = self._slot.without_waiting()
        if device is None:
            raise DeviceAbsentError(str(self._slot.status()["error"]))
        self._enabled = False
        device.quick_stop()
        return {}

    def _status(self, _body: Json) -> Json:
        return self.health()


def _driver(settings: RobotSettings) -> Robot:
    from echolume_drivers.robot import Cia402Robot

    return Cia402Robot(settings)


def main(
    bus: Bus | None = None,
    rig: Rig | None = None,
    device: Robot | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run the robot service until it is told to stop; returns the exit code."""
    return run_service("robot", lambda service: RobotService(service, device), bus, rig, stop)
