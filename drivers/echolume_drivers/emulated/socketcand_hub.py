"""A CAN bus on a TCP port of 127.0.0.1, in socketcand's raw mode.

Each of the three handshake replies is a send of its own: python-can reads them one by one. A client hears frames
only after it has sent one or 0.2 s have gone by, because a frame glued to the last ``< ok >`` would make python-can
refuse the server.
"""

from __future__ import annotations

import contextlib
import re
import select
import socket
import time
from dataclasses import dataclass
from typing import Final

JOIN_S: Final = 0.2
LONGEST: Final = 4096
"""Text without an end of message that a client may send before it is thrown out."""
_SEND = re.compile(r"send ([0-9A-Fa-f]+) ([0-8])((?: +[0-9A-Fa-f]{1,2})*)$")


@dataclass
class _Client:
    wire: socket.socket
    text: str = ""
    raw_s: float | None = None
    joined: bool = False


class SocketcandHub:
    """Accepts clients and carries frames between them and the owner; the owner's thread runs it."""

    def __init__(self) -> None:
        self._door = socket.create_server(("127.0.0.1", 0))
        self._door.setblocking(False)
        self._clients: dict[int, _Client] = {}
        self.address: tuple[str, int] = self._door.getsockname()

    def poll(self, timeout_s: float, wake: int) -> list[tuple[int, bytes]]:
        """Wait for traffic (or for `wake` to become readable) and return the frames that clients sent."""
        listened = [self._door.fileno(), wake, *self._clients]
        ready, _, _ = select.select(listened, [], [], max(0.0, timeout_s))  # poll() would round up to a millisecond
        frames: list[tuple[int, bytes]] = []
        for number in ready:
            if number == self._door.fileno():
                self._accept()
            elif number in self._clients:
                frames += self._receive(self._clients[number])
        return frames

    def _accept(self) -> None:
        with contextlib.suppress(BlockingIOError):
            wire, _ = self._door.accept()
            wire.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            self._clients[wire.fileno()] = _Client(wire)
            self._reply(self._clients[wire.fileno()], "< hi >")

    def _receive(self, client: _Client) -> list[tuple[int, bytes]]:
        try:
            data = client.wire.recv(65536)
        except OSError:
            data = b""
        if not data or len(client.text) > LONGEST:
            self._drop(client)
            return []
        *parts, client.text = (client.text + data.decode("ascii", "replace")).split(">")
        frames: list[tuple[int, bytes]] = []
        for part in parts:
            frame = self._message(client, part.strip("< "))
            if frame is not None:
                client.joined = True
                frames.append(frame)
                self._carry(frame, client)
        return frames

    def _message(self, client: _Client, text: str) -> tuple[int, bytes] | None:
        if client.raw_s is None:
            if text.startswith("open "):
                self._reply(client, "< ok >")
            elif text == "rawmode":
                client.raw_s = time.monotonic()
                self._reply(client, "< ok >")
            else:
                self._reply(client, "< error unknown command >")
            return None
        found = _SEND.match(text)
        if found is None:
            return None
        data = bytes(int(part, 16) for part in found[3].split())
        return int(found[1], 16), data[: int(found[2])]

    def broadcast(self, frames: list[tuple[int, bytes]]) -> None:
        """Put the owner's frames on the bus."""
        for frame in frames:
            self._carry(frame, None)

    def _carry(self, frame: tuple[int, bytes], sender: _Client | None) -> None:
        now_s = time.monotonic()
        line = f"< frame {frame[0]:03X} {time.time():.6f} {frame[1].hex().upper()} >"
        for client in list(self._clients.values()):
            if client.raw_s is None or client is sender:
                continue
            if client.joined or now_s > client.raw_s + JOIN_S:
                client.joined = True
                self._reply(client, line)

    def _reply(self, client: _Client, text: str) -> None:
        try:
            client.wire.send(text.encode("ascii"), socket.MSG_DONTWAIT)
        except OSError:  # gone, or it reads nothing: a bus does not wait for one of its nodes
            self._drop(client)

    def _drop(self, client: _Client) -> None:
        self._clients.pop(client.wire.fileno(), None)
        client.wire.close()

    def disconnect(self) -> None:
        """Throw every client out."""
        for client in list(self._clients.values()):
            self._drop(client)

    def close(self) -> None:
        """Throw every client out and give the port back."""
        self.disconnect()
        self._door.close()
