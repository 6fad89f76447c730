"""The array service: pings, and publishes the echoes."""

from __future__ import annotations

import threading
import time
from typing import Protocol

from echolume_daemon.body import Json, number, pose6, text, whole
from echolume_daemon.device import Slot
from echolume_daemon.service import Service, run_service
from echolume_messages.bus import Bus
from echolume_messages.header import Source
from echolume_messages.rig import ArraySettings, Rig
from echolume_messages.topics import ECHOES
from echolume_messages.types import EchoBlock

_COMMAND_LIMIT_S = 30.0


class Ping(Protocol):
    """One ping as the digitiser returns it."""

    @property
    def block(self) -> EchoBlock: ...
    @property
    def sample_rate_hz(self) -> float: ...
    @property
    def start_s(self) -> float: ...
    @property
    def volts_per_count(self) -> float: ...
    @property
    def device_t_ns(self) -> int | None: ...
    @property
    def air_temperature_c(self) -> float: ...


class Digitiser(Protocol):
    """The array's digitiser, as the service needs it."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def configure(self) -> object: ...
    def ping(self) -> Ping: ...


class ArrayService:
    """Commands of the array."""

    def __init__(self, service: Service, device: Digitiser | None = None) -> None:
        self._publisher = service.bus.publisher(ECHOES)
        self._slot = Slot("array", lambda: device or _driver(service.rig.array), lambda d: d.configure())
        self._slot.watch(service)
        service.serve({"ping": self._ping, "status": self._status}, _COMMAND_LIMIT_S)

    def health(self) -> Json:
        """Device state and publishing queue."""
        return {"devices": {"array": self._slot.status()}, "queues": {ECHOES.name: self._publisher.stats}}

    def close(self) -> None:
        """Let go of the port."""
        self._slot.close()

    def _ping(self, body: Json) -> Json:
        pose, trigger = pose6(body, "robot_pose"), whole(body, "trigger")
        sigma_mm, attempt = number(body, "pose_sigma_mm"), whole(body, "attempt")
        scan, pass_name = text(body, "scan"), text(body, "pass")
        calibration = text(body, "calibration", "")
        with self._slot.use() as device:
            t_ns = time.monotonic_ns()
            ping = device.ping()
        source = Source(
            device_t_ns=ping.device_t_ns,
            robot_pose=pose,
            pose_sigma_mm=sigma_mm,
            sample_rate_hz=ping.sample_rate_hz,
            start_s=ping.start_s,
            volts_per_count=ping.volts_per_count,
            air_temperature_c=ping.air_temperature_c,
        )
        seq = self._publisher.put(
            ping.block,
            scan=scan,
            pass_name=pass_name,
            trigger=trigger,
            attempt=attempt,
            calibration=calibration,
            source=source,
            t_ns=t_ns,
        )
        return {"seq": seq}

    def _status(self, _body: Json) -> Json:
        return self.health()


def _driver(settings: ArraySettings) -> Digitiser:
    from echolume_drivers.array import ArrayDigitiser

    return ArrayDigitiser(settings)


def main(
    bus: Bus | None = None,
    rig: Rig | None = None,
    device: Digitiser | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run the array service until it is told to stop; returns the exit code."""
    return run_service("array", lambda service: ArrayService(service, device), bus, rig, stop)
