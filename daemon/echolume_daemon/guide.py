"""The guide service: moves the laser along the guide, exposes, and switches the laser off when nobody is in charge."""

from __future__ import annotations

import queue
import threading
from collections.abc import Generator
from contextlib import contextmanager
from typing import Protocol

from echolume_daemon.body import Json, number
from echolume_daemon.device import Slot
from echolume_daemon.service import Loop, Service, run_service
from echolume_messages.bus import Bus
from echolume_messages.errors import DeviceAbsentError, DeviceError
from echolume_messages.rig import GuideSettings, Rig

IN_CHARGE = frozenset({"conductor", "recorder", "router"})
"""When one of these vanishes, the laser goes off."""
_COMMAND_LIMIT_S = 60.0


class GuideStatus(Protocol):
    """What the controller says of itself."""

    @property
    def state(self) -> str:
        """Name of the controller's state, e.g. ``Idle``."""
        ...

    @property
    def x_mm(self) -> float:
        """Position."""
        ...


class Guide(Protocol):
    """Guide and laser, as the service needs them."""

    def open(self) -> None: ...
    def close(self) -> None: ...
    def home(self) -> object: ...
    def move(self, x_mm: float) -> float: ...
    def expose(self, x_mm: float, exposure_s: float) -> float: ...
    def laser_off(self) -> object: ...
    def stop(self) -> object: ...
    def status(self) -> GuideStatus: ...


class GuideService:
    """Commands of the guide, and the guard over the laser."""

    def __init__(self, service: Service, device: Guide | None = None) -> None:
        self._service, self._settings = service, service.rig.guide
        self._homed = False
        self._alive: set[str] = set()
        self._darkening = threading.Lock()
        self._gone: queue.SimpleQueue[str] = queue.SimpleQueue()
        self._slot = Slot("guide", lambda: device or _driver(self._settings), self._prepare, lambda d: d.status())
        self._slot.watch(service)
        service.bus.watch_alive(self._note)
        service.thread("guard", self._guard, 15.0)
        service.serve({"home": self._home, "move": self._move, "expose": self._expose}, _COMMAND_LIMIT_S)
        service.serve({"laser_off": self._laser_off, "stop": self._stop, "status": self._status}, 15.0)

    def health(self) -> Json:
        """Device state and who is in charge."""
        return {
            "devices": {"guide": self._slot.status()},
            "homed": self._homed,
            "in_charge": sorted(self._alive.copy()),
        }

    def close(self) -> None:
        """Laser off, then let go of the port."""
        self._dark("the service stops")
        self._slot.close()

    def _prepare(self, device: Guide) -> None:
        """At start the worst is assumed: the laser may still be on, and the position is unknown."""
        self._homed = False
        device.laser_off()

    def _note(self, name: str, alive: bool) -> None:
        """The bus says that a service came or went."""
        if name not in IN_CHARGE:
            return
        if alive:
            self._alive.add(name)
        else:
            self._alive.discard(name)
            self._gone.put(name)

    def _guard(self, _loop: Loop) -> None:
        """Laser off as soon as somebody who was in charge is gone."""
        try:
            name = self._gone.get(timeout=0.2)
        except queue.Empty:
            return
        self._dark(f"{name} is gone")

    def _dark(self, why: str) -> None:
        """Laser off, even while an exposure or a move is under way."""
        if not self._slot.present:
            return
        try:
            self._laser_off({})
        except DeviceError as error:
            self._service.log.error("laser off (%s) failed: %s; use the emergency stop", why, error)
        else:
            self._service.log.info("laser off: %s", why)

    @contextmanager
    def _moving(self) -> Generator[Guide]:
        """Hold the guide for a motion; after a failure its position is not to be relied on."""
        try:
            with self._slot.use() as device:
                yield device
        except DeviceError:
            self._homed = False
            raise

    def _at_once(self) -> Guide:
        device = self._slot.without_waiting()
        if device is None:
            raise DeviceAbsentError(str(self._slot.status()["error"]))
        return device

    def _home(self, _body: Json) -> Json:
        with self._moving() as device:
            device.home()
        self._homed = True
        return {}

    def _move(self, body: Json) -> Json:
        with self._moving() as device:
            return {"x_mm": device.move(number(body, "x_mm"))}

    def _expose(self, body: Json) -> Json:
        with self._moving() as device:
            x_mm = device.expose(number(body, "x_mm"), number(body, "exposure_s"))
        return {"x_mm": x_mm, "sigma_mm": self._settings.position_sigma_mm, "method": "step"}

    def _laser_off(self, _body: Json) -> Json:
        """Also in the middle of an exposure; one at a time, for they would take each other for a stop."""
        with self._darkening:
            self._at_once().laser_off()
        return {}

    def _stop(self, _body: Json) -> Json:
        with self._darkening:
            self._at_once().stop()
        return {}

    def _status(self, _body: Json) -> Json:
        return self.health()


def _driver(settings: GuideSettings) -> Guide:
    from echolume_drivers.grbl import GrblGuide

    return GrblGuide(settings)


def main(
    bus: Bus | None = None,
    rig: Rig | None = None,
    device: Guide | None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run the guide service until it is told to stop; returns the exit code."""
    return run_service("guide", lambda service: GuideService(service, device), bus, rig, stop)
