"""A rig of fake devices behind the real services, on a real bus on loopback."""

from __future__ import annotations

import queue
import secrets
import threading
import time
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from echolume_daemon import array, cameras, conductor, guide, robot
from echolume_messages.bus import Bus, connect
from echolume_messages.bus.router import open_router
from echolume_messages.errors import DeviceAbsentError, DeviceFaultError
from echolume_messages.header import Header
from echolume_messages.rig import (
    ArraySettings,
    BusSettings,
    CameraSettings,
    CamerasSettings,
    GuideSettings,
    RecorderSettings,
    Rig,
    RobotSettings,
    TriggerSettings,
)
from echolume_messages.topics import CAMERA_LEFT, CAMERA_RIGHT, DURABLE, ECHOES, LEDGER, SCAN_START
from loopback import free_endpoint

DEADLINE_S = 20.0


def make_rig(endpoint: str, directory: Path) -> Rig:
    """A rig whose devices are all absent unless given to the services."""
    camera = CameraSettings(address="127.0.0.1:1", width_px=8, height_px=8)
    return Rig(
        name="bench",
        bus=BusSettings(endpoint=endpoint),
        guide=GuideSettings(port=str(directory / "no-guide")),
        trigger=TriggerSettings(port=str(directory / "no-trigger")),
        cameras=CamerasSettings(left=camera, right=camera),
        robot=RobotSettings(port=1),
        array=ArraySettings(port="socket://127.0.0.1:1"),
        recorder=RecorderSettings(directory=str(directory)),
    )


def wait_until(condition: Callable[[], bool], what: str, deadline_s: float = DEADLINE_S) -> None:
    """Poll until `condition` holds; fails with `what` after the deadline."""
    pause = threading.Event()
    end_s = time.monotonic() + deadline_s
    while not condition():
        assert time.monotonic() < end_s, f"not within {deadline_s} s: {what}"
        pause.wait(0.01)


@dataclass
class FakeFrame:
    pixels: np.ndarray
    frame_id: int
    device_t_ns: int
    exposure_s: float


@dataclass
class FakeCamera:
    """Counts pulses; `drop`, `twice` and `blind` hold the numbers of pulses that go wrong."""

    first_id: int = 100
    drop: set[int] = field(default_factory=set)
    twice: set[int] = field(default_factory=set)
    blind: set[int] = field(default_factory=set)
    gone: bool = False
    opened: int = 0

    def __post_init__(self) -> None:
        self._frames: queue.SimpleQueue[FakeFrame] = queue.SimpleQueue()
        self._pulses = 0
        self._id = self.first_id

    def open(self) -> None:
        if self.gone:
            raise DeviceAbsentError("camera-fake at 127.0.0.1:1: not there; plug it in")
        self.opened += 1

    def close(self) -> None: ...

    def start(self) -> None: ...

    def pulse(self, exposure_s: float) -> None:
        self._pulses += 1
        if self._pulses in self.blind:
            return
        frame = FakeFrame(np.full((8, 8), self._pulses % 256, np.uint8), self._id, time.monotonic_ns(), exposure_s)
        self._id += 1
        if self._pulses not in self.drop:
            self._frames.put(frame)
        if self._pulses in self.twice:
            self._frames.put(frame)

    def read(self, timeout_s: float) -> FakeFrame | None:
        if self.gone:
            raise DeviceAbsentError("camera-fake at 127.0.0.1:1: connection lost; plug it in")
        try:
            return self._frames.get(timeout=timeout_s)
        except queue.Empty:
            return None


