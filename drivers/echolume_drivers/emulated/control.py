"""The emulated rig's control: what hands do at a real rig, and faults on demand. JSON lines over TCP on 127.0.0.1.

A request is one line, ``{"op": "place", "scene": "plate"}``; the answer is one line, ``{"ok": true, ...}`` or
``{"ok": false, "error": "..."}``. Operations::

    place   scene: a scene's name or file, or board: the index of a pose, or a 4x4 matrix rig_from_board
    truth   path: where to write what truly stands on the bench, as .npz
    fault   device, fault, and the fault's own arguments (count, delay_s, ...)
    status  laser_on, guide_x_mm, robot_pose, scene, board, frames missed by the cameras
    quit    end the emulated rig
"""

from __future__ import annotations

import json
import selectors
import socket
import threading
from collections.abc import Callable, Mapping
from pathlib import Path
from types import TracebackType
from typing import Any, TypeAlias, cast

from echolume_messages.errors import CommandRefusedError, NoReplyError
from echolume_messages.geometry import Matrix

Json: TypeAlias = dict[str, Any]
Handler: TypeAlias = Callable[[Json], Json]

LINE_BYTES = 1 << 16
ADDRESS_FILE = "control"
"""Name of the file beside rig.toml that holds host:port of the control."""


class ControlServer:
    """Answers requests one after the other in a thread of its own."""

    def __init__(self, handlers: Mapping[str, Handler]) -> None:
        self._handlers = handlers
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._port = int(self._listener.getsockname()[1])
        self._selector = selectors.DefaultSelector()
        self._stop_out, self._stop_in = socket.socketpair()
        self._lines: dict[socket.socket, bytes] = {}
        self._thread = threading.Thread(target=self._serve, name="control", daemon=True)

    @property
    def address(self) -> str:
        """host:port."""
        return f"127.0.0.1:{self._port}"

    def start(self) -> None:
        """Begin to answer."""
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._stop_out, selectors.EVENT_READ)
        self._thread.start()

    def close(self) -> None:
        """Hang up on everybody and free the port."""
        self._stop_in.send(b".")
        if self._thread.is_alive():
            self._thread.join(10.0)
        for client in list(self._lines):
            self._drop(client)
        self._selector.close()
        for port in (self._listener, self._stop_in, self._stop_out):
            port.close()

    def _serve(self) -> None:
        while True:
            for key, _ in self._selector.select():
                port = cast("socket.socket", key.fileobj)
                if port is self._stop_out:
                    return
                if port is self._listener:
                    client, _ = self._listener.accept()
                    client.settimeout(2.0)
                    self._lines[client] = b""
                    self._selector.register(client, selectors.EVENT_READ)
                else:
                    self._hear(port)

    def _hear(self, client: socket.socket) -> None:
        try:
            data = client.recv(1 << 16)
            *lines, rest = (self._lines[client] + data).split(b"\n")
            for line in lines:
                client.sendall(json.dumps(self._answer(line)).encode() + b"\n")
        except OSError:
            data, rest = b"", b""
        self._lines[client] = rest
        if not data or len(rest) > LINE_BYTES:
            self._drop(client)

    def _drop(self, client: socket.socket) -> None:
        del self._lines[client]
        self._selector.unregister(client)
        client.close()

    def _answer(self, line: bytes) -> Json:
        try:
            request: Any = json.loads(line)
        except ValueError as error:
            return {"ok": False, "error": f"not JSON: {error}"}
        op = str(cast("Json", request).pop("op", "")) if isinstance(request, dict) else ""
        if op not in self._handlers:
            return {"ok": False, "error": f"unknown op {op!r}; known: {', '.join(self._handlers)}"}
        try:
            return {"ok": True, **self._handlers[op](cast("Json", request))}
        except (ValueError, TypeError, KeyError, OSError) as error:
            return {"ok": False, "error": f"{op}: {error}"}


class Control:
    """Client of the emulated rig's control.

    Raises
    ------
    NoReplyError
        If nobody answers at the address, in the constructor and in every call.
    CommandRefusedError
        If the emulated rig says no; from every call.
    """

    def __init__(self, address: str, timeout_s: float = 10.0) -> None:
        host, _, port = address.rpartition(":")
        self._address = address
        try:
            self._port = socket.create_connection((host, int(port)), timeout=timeout_s)
        except (OSError, ValueError) as error:
            raise NoReplyError(f"emulated rig: no control at {address!r}: {error}; is it running?") from error
        self._file = self._port.makefile("rb")

    @classmethod
    def beside(cls, rig_file: Path, timeout_s: float = 10.0) -> Control:
        """The control of the emulated rig that wrote `rig_file`."""
        path = rig_file.parent / ADDRESS_FILE
        try:
            address = path.read_text(encoding="utf-8").strip()
        except OSError as error:
            raise NoReplyError(f"{path}: {error.strerror}; is {rig_file} of a running emulated rig?") from error
        return cls(address, timeout_s)

    def __enter__(self) -> Control:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def close(self) -> None:
        """Hang up."""
        self._file.close()
        self._port.close()

    def request(self, op: str, **arguments: object) -> Json:
        """Send an operation; its answer without ``ok``."""
        try:
            self._port.sendall(json.dumps({"op": op, **arguments}).encode() + b"\n")
            line = self._file.readline(LINE_BYTES)
        except OSError as error:
            raise NoReplyError(f"emulated rig at {self._address}: {op}: {error}") from error
        if not line:
            raise NoReplyError(f"emulated rig at {self._address}: {op}: it hung up")
        answer = cast("Json", json.loads(line))
        if not answer.pop("ok"):
            raise CommandRefusedError(f"emulated rig: {answer['error']}")
        return answer

    def place_scene(self, name: str) -> None:
        """Put a scene on the bench, by its name or from a ``.toml`` file; the board goes."""
        self.request("place", scene=str(Path(name).resolve()) if name.endswith(".toml") else name)

    def place_board(self, pose: int | Matrix) -> None:
        """Put the calibration board on the bench, in one of its poses or at ``rig_from_board`` (4, 4)."""
        self.request("place", board=pose if isinstance(pose, int) else pose.tolist())

    def truth(self, path: Path) -> Json:
        """Have what truly stands on the bench written to an .npz; returns its path and the scene's name.

        Arrays: front_mm, optical_mm, material, region (rows along y, columns along x); x0_mm, y0_mm, cell_mm; regions:
        the names that region counts; expect: a JSON list of what a map must say of them, see docs/scenes.md.
        """
        return self.request("truth", path=str(path.resolve()))

    def fault(self, device: str, fault: str, **arguments: object) -> None:
        """Make a device fail, e.g. ``fault("camera-left", "drop", count=2)``."""
        self.request("fault", device=device, fault=fault, **arguments)

    def status(self) -> Json:
        """What the rig is doing: laser_on, guide_x_mm, robot_pose, scene, board, missed."""
        return self.request("status")

    def quit(self) -> None:
        """End the emulated rig."""
        self.request("quit")
