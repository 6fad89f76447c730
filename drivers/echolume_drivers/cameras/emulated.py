"""Driver of the emulated rig's cameras over TCP (see `wire`)."""

from __future__ import annotations

import socket
import time
import zlib
from collections import deque

import numpy as np

from echolume_drivers.cameras.camera import CameraFrame, CheckedCamera
from echolume_drivers.cameras.wire import LEADER, TRAILER, Kind, WireEnd, WireError, WireMessage, WireReader
from echolume_messages.errors import (
    ConfigError,
    DeviceAbsentError,
    DeviceFaultError,
    DeviceSilentError,
    ProtocolError,
)

ANSWER_S = 2.0
"""How long the camera may take to answer a command."""


class EmulatedCamera(CheckedCamera):
    """A camera of the emulated rig; `settings.address` is host:port."""

    _port: socket.socket | None = None
    _reader: WireReader | None = None

    def _open(self) -> None:
        host, _, port = self.settings.address.rpartition(":")
        if not host or not port.isdecimal():
            raise ConfigError(f"rig: $.cameras.{self.name}.address: expected host:port, got {self.settings.address!r}")
        self._waiting: deque[WireMessage] = deque()
        self._partial: list[WireMessage] = []
        try:
            self._port = socket.create_connection((host, int(port)), timeout=ANSWER_S)
        except OSError as error:
            raise DeviceAbsentError(
                f"{self.where}: no connection: {error}; is `echolume emulate` running, and this its rig file?"
            ) from error
        self._reader = WireReader(self._port)
        try:
            self._check_size()
            self._command("set TriggerMode On")
            self._command("set ExposureMode TriggerWidth")
        except BaseException:
            self._close()
            raise

    def _check_size(self) -> None:
        seen = tuple(int(self._command(f"get {feature}")) for feature in ("Width", "Height"))
        expected = (self.settings.width_px, self.settings.height_px)
        if seen != expected:
            raise DeviceFaultError(
                f"{self.where}: frames are {seen[0]} x {seen[1]} px, the rig file says {expected[0]} x {expected[1]}; "
                f"correct width_px and height_px in $.cameras.{self.name}"
            )

    def _start(self) -> None:
        self._waiting.clear()
        self._partial.clear()
        self._command("run AcquisitionStart")

    def _stop(self) -> None:
        self._command("run AcquisitionStop")
        self._waiting.clear()
        self._partial.clear()

    def _close(self) -> None:
        port, self._port, self._reader = self._port, None, None
        if port is not None:
            port.close()

    def _command(self, line: str) -> str:
        """Send a line; the text after ``ok``. Frames that come meanwhile are kept."""
        deadline_s = time.monotonic() + ANSWER_S
        if self._port is None:
            raise DeviceAbsentError(f"{self.where}: the connection is closed; open the camera again")
        self._port.settimeout(ANSWER_S)
        try:
            self._port.sendall(f"{line}\n".encode())
        except TimeoutError as error:
            raise DeviceSilentError(f"{self.where}: {line!r} not taken within {ANSWER_S} s; restart it") from error
        except OSError as error:
            raise DeviceAbsentError(f"{self.where}: {line!r} not sent: {error}; open the camera again") from error
        while True:
            message = self._next(deadline_s, f"no answer to {line!r} within {ANSWER_S} s")
            if message.kind is not Kind.REPLY:
                self._waiting.append(message)
                continue
            verdict, _, text = message.body.decode("utf-8", "replace").partition(" ")
            if verdict == "ok":
                return text
            if text.startswith("access denied"):
                raise DeviceAbsentError(f"{self.where}: {text}; stop the other process first")
            raise DeviceFaultError(f"{self.where}: {line!r} refused: {text}")

    def _next(self, deadline_s: float, silent: str) -> WireMessage:
        if self._reader is None:
            raise DeviceAbsentError(f"{self.where}: the connection is closed; open the camera again")
        try:
            return self._reader.next(deadline_s)
        except TimeoutError as error:
            raise DeviceSilentError(f"{self.where}: {silent}; check its trigger line and that it runs") from error
        except WireError as error:
            self._close()
            raise ProtocolError(f"{self.where}: {error}; open the camera again") from error
        except WireEnd as error:
            self._close()
            if error.mid_message or self._partial:
                got = sum(len(m.body) for m in self._partial if m.kind is Kind.PAYLOAD)
                raise ProtocolError(
                    f"{self.where}: hung up in the middle of a frame, after {got} payload bytes; open the camera again"
                ) from error
            raise DeviceAbsentError(f"{self.where}: hung up; open the camera again") from error

    def _read(self, timeout_s: float) -> CameraFrame:
        deadline_s = time.monotonic() + timeout_s
        while True:
            if self._waiting:
                message = self._waiting.popleft()
            else:
                message = self._next(deadline_s, f"no complete frame within {timeout_s} s of waiting")
            if message.kind is Kind.REPLY:
                raise ProtocolError(f"{self.where}: an answer that nobody asked for: {message.body!r}")
            self._partial.append(message)
            if message.kind is Kind.TRAILER:
                parts, self._partial = self._partial, []
                return self._assemble(parts)

    def _assemble(self, parts: list[WireMessage]) -> CameraFrame:
        leader, payloads, trailer = parts[0], parts[1:-1], parts[-1]
        what = f"{self.where}: frame {trailer.block}"
        if leader.kind is not Kind.LEADER or any(p.kind is not Kind.PAYLOAD for p in payloads):
            raise ProtocolError(f"{what}: expected leader, payload, trailer, got {[p.kind.name for p in parts]}")
        if any(p.block != leader.block for p in parts):
            raise ProtocolError(f"{what}: mixed with frames {sorted({p.block for p in parts})}")
        if len(leader.body) != LEADER.size or len(trailer.body) != TRAILER.size:
            raise ProtocolError(f"{what}: leader or trailer of the wrong length")
        device_t_ns, width, height, exposure_s, promised = LEADER.unpack(leader.body)
        size, checksum = TRAILER.unpack(trailer.body)
        payload = b"".join(p.body for p in payloads)
        expected = self.settings.width_px * self.settings.height_px
        if not expected == width * height == promised == size == len(payload):
            raise ProtocolError(
                f"{what}: expected {self.settings.width_px} x {self.settings.height_px} px ({expected} bytes), got "
                f"{width} x {height} px, {promised} bytes promised, {len(payload)} bytes come"
            )
        if zlib.crc32(payload) != checksum:
            raise ProtocolError(f"{what}: checksum differs: the frame was damaged on its way; trigger again")
        pixels = np.frombuffer(payload, dtype=np.uint8).reshape(height, width)
        return CameraFrame(pixels, trailer.block, device_t_ns, exposure_s)
