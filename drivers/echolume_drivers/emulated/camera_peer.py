"""A wire-level camera: takes trigger pulses, renders what it would see, and speaks `cameras.wire` over TCP."""

from __future__ import annotations

import queue
import select
import selectors
import socket
import threading
import time
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from echolume_drivers.cameras.wire import LEADER, LINE_BYTES, PACKET_BYTES, TRAILER, Kind, pack
from echolume_drivers.emulated.board_image import render_board
from echolume_drivers.emulated.optics import OpticalTruth, Side
from echolume_drivers.emulated.scene import Scene
from echolume_drivers.emulated.stage import Board, Stage
from echolume_drivers.emulated.stripe_image import render_stripe
from echolume_messages.types import Frame

SEND_S = 2.0
"""A host that takes nothing for so long is let go."""

FAULTS = {
    "drop": "the next `count` frames never come (their ids are used up)",
    "duplicate": "the next `count` frames come twice",
    "late": "the next `count` frames come `delay_s` later",
    "truncate": "the next frame ends in its middle, then the camera hangs up",
    "corrupt": "the next `count` frames arrive with a flipped byte",
    "wrong_size": "the next `count` frames are half as high",
    "hang": "no answers and no frames until `recover`",
    "absent": "nobody listens until `recover`",
    "recover": "all faults end",
}


class Shot(NamedTuple):
    """What a trigger pulse caught."""

    session: int
    block: int
    t_ns: int
    exposure_s: float
    x_mm: float
    laser_on: bool
    scene: Scene
    board: Board | None
    rng: np.random.Generator


@dataclass
class _Fault:
    name: str
    left: int
    delay_s: float


