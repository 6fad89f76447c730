"""Bring one device of the rig to its safe state: ``python3 -I -S safe.py DEVICE WHERE``.

    safe.py guide   /dev/echolume/guide         soft reset (0x18) and M5: the laser is off
    safe.py trigger /dev/echolume/trigger       :PULSE0:STATE OFF: no edge fires the cameras
    safe.py array   /dev/echolume/array         ABOR: no emission is waiting for its trigger
    safe.py robot   127.0.0.1:29536/can0        quick stop of all six axes (socketcand; a bare can0 is SocketCAN)
    safe.py guide   --rig /etc/echolume/rig.toml     the same, with ports and nodes from the rig file

It needs nothing but the standard library, waits at most a few seconds, and says in one line what it did. Exit code 0:
made safe, or the device is absent; 1: the device is there but did not confirm; 2: wrong use. This is no safety
function: a laser interlock and an emergency stop work without software.
"""

from __future__ import annotations

import fcntl
import os
import select
import socket
import struct
import sys
import termios
import time
import tomllib
from collections.abc import Callable
from typing import Any

CONFIRM_S = 3.0
BAUDS = {rate: getattr(termios, f"B{rate}") for rate in (9600, 19200, 38400, 57600, 115200, 230400, 460800, 921600)}
NODES = [1, 2, 3, 4, 5, 6]
QUICK_STOP = b"\x2b\x40\x60\x00\x02\x00\x00\x00"  # SDO download of 2 bytes: controlword 0x6040 = 2
READ_STATUS = b"\x40\x41\x60\x00\x00\x00\x00\x00"  # SDO upload: statusword 0x6041


class Absent(Exception):
    """The device is not there."""


class Unsafe(Exception):
    """The device is there, and its safe state could not be confirmed."""


