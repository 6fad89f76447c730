"""A device that may be absent: opened with back-off, watched, and let go when it fails."""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable, Generator
from contextlib import contextmanager
from typing import Generic, Protocol, TypeVar

from echolume_daemon.service import Json, Loop, Service
from echolume_messages.errors import (
    DeviceAbsentError,
    DeviceError,
    DeviceFaultError,
    DeviceSilentError,
    ProtocolError,
)

_BACK_OFF_S = (0.1, 2.0)
_PROBE_S = 1.0
_TICK_S = 0.05
_OPEN_LIMIT_S = 60.0


class Openable(Protocol):
    """What every device of the rig can do."""

    def open(self) -> None:
        """Open the port and check who answers."""
        ...

    def close(self) -> None:
        """Let go of the port."""
        ...


D = TypeVar("D", bound=Openable)


class Slot(Generic[D]):
    """Where a device is plugged in. An empty slot is a state, not a crash.

    Parameters
    ----------
    name
        Name of the device in status and errors, e.g. ``guide``.
    make
        Builds the (still closed) device.
    prepare
        Brings a device that was just opened to its starting state.
    probe
        Asks an idle device whether it is still there; raises a `DeviceError` if not.
    """

    def __init__(
        self,
        name: str,
        make: Callable[[], D],
        prepare: Callable[[D], object] | None = None,
        probe: Callable[[D], object] | None = None,
    ) -> None:
        self.name = name
        self._make, self._prepare, self._probe = make, prepare, probe
        self._lock = threading.RLock()
        self._device: D | None = None
        self._error = f"{name}: not opened yet"
        self._wait_s = _BACK_OFF_S[0]
        self._next_s = 0.0
        self._suspect = False
        self._closed = False
        self._log = logging.getLogger(f"echolume.device.{name}")

    @property
    def present(self) -> bool:
        """Whether the device is open."""
        return self._device is not None

    def status(self) -> Json:
        """``state`` (``ok``, ``fault`` or ``absent``) and the last error."""
        state = "absent" if self._device is None else "fault" if self._error else "ok"
        return {"state": state, "error": self._error}

    @contextmanager
    def use(self) -> Generator[D]:
        """Hold the device for one operation.

        Raises
        ------
        DeviceAbsentError
            The slot is empty; the message carries why.
        DeviceError
            Whatever the operation raised. A device that vanished is let go and searched for again.
        """
        with self._lock:
            if self._device is None:
                raise DeviceAbsentError(self._error)
            try:
                yield self._device
            except DeviceFaultError as error:
                self._error = str(error)
                raise
            except (DeviceSilentError, ProtocolError) as error:
                self._suspect = True
                if self._probe is None:
                    self._drop(error)
                raise
            except DeviceError as error:
                self._drop(error)
                raise
            else:
                self._error = ""

    def without_waiting(self) -> D | None:
        """The device, even while an operation runs: only for its stop, which may interrupt."""
        return self._device

    def watch(self, service: Service) -> None:
        """Start to look after the device, in a thread of the service."""

        def body(loop: Loop) -> None:
            loop.answer(_OPEN_LIMIT_S)
            self.tick(time.monotonic())
            service.stop.wait(_TICK_S)

        service.thread(f"device.{self.name}", body, _OPEN_LIMIT_S)

    def tick(self, now_s: float) -> None:
        """Open the device if it is absent and due; probe it if it is idle and due."""
        if self._device is None:
            if now_s >= self._next_s and not self._closed:
                self._try_open(now_s)
        elif (
            self._probe is not None and (self._suspect or now_s >= self._next_s) and self._lock.acquire(blocking=False)
        ):
            try:
                self._ask(self._probe, now_s)
            finally:
                self._lock.release()

    def close(self) -> None:
        """Let go of the device for good."""
        with self._lock:
            self._closed = True
            self._let_go()
            self._error = f"{self.name}: service is stopping"

    def _try_open(self, now_s: float) -> None:
        device: D | None = None
        try:
            device = self._make()
            device.open()
            if self._prepare is not None:
                self._prepare(device)
        except (DeviceError, OSError) as error:
            if device is not None:
                _close_quietly(device, self._log)
            text = str(error)
            if text != self._error:
                self._log.warning("absent: %s", text)
            self._error = text
            self._next_s = now_s + self._wait_s
            self._wait_s = min(2 * self._wait_s, _BACK_OFF_S[1])
            return
        with self._lock:
            if self._closed:
                _close_quietly(device, self._log)
                return
            self._device, self._error, self._suspect = device, "", False
        self._wait_s, self._next_s = _BACK_OFF_S[0], now_s + _PROBE_S
        self._log.info("open")

    def _ask(self, probe: Callable[[D], object], now_s: float) -> None:
        device = self._device
        if device is None:
            return
        try:
            probe(device)
        except DeviceFaultError as error:
            self._error = str(error)
        except DeviceError as error:
            self._drop(error)
            return
        self._suspect = False
        self._next_s = now_s + _PROBE_S

    def _drop(self, error: Exception) -> None:
        self._log.warning("lost: %s", error)
        self._let_go()
        self._error, self._suspect = str(error), False
        self._next_s = time.monotonic() + self._wait_s

    def _let_go(self) -> None:
        device, self._device = self._device, None
        if device is not None:
            _close_quietly(device, self._log)


def _close_quietly(device: Openable, log: logging.Logger) -> None:
    """Close a device that may be gone already; its complaint is only worth a line."""
    try:
        device.close()
    except (DeviceError, OSError) as error:
        log.info("closing: %s", error)