class CameraPeer:
    """One emulated camera.

    Parameters
    ----------
    stage
        What it sees: scene or board, guide, laser.
    side
        ``left`` or ``right``.
    truth
        The optics to render with.
    """

    def __init__(self, stage: Stage, side: Side, truth: OpticalTruth) -> None:
        self.stage = stage
        self.side: Side = side
        self.truth = truth
        camera = truth.camera(side)
        self._features = {
            "DeviceModelName": "echolume emulated camera",
            "Width": str(camera.width_px),
            "Height": str(camera.height_px),
            "PixelFormat": "Mono8",
            "ExposureMode": "TriggerWidth",
            "ExposureTime": "4000.0",
            "TriggerMode": "Off",
            "TriggerSource": "Line1",
        }
        self._lock = threading.Lock()
        self._sending = threading.Lock()
        self._shots: queue.Queue[Shot | None] = queue.Queue(maxsize=4)
        self._closing = threading.Event()
        self._awake = threading.Event()
        self._awake.set()
        self._fault: _Fault | None = None
        self._host: socket.socket | None = None
        self._acquiring = False
        self._blocks = 0
        self._session = 0
        self.missed = 0
        """Pulses that came while the camera was not ready for them."""
        self._epoch_ns = time.monotonic_ns()
        self._listener: socket.socket | None = None
        self._port = 0
        self._selector = selectors.DefaultSelector()
        self._threads: list[threading.Thread] = []

    @property
    def address(self) -> str:
        """host:port of the camera; valid after `start`."""
        return f"127.0.0.1:{self._port}"

    @property
    def url(self) -> str:
        """The address as a URL."""
        return f"tcp://{self.address}"

    def start(self) -> None:
        """Listen, and be ready for pulses."""
        self._wake_out, self._wake_in = socket.socketpair()
        self._selector.register(self._wake_out, selectors.EVENT_READ, self._obey)
        self._orders: queue.Queue[Callable[[], None]] = queue.Queue()
        self._listen()
        for name, work in (("wire", self._serve), ("sensor", self._develop)):
            thread = threading.Thread(target=work, name=f"camera-{self.side}-{name}", daemon=True)
            thread.start()
            self._threads.append(thread)

    def close(self) -> None:
        """Hang up, stop both threads and free the port."""
        if self._closing.is_set() or not self._threads:
            return
        self._closing.set()
        self._awake.set()
        self._order(lambda: None)
        self._shots.put(None)
        for thread in self._threads:
            thread.join(timeout=SEND_S + 3)
        self._drop_host(self._host)
        self._unlisten()
        self._selector.close()
        self._wake_in.close()
        self._wake_out.close()

    def inject(self, fault: str, count: int = 1, delay_s: float = 0.5) -> None:
        """Make something go wrong; see `FAULTS`."""
        if fault not in FAULTS:
            raise ValueError(f"camera-{self.side}: unknown fault {fault!r}; known: {', '.join(FAULTS)}")
        if fault == "recover":
            with self._lock:
                self._fault = None
            self._awake.set()
            if self._listener is None:
                self._order(self._listen)
        elif fault == "hang":
            self._awake.clear()
        elif fault == "absent":
            self._order(self._vanish)
        else:
            with self._lock:
                self._fault = _Fault(fault, count, delay_s)

    def fire(self, exposure_s: float | None = None) -> None:
        """A pulse on the trigger line; its width is the exposure. What it catches is fixed here and now."""
        with self.stage.lock:
            x_mm = float(self.stage.guide_x_mm())
            caught = (self.stage.carriage_mm(), self.stage.laser_on, self.stage.scene, self.stage.board)
        t_ns = time.monotonic_ns()
        with self._lock:
            if not self._acquiring or self._features["TriggerMode"] != "On" or self._shots.full():
                self.missed += 1
                return
            if exposure_s is None or self._features["ExposureMode"] == "Timed":
                exposure_s = float(self._features["ExposureTime"]) * 1e-6
            rng = self.stage.noise(f"camera-{self.side}", np.array([x_mm]))
            self._blocks += 1
            self._shots.put_nowait(Shot(self._session, self._blocks, t_ns, exposure_s, *caught, rng))

    # --- the sensor's thread

    def _develop(self) -> None:
        while (shot := self._shots.get()) is not None:
            if self._closing.is_set():
                continue
            pixels = self._render(shot)
            read_out_s = shot.t_ns * 1e-9 + shot.exposure_s - time.monotonic()
            self._closing.wait(max(0.0, read_out_s))
            self._deliver(shot, pixels)

    def _render(self, shot: Shot) -> Frame:
        light = (shot.exposure_s, shot.laser_on)
        if shot.board is not None:
            return render_board(shot.board, self.truth, self.side, shot.x_mm, shot.rng, *light)
        return render_stripe(shot.scene, self.truth, self.side, shot.x_mm, shot.rng, *light)

    def _deliver(self, shot: Shot, pixels: Frame) -> None:
        with self._lock:
            fault = self._fault
            if fault is not None:
                fault.left -= 1
                if fault.left <= 0:
                    self._fault = None
        name = fault.name if fault else ""
        if name == "drop":
            return
        if fault is not None and name == "late":
            self._closing.wait(fault.delay_s)
        self._awake.wait()
        if name == "wrong_size":
            pixels = pixels[: pixels.shape[0] // 2]
        messages = self._messages(shot, pixels)
        if name == "truncate":
            host = self._send([b"".join(messages[:2])[:-1000]], shot.session)
            self._order(lambda: self._drop_host(host))
            return
        if name == "corrupt":
            damaged = bytearray(messages[1])
            damaged[len(damaged) // 2] ^= 0x40
            messages[1] = bytes(damaged)
        for _ in range(2 if name == "duplicate" else 1):
            self._send(messages, shot.session)

    def _messages(self, shot: Shot, pixels: Frame) -> list[bytes]:
        payload = memoryview(pixels.tobytes())
        size = len(payload)
        leader = LEADER.pack(shot.t_ns - self._epoch_ns, pixels.shape[1], pixels.shape[0], shot.exposure_s, size)
        parts = [pack(Kind.PAYLOAD, shot.block, payload[k : k + PACKET_BYTES]) for k in range(0, size, PACKET_BYTES)]
        trailer = TRAILER.pack(size, zlib.crc32(payload))
        return [pack(Kind.LEADER, shot.block, leader), *parts, pack(Kind.TRAILER, shot.block, trailer)]

    def _send(self, messages: list[bytes], session: int | None = None) -> socket.socket | None:
        """Send to the host, if there is one, and return it; one that is gone or takes nothing is let go.

        Frames of an acquisition that was stopped meanwhile (another `session`) are thrown away.
        """
        with self._sending:
            host = self._host
            if host is None or session not in (None, self._session):
                return None
            try:
                for message in messages:
                    host.sendall(message)
            except OSError:
                self._order(lambda: self._drop_host(host))
            return host

    # --- the wire's thread

    def _order(self, work: Callable[[], None]) -> None:
        """Have the wire's thread do something."""
        self._orders.put(work)
        self._wake_in.send(b".")

    def _obey(self) -> None:
        self._wake_out.recv(1)
        self._orders.get_nowait()()

    def _serve(self) -> None:
        while not self._closing.is_set():
            for key, _ in self._selector.select():
                key.data()

    def _listen(self) -> None:
        if self._listener is None:
            self._listener = socket.create_server(("127.0.0.1", self._port), reuse_port=False)
            self._port = int(self._listener.getsockname()[1])
            self._selector.register(self._listener, selectors.EVENT_READ, self._accept)

    def _unlisten(self) -> None:
        listener, self._listener = self._listener, None
        if listener is not None:
            self._selector.unregister(listener)
            listener.close()

    def _vanish(self) -> None:
        self._unlisten()
        self._drop_host(self._host)

    def _accept(self) -> None:
        if self._listener is None:
            return
        host, _ = self._listener.accept()
        if self._host is not None and _hung_up(self._host):
            self._drop_host(self._host)
        host.settimeout(SEND_S)
        host.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        if self._host is not None:
            with host:
                host.sendall(pack(Kind.REPLY, 0, b"error access denied: another host controls this camera"))
                # Closing with unread bytes would reset the connection before the refusal is read.
                host.shutdown(socket.SHUT_WR)
                _drain(host)
            return
        self._line = b""
        with self._sending:
            self._host = host
        self._selector.register(host, selectors.EVENT_READ, self._hear)

    def _drop_host(self, host: socket.socket | None) -> None:
        """Let go of this host; if another one has taken its place, that one stays."""
        if host is None or host is not self._host:
            return
        with self._lock:
            self._acquiring = False
            self._session += 1
        with self._sending:
            self._host = None
        self._selector.unregister(host)
        host.close()

    def _hear(self) -> None:
        if self._host is None:
            return
        try:
            data = self._host.recv(4096)
        except OSError:
            data = b""
        if not data or len(self._line) > LINE_BYTES:
            self._drop_host(self._host)
            return
        *lines, self._line = (self._line + data).split(b"\n")
        for line in lines:
            if self._awake.is_set():
                self._send([pack(Kind.REPLY, 0, self._answer(line.decode("utf-8", "replace")).encode())])

    def _answer(self, line: str) -> str:
        verb, _, rest = line.strip().partition(" ")
        name, _, value = rest.partition(" ")
        with self._lock:
            if verb == "get" and name in self._features:
                return f"ok {self._features[name]}"
            if verb == "set" and name in _WRITABLE:
                if not _WRITABLE[name](value):
                    return f"error {name} cannot be {value!r}"
                self._features[name] = value
                return "ok"
            if verb == "set" and name in self._features:
                return f"error {name} cannot be written"
            if verb == "run" and name in ("AcquisitionStart", "AcquisitionStop"):
                self._acquiring = name == "AcquisitionStart"
                self._blocks = 0
                self._session += 1
                return "ok"
        return f"error unknown feature {name}" if verb in ("get", "set", "run") else f"error unknown verb {verb}"


def _is_exposure(text: str) -> bool:
    try:
        return 1.0 <= float(text) <= 1e6
    except ValueError:
        return False


_WRITABLE: dict[str, Callable[[str], bool]] = {
    "ExposureTime": _is_exposure,
    "ExposureMode": lambda text: text in ("Timed", "TriggerWidth"),
    "TriggerMode": lambda text: text in ("On", "Off"),
    "TriggerSource": lambda text: text in ("Line1", "Software"),
}


def _hung_up(port: socket.socket) -> bool:
    """Whether the other side is gone and nothing it sent is left to read."""
    waiting = select.poll()
    waiting.register(port, select.POLLIN)
    if not waiting.poll(0):
        return False
    try:
        return port.recv(1, socket.MSG_PEEK) == b""
    except OSError:
        return True


def _drain(port: socket.socket, limit_s: float = 0.2) -> None:
    """Read until the other side hangs up, for a short while."""
    port.settimeout(limit_s)
    try:
        while port.recv(4096):
            pass
    except OSError:
        return