@dataclass
class FakeTrigger:
    wired: list[FakeCamera]
    armed_s: float | None = None
    pulses: int = 0
    fired_at: dict[int, float | None] = field(default_factory=dict)
    x_mm: float | None = None

    def open(self) -> None: ...
    def close(self) -> None: ...

    def arm_external(self, exposure_s: float) -> None:
        self.armed_s = exposure_s

    def fire(self, exposure_s: float) -> None:
        self.armed_s = None
        self.pulse(exposure_s)

    def disarm(self) -> None:
        self.armed_s = None

    def count(self) -> int:
        return self.pulses

    def pulse(self, exposure_s: float) -> None:
        self.pulses += 1
        self.fired_at[self.pulses] = self.x_mm
        for camera in self.wired:
            camera.pulse(exposure_s)


@dataclass
class FakeStatus:
    state: str = "Idle"
    x_mm: float = 0.0


@dataclass
class FakeGuide:
    trigger: FakeTrigger
    gone: bool = False
    homed: bool = False
    laser: bool = True
    exposed: list[float] = field(default_factory=list)
    on_expose: Callable[[float], None] = lambda _x: None

    def open(self) -> None:
        if self.gone:
            raise DeviceAbsentError("guide at /dev/none: no such port; plug it in")

    def close(self) -> None: ...

    def home(self) -> None:
        self._here()
        self.homed = True

    def move(self, x_mm: float) -> float:
        self._here()
        return x_mm

    def expose(self, x_mm: float, exposure_s: float) -> float:
        self._here()
        if not self.homed:
            raise DeviceFaultError("guide: not homed")
        self.on_expose(x_mm)
        self.laser = True
        self.trigger.x_mm = x_mm
        if self.trigger.armed_s is not None:
            self.trigger.pulse(exposure_s)
        self.laser = False
        self.exposed.append(x_mm)
        return x_mm

    def laser_off(self) -> None:
        self.laser = False

    def stop(self) -> None:
        self.laser = False

    def status(self) -> FakeStatus:
        self._here()
        return FakeStatus()

    def _here(self) -> None:
        if self.gone:
            raise DeviceAbsentError("guide at /dev/none: gone; plug it in")


@dataclass
class FakeRobot:
    at: np.ndarray = field(default_factory=lambda: np.zeros(6))
    enabled: bool = False
    stopped: int = 0

    def open(self) -> None: ...
    def close(self) -> None: ...

    def enable(self) -> None:
        self.enabled = True

    def move(self, pose: np.ndarray) -> np.ndarray:
        self.at = np.array(pose, dtype=np.float64)
        return self.at

    def pose(self) -> np.ndarray:
        return self.at

    def quick_stop(self) -> None:
        self.stopped += 1


@dataclass
class FakePing:
    block: np.ndarray
    sample_rate_hz: float = 250e3
    start_s: float = 0.0
    volts_per_count: float = 1e-4
    device_t_ns: int = 1
    air_temperature_c: float = 21.5


@dataclass
class FakeArray:
    gone: bool = False

    def open(self) -> None:
        if self.gone:
            raise DeviceAbsentError("array at socket://127.0.0.1:1: connection refused; is it on?")

    def close(self) -> None: ...
    def configure(self) -> None: ...

    def ping(self) -> FakePing:
        return FakePing(np.zeros((8, 1024), np.int16))


