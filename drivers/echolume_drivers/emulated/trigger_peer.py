"""Emulated trigger unit on a PTY, in the dialect of a BNC 575: ``ok`` or ``?n`` to each command."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Protocol

from echolume_drivers.emulated.scpi_peer import header_pattern, split_units
from echolume_drivers.emulated.scpi_wires import PtyWire
from echolume_drivers.emulated.stage import Stage

IDENTITY = "ECHOLUME,PULSE 575,0001,1.0"
BAD_PREFIX, BAD_KEYWORD, NO_PARAMETER, BAD_PARAMETER, UNAVAILABLE = "?1", "?3", "?4", "?5", "?8"

SWITCH = {"ON": True, "1": True, "OFF": False, "0": False}
EXTERNAL = {"TRIG": True, "TRIGGER": True, "DIS": False, "DISABLED": False}
FAULTS = ("no_fire", "silent", "garbage", "refuse", "disconnect")


class Fires(Protocol):
    """A camera as the trigger wire sees it."""

    def fire(self, exposure_s: float) -> None:
        """Expose once."""
        ...


class TriggerPeer:
    """Pulse generator wired to the laser-enable line (trigger input) and to the cameras (channel 1)."""

    def __init__(self, stage: Stage, cameras: Sequence[Fires]) -> None:
        self._cameras = list(cameras)
        self._wire = PtyWire("trigger-peer", self._line)
        self._lock = threading.Lock()
        self._armed = False
        self._external = False
        self._width_s = 1e-3
        self._count = 0
        self._faults: dict[str, int] = {}
        self._patterns = {
            "identity": header_pattern("*IDN?"),
            "trigger": header_pattern("*TRG"),
            "reset": header_pattern("*RST"),
            "state": header_pattern("PULSe0:STATe"),
            "state?": header_pattern("PULSe0:STATe?"),
            "mode": header_pattern("PULSe0:EXTernal:MODe"),
            "mode?": header_pattern("PULSe0:EXTernal:MODe?"),
            "width": header_pattern("PULSe1:WIDTh"),
            "width?": header_pattern("PULSe1:WIDTh?"),
            "count?": header_pattern("PULSe0:COUNter:COUNts?"),
        }
        stage.watch_laser(self._laser_edge)

    @property
    def url(self) -> str:
        """Path of the PTY."""
        return self._wire.url

    def start(self) -> None:
        """Answer from now on."""
        self._wire.start()

    def close(self) -> None:
        """Unplug."""
        with self._lock:
            self._armed = False
        self._wire.close()

    def inject(self, fault: str, times: int = 1) -> None:
        """Fail the next `times` occasions.

        ``no_fire`` swallows pulses, ``silent`` swallows commands, ``garbage`` and ``refuse`` answer nonsense and
        ``?8``, ``disconnect`` pulls the cable at the next command; ``none`` heals.
        """
        with self._lock:
            if fault == "none":
                self._faults.clear()
            elif fault in FAULTS:
                self._faults[fault] = times
            else:
                raise ValueError(f"trigger unit: unknown fault {fault!r}, one of {', '.join(FAULTS)} or none")

    def _take(self, fault: str) -> bool:
        left = self._faults.get(fault, 0)
        if left:
            self._faults[fault] = left - 1
        return left > 0

    def _laser_edge(self, on: bool) -> None:
        with self._lock:
            ready = on and self._armed and self._external
        if ready:
            self._pulse()

    def _pulse(self) -> None:
        with self._lock:
            if self._take("no_fire"):
                return
            self._count += 1
            width_s = self._width_s
        for camera in self._cameras:
            camera.fire(width_s)

    def _line(self, line: bytes) -> bytes:
        with self._lock:
            if self._take("silent"):
                return b""
            if self._take("garbage"):
                return b"\xff\x00~~\r\n"
            if self._take("refuse"):
                return UNAVAILABLE.encode() + b"\r\n"
            if self._take("disconnect"):
                self._wire.hang_up_after_reply()
                return b""
        return b"".join(self._execute(h, a).encode() + b"\r\n" for h, a in split_units(line))

    def _execute(self, header: str, arguments: list[str]) -> str:
        if header[0] not in "*:":
            return BAD_PREFIX
        name = next((n for n, pattern in self._patterns.items() if pattern.match(header)), None)
        if name is None:
            return BAD_KEYWORD
        if name in ("state", "mode", "width"):
            return self._set(name, arguments[0].upper()) if arguments else NO_PARAMETER
        if name == "trigger":
            with self._lock:
                if not self._armed or self._external:
                    return UNAVAILABLE
            self._pulse()
            return "ok"
        with self._lock:
            if name == "reset":
                self._armed, self._external = False, False
                return "ok"
            return {
                "identity": IDENTITY,
                "state?": str(int(self._armed)),
                "mode?": "TRIG" if self._external else "DIS",
                "width?": f"{self._width_s:.9f}",
                "count?": str(self._count),
            }[name]

    def _set(self, name: str, value: str) -> str:
        with self._lock:
            if name == "width":
                try:
                    width_s = float(value)
                except ValueError:
                    return BAD_PARAMETER
                if not 1e-8 <= width_s <= 999.0:
                    return BAD_PARAMETER
                self._width_s = width_s
            elif name == "state" and value in SWITCH:
                self._armed = SWITCH[value]
            elif name == "mode" and value in EXTERNAL:
                self._external = EXTERNAL[value]
            else:
                return BAD_PARAMETER
        return "ok"
