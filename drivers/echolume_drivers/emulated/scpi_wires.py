"""Wires of the emulated SCPI instruments: a PTY or a TCP port, one client, one thread, lines in and bytes out."""

from __future__ import annotations

import os
import selectors
import socket
import threading
import tty
from collections.abc import Callable

LONGEST_LINE = 4096
"""A client that sends more without an end of line is cut off."""

LineHandler = Callable[[bytes], bytes]
"""Gets a line without its end, returns what to send back (may be empty)."""


class ScpiWire:
    """Runs a handler for each line that arrives; subclasses own the file descriptor."""

    def __init__(self, name: str, handler: LineHandler) -> None:
        self._handler = handler
        self._selector = selectors.DefaultSelector()
        self._wake_in, self._wake_out = os.pipe()
        self._selector.register(self._wake_in, selectors.EVENT_READ, self._woken)
        self._thread = threading.Thread(target=self._run, name=name, daemon=True)
        self._running = True
        self._buffer = bytearray()
        self._hang_up = False

    @property
    def url(self) -> str:
        """What pyserial's ``serial_for_url`` opens."""
        raise NotImplementedError

    def start(self) -> None:
        """Answer from now on."""
        self._thread.start()

    def hang_up_after_reply(self) -> None:
        """Cut the client off once the reply in progress is sent; call from the handler."""
        self._hang_up = True

    def close(self) -> None:
        """Stop the thread and close the wire."""
        if not self._running:
            return
        self._running = False
        os.write(self._wake_out, b"x")
        if self._thread.ident is not None:
            self._thread.join(timeout=10)
        self._selector.close()
        self._close_line()
        os.close(self._wake_in)
        os.close(self._wake_out)

    def _woken(self) -> None:
        os.read(self._wake_in, 16)

    def _run(self) -> None:
        while self._running:
            for key, _ in self._selector.select():
                key.data()

    def _received(self, data: bytes) -> None:
        self._buffer += data
        if len(self._buffer) > LONGEST_LINE and b"\n" not in self._buffer:
            self._buffer.clear()
            self._disconnect()
        while b"\n" in self._buffer:
            line, _, rest = bytes(self._buffer).partition(b"\n")
            self._buffer[:] = rest
            reply = self._handler(line.strip(b"\r \t"))
            if reply:
                self._send(reply)
            if self._hang_up:
                self._hang_up = False
                self._buffer.clear()
                self._disconnect()

    def _send(self, data: bytes) -> None:
        raise NotImplementedError

    def _disconnect(self) -> None:
        raise NotImplementedError

    def _close_line(self) -> None:
        raise NotImplementedError


class PtyWire(ScpiWire):
    """A pseudo-terminal; a disconnect is for good, as when the cable of a USB adapter is pulled."""

    def __init__(self, name: str, handler: LineHandler) -> None:
        super().__init__(name, handler)
        self._main, self._slave = os.openpty()
        tty.setraw(self._slave)
        self._path = os.ttyname(self._slave)
        self._open = True
        self._selector.register(self._main, selectors.EVENT_READ, self._readable)

    @property
    def url(self) -> str:
        return self._path

    def _readable(self) -> None:
        self._received(os.read(self._main, 4096))

    def _send(self, data: bytes) -> None:
        view = memoryview(data)
        while view:
            view = view[os.write(self._main, view) :]

    def _disconnect(self) -> None:
        self._selector.unregister(self._main)
        self._close_line()

    def _close_line(self) -> None:
        if self._open:
            self._open = False
            os.close(self._main)
            os.close(self._slave)


class TcpWire(ScpiWire):
    """A TCP port on loopback; a second client is turned away while one is connected."""

    def __init__(self, name: str, handler: LineHandler) -> None:
        super().__init__(name, handler)
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._client: socket.socket | None = None
        self._selector.register(self._listener, selectors.EVENT_READ, self._knock)

    @property
    def url(self) -> str:
        return f"socket://127.0.0.1:{self._listener.getsockname()[1]}"

    def _knock(self) -> None:
        client, _ = self._listener.accept()
        if self._client is not None:
            client.close()
            return
        client.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        client.settimeout(5.0)
        self._client = client
        self._buffer.clear()
        self._selector.register(client, selectors.EVENT_READ, self._readable)

    def _readable(self) -> None:
        if self._client is None:
            return
        try:
            data = self._client.recv(4096)
        except ConnectionError:
            data = b""
        if data:
            self._received(data)
        else:
            self._disconnect()

    def _send(self, data: bytes) -> None:
        if self._client is None:
            return
        try:
            self._client.sendall(data)
        except OSError:  # the client went away while we answered
            self._disconnect()

    def _disconnect(self) -> None:
        if self._client is not None:
            self._selector.unregister(self._client)
            self._client.close()
            self._client = None

    def _close_line(self) -> None:
        if self._client is not None:
            self._client.close()
        self._listener.close()