class FakeRecorder:
    """Acknowledges what it receives, except what `deaf` names as (topic, trigger, attempt)."""

    def __init__(self, bus: Bus) -> None:
        self.bus, self.deaf, self.scan, self.echo = bus, set(), "", False
        self.opened: list[dict] = []
        self.closed: list[str] = []
        self.kept: list[tuple[str, int, int]] = []
        self.frames: dict[tuple[str, int, int], np.ndarray] = {}
        self.headers: dict[tuple[str, int, int], Header] = {}
        self._inbox = bus.subscribe([CAMERA_LEFT, CAMERA_RIGHT, ECHOES, LEDGER, SCAN_START], depth=256)
        self._durable = bus.publisher(DURABLE)
        self._stop = threading.Event()
        bus.serve(
            "recorder", {"open": self._open, "close": self._close, "status": lambda _b: {"archives": {self.scan: {}}}}
        )
        bus.declare_alive("recorder")
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _open(self, body: dict) -> dict:
        self.opened.append(body)
        self.scan = body["scan"]
        return {"path": f"{body.get('directory', '/archive')}/{body['name']}.mcap"}

    def _close(self, body: dict) -> dict:
        self.closed.append(body["scan"])
        return {}

    def _run(self) -> None:
        while not self._stop.is_set():
            message = self._inbox.get(0.05)
            if message is None:
                continue
            header = message.header
            key = (header.stream, header.trigger, header.attempt)
            if key in self.deaf:
                continue
            self.kept.append(key)
            self.frames[key] = message.payload
            self.headers[key] = header
            told = {"scan": header.scan, "durable": {header.stream: header.seq}, "records": [[*key, header.seq]]}
            for _ in range(1 + self.echo):
                self.tell(told | {"count": len(self.kept)})

    def tell(self, what: dict) -> None:
        """Publish a ``recorder/durable``."""
        self._durable.put_json(what)

    def close(self) -> None:
        self._stop.set()
        self._thread.join(2.0)


class Bench:
    """Router (or somebody else's), services with fake devices, fake recorder, and a bus for the test."""

    def __init__(self, directory: Path, endpoint: str = "") -> None:
        self._own_router = not endpoint
        self.rig = make_rig(endpoint or free_endpoint(), directory)
        self.rig.name = f"bench-{secrets.token_hex(4)}"
        self.left, self.right = FakeCamera(), FakeCamera(first_id=7)
        self.trigger = FakeTrigger([self.left, self.right])
        self.guide, self.robot, self.array = FakeGuide(self.trigger), FakeRobot(), FakeArray()
        self._router = ExitStack()
        self._stop = threading.Event()
        self._threads: dict[str, threading.Thread] = {}
        self.codes: dict[str, int] = {}

    def __enter__(self) -> Bench:
        if self._own_router:
            self._router.enter_context(open_router(self.rig.bus.endpoint))
        self.bus = connect(self.rig.bus.endpoint, self.rig.name)
        self.recorder_bus = connect(self.rig.bus.endpoint, self.rig.name)
        self.recorder = FakeRecorder(self.recorder_bus)
        return self

    def start(self, *names: str) -> None:
        """Start services and wait for their tokens."""
        mains = {
            "guide": (guide.main, self.guide),
            "cameras": (cameras.main, cameras.Devices(self.trigger, self.left, self.right)),
            "robot": (robot.main, self.robot),
            "array": (array.main, self.array),
            "conductor": (conductor.main, None),
        }
        for name in names or mains:
            main, device = mains[name]

            def run(name=name, main=main, device=device) -> None:
                self.codes[name] = main(rig=self.rig, device=device, stop=self._stop)

            self._threads[name] = threading.Thread(target=run, name=f"bench-{name}")
            self._threads[name].start()
        wait_until(lambda: set(names or mains) <= self.bus.alive(), "services alive")

    def frames_are_where_they_were_taken(self) -> bool:
        """Whether every frame's position is the one at which its pulse was fired; a frame shows its pulse's number."""
        frames = {key: frame for key, frame in self.recorder.frames.items() if key[0].startswith("cameras/")}
        taken = {key: self.trigger.fired_at[int(frame[0, 0])] for key, frame in frames.items()}
        return bool(taken) and all(self.recorder.headers[key].source.x_mm == x_mm for key, x_mm in taken.items())

    def kill_router(self) -> None:
        """The router is gone from now on."""
        self._router.close()

    def stop(self) -> None:
        """Stop the services and wait for their ends."""
        self._stop.set()
        for thread in self._threads.values():
            thread.join(10.0)
        assert not [name for name, thread in self._threads.items() if thread.is_alive()]

    def __exit__(self, *_: object) -> None:
        self.stop()
        self.recorder.close()
        self.recorder_bus.close()
        self.bus.close()
        self.kill_router()