class Wire:
    """Bytes to and from a tty or a TCP port."""

    def __init__(self, where: str, baud: int = 115200) -> None:
        self.where = where
        self._socket: socket.socket | None = None
        try:
            if where.startswith("socket://"):
                self._socket = connect(where.removeprefix("socket://"))
                self._fd = self._socket.fileno()
            else:
                self._fd = os.open(where, os.O_RDWR | os.O_NOCTTY | os.O_NONBLOCK)
        except OSError as error:
            raise Absent(f"{where}: {error.strerror or error}") from error
        self.held = False
        if self._socket is None:
            self._set_up_tty(baud)

    def _set_up_tty(self, baud: int) -> None:
        try:
            fcntl.flock(self._fd, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.held = True  # somebody else reads the answers; the bytes still arrive
            return
        try:
            mode = termios.tcgetattr(self._fd)
            mode[0] = mode[1] = mode[3] = 0
            mode[2] = termios.CS8 | termios.CREAD | termios.CLOCAL
            mode[4] = mode[5] = BAUDS.get(baud, termios.B115200)
            termios.tcsetattr(self._fd, termios.TCSANOW, mode)
        except termios.error as error:
            raise Absent(f"{self.where}: not a serial port: {error.args[-1]}") from error

    def send(self, data: bytes) -> None:
        """Write all bytes."""
        try:
            while data:
                if not select.select([], [self._fd], [], 1.0)[1]:
                    raise Unsafe(f"{self.where}: takes no bytes")
                data = data[os.write(self._fd, data) :]
        except OSError as error:
            raise Unsafe(f"{self.where}: cannot write: {error.strerror}") from error

    def expect(self, wanted: bytes, timeout_s: float) -> bool:
        """Read until `wanted` has been seen; False if it does not come."""
        deadline_s = time.monotonic() + timeout_s
        seen = b""
        while wanted not in seen:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0 or not select.select([self._fd], [], [], left_s)[0]:
                return False
            try:
                data = os.read(self._fd, 4096)
            except OSError:
                return False
            if not data:
                return False
            seen = (seen + data)[-4096:]
        return True


def connect(address: str) -> socket.socket:
    """TCP connection to ``host:port``."""
    host, _, port = address.rpartition(":")
    return socket.create_connection((host, int(port)), 1.0)


# --- guide, trigger, array -----------------------------------------------------------------------------------


def guide(where: str, baud: int) -> str:
    """Soft reset of the Grbl board, at once and again after the restart that opening the port may have caused."""
    wire = Wire(where, baud)
    wire.send(b"\x18")
    if wire.held:
        raise Unsafe(f"{where}: held by another program; sent a reset, but its banner cannot be read")
    for _ in range(2):
        if wire.expect(b"Grbl ", CONFIRM_S / 2):
            wire.send(b"M5 S0\n")
            return "laser off: the controller confirmed a reset"
        wire.send(b"\x18")
    raise Unsafe(f"{where}: no Grbl banner after a reset; check the laser, use the emergency stop")


def trigger(where: str, baud: int) -> str:
    """No pulse from any edge."""
    wire = Wire(where, baud)
    wire.send(b"\n:PULSE0:STATE OFF\n")
    if wire.held or not wire.expect(b"ok", CONFIRM_S):
        raise Unsafe(f"{where}: sent :PULSE0:STATE OFF, no ok came back")
    return "trigger unit disarmed"


def array(where: str, baud: int) -> str:
    """No emission is waiting; a dialect without ABOR says so in its error queue, which *CLS empties."""
    wire = Wire(where, baud)
    wire.send(b"\nABOR\n*CLS\n*OPC?\n")
    if wire.held or not wire.expect(b"1", CONFIRM_S):
        raise Unsafe(f"{where}: sent ABOR, no *OPC? came back")
    return "array digitiser aborted"


# --- robot ---------------------------------------------------------------------------------------------------


class SocketcandBus:
    """CAN frames through a socketcand server."""

    def __init__(self, address: str, channel: str) -> None:
        try:
            self._wire = connect(address)
            self._text = ""
            for request in ("", f"< open {channel} >", "< rawmode >"):
                self._wire.sendall(request.encode("ascii"))
                reply = self._reply(time.monotonic() + 1.0)
                if reply not in ("hi", "ok"):
                    raise Unsafe(f"robot: socketcand at {address} answers {reply!r} to {request!r}")
        except OSError as error:
            raise Absent(f"robot: no socketcand server at {address}: {error.strerror or error}") from error

    def _reply(self, deadline_s: float) -> str | None:
        while ">" not in self._text:
            left_s = deadline_s - time.monotonic()
            if left_s <= 0 or not select.select([self._wire], [], [], left_s)[0]:
                return None
            data = self._wire.recv(4096)
            if not data:
                return None
            self._text += data.decode("ascii", "replace")
        reply, _, self._text = self._text.partition(">")
        return reply.strip("< ")

    def send(self, cob_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        self._wire.sendall(f"< send {cob_id:03X} {len(data)} {' '.join(f'{b:x}' for b in data)} >".encode("ascii"))

    def receive(self, deadline_s: float) -> tuple[int, bytes] | None:
        """The next frame, or None at the deadline."""
        while (reply := self._reply(deadline_s)) is not None:
            parts = reply.split(" ")
            if parts[0] == "frame" and len(parts) >= 4:
                return int(parts[1], 16), bytes.fromhex(parts[3])
        return None


class SocketCanBus:
    """CAN frames through the kernel."""

    def __init__(self, channel: str) -> None:
        try:
            self._wire = socket.socket(socket.AF_CAN, socket.SOCK_RAW, socket.CAN_RAW)
            self._wire.bind((channel,))
        except OSError as error:
            raise Absent(f"robot: no CAN interface {channel}: {error.strerror}") from error

    def send(self, cob_id: int, data: bytes) -> None:
        """Put a frame on the bus."""
        self._wire.send(struct.pack("=IB3x8s", cob_id, len(data), data))

    def receive(self, deadline_s: float) -> tuple[int, bytes] | None:
        """The next frame, or None at the deadline."""
        left_s = deadline_s - time.monotonic()
        if left_s <= 0 or not select.select([self._wire], [], [], left_s)[0]:
            return None
        cob_id, length, data = struct.unpack("=IB3x8s", self._wire.recv(16))
        return cob_id & 0x7FF, data[:length]


def ask(bus: SocketcandBus | SocketCanBus, nodes: list[int], request: bytes) -> dict[int, bytes]:
    """Send one SDO request to each node and collect the answers of half a second."""
    for node in nodes:
        bus.send(0x600 + node, request)
    answers: dict[int, bytes] = {}
    deadline_s = time.monotonic() + 0.5
    while len(answers) < len(nodes):
        frame = bus.receive(deadline_s)
        if frame is None:
            break
        node = frame[0] - 0x580
        if node in nodes and frame[1][1:4] == request[1:4]:
            answers[node] = frame[1]
    return answers


def stop_axes(bus: SocketcandBus | SocketCanBus, nodes: list[int]) -> str:
    """Quick stop, then wait until no axis is in OPERATION ENABLED any more."""
    try:
        ask(bus, nodes, QUICK_STOP)
        deadline_s = time.monotonic() + CONFIRM_S
        while True:
            answers = ask(bus, nodes, READ_STATUS)
            enabled = [n for n, a in answers.items() if a[0] != 0x80 and a[4] & 0x6F == 0x27]
            if not enabled or time.monotonic() > deadline_s:
                break
    except OSError as error:
        raise Unsafe(f"robot: the CAN bus broke: {error.strerror or error}") from error
    if not answers:
        return "no axis answers: taken as switched off"
    silent = [n for n in nodes if n not in answers]
    if enabled or silent:
        raise Unsafe(f"robot: nodes still enabled {enabled}, nodes without answer {silent}; use the emergency stop")
    return f"{len(answers)} axes stopped"


def robot(where: str, nodes: list[int]) -> str:
    """``host:port/channel`` for socketcand, a bare channel for SocketCAN."""
    if ":" not in where:
        return stop_axes(SocketCanBus(where), nodes)
    address, _, channel = where.partition("/")
    return stop_axes(SocketcandBus(address, channel or "can0"), nodes)


# --- command line --------------------------------------------------------------------------------------------

SERIAL: dict[str, Callable[[str, int], str]] = {"guide": guide, "trigger": trigger, "array": array}
SECTION = {"cameras": "trigger"}
"""The cameras' service owns the trigger unit."""


def from_rig(device: str, path: str) -> str:
    """Read ports and nodes from the rig file."""
    with open(path, "rb") as file:  # noqa: PTH123 - pathlib costs start-up time before the laser is off
        section: dict[str, Any] = tomllib.load(file)[device]
    if device != "robot":
        return SERIAL[device](section["port"], section.get("baud", 115200))
    interface, channel = section.get("interface", "socketcand"), section.get("channel", "can0")
    nodes = [int(node) for node in section.get("nodes", NODES)]
    if interface == "socketcand":
        return robot(f"{section.get('host', '127.0.0.1')}:{section.get('port', 29536)}/{channel}", nodes)
    if interface == "socketcan":
        return robot(channel, nodes)
    return f"interface {interface!r} has no wire: nothing to do"


def main(arguments: list[str]) -> int:
    """Make one device safe; returns the exit code."""
    device = SECTION.get(arguments[0], arguments[0]) if arguments else ""
    if device not in (*SERIAL, "robot") or len(arguments) < 2 or arguments[1:] == ["--rig"]:
        sys.stderr.write(f"usage:\n{__doc__}")
        return 2
    try:
        if arguments[1] == "--rig":
            done = from_rig(device, arguments[2])
        elif device == "robot":
            done = robot(arguments[1], [int(node) for node in arguments[2:]] or NODES)
        else:
            done = SERIAL[device](arguments[1], int(arguments[2]) if len(arguments) > 2 else 115200)
    except Absent as absent:
        done = f"absent, nothing to make safe: {absent}"
    except Unsafe as unsafe:
        sys.stderr.write(f"safe {device}: NOT CONFIRMED: {unsafe}\n")
        return 1
    except (OSError, KeyError, ValueError) as error:
        sys.stderr.write(f"safe {device}: cannot tell where the device is: {error!r}\n")
        return 2
    sys.stdout.write(f"safe {device}: {done}\n")
    return 0


if __name__ == "__main__":
    sys.exit(main(sys.argv[1:]))
