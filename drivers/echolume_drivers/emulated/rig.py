"""The emulated rig: every device's peer on one stage, in one process."""

from __future__ import annotations

import contextlib
import socket
import threading
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Literal, Protocol, TypeVar

import msgspec
import numpy as np

from echolume_drivers.emulated.array_peer import ArrayPeer
from echolume_drivers.emulated.array_truth import ArrayTruth, array_truth
from echolume_drivers.emulated.board_image import board_at, board_poses, render_board
from echolume_drivers.emulated.camera_peer import CameraPeer
from echolume_drivers.emulated.control import ADDRESS_FILE, ControlServer, Json
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.flaws import ROOMS
from echolume_drivers.emulated.grbl_peer import GrblPeer
from echolume_drivers.emulated.optics import OpticalTruth, Side, optical_truth
from echolume_drivers.emulated.robot_peer import RobotPeer
from echolume_drivers.emulated.scene import Air, Material, Scene, SceneBuilder, named
from echolume_drivers.emulated.shapes import Body, plane_through
from echolume_drivers.emulated.stage import Stage
from echolume_drivers.emulated.stripe_image import render_stripe
from echolume_drivers.emulated.trigger_peer import TriggerPeer
from echolume_messages.errors import ConfigError
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

Pulse = Literal["wideband", "paper"]
Room = Literal["dark", "bright"]
SIDES: tuple[Side, Side] = ("left", "right")
FASTEST = 1e6
"""Beyond this a speed is rather a slip of the pen."""


class Peer(Protocol):
    """What the rig needs of each device's peer."""

    def start(self) -> None:
        """Open the wire."""
        ...

    def close(self) -> None:
        """Make the device safe and the wire disappear."""
        ...


AnyPeer = TypeVar("AnyPeer", bound=Peer)


class EmulatedRig:
    """All devices of a rig, the control, and the rig file that leads to them.

    Parameters
    ----------
    seed
        Draws the rig's true build and its noise.
    scene_name
        What stands on the bench at first: a name of `scene.SCENES`, or a scene file.
    speed
        How much faster than real the axes move and dwell; deadlines and time stamps stay real.
    pulse
        The array's transducers.
    directory
        Where rig.toml, the control's address and the archives go.
    bare
        Leave out the relay that opens the laser line when the host is gone.
    room
        The light around: a ``dark`` lab, or a ``bright`` room with its lamps on.
    """

    def __init__(
        self,
        seed: int,
        scene_name: str = "demo",
        speed: float = 1.0,
        pulse: Pulse = "wideband",
        directory: Path = Path(),
        *,
        bare: bool = False,
        room: Room = "dark",
    ) -> None:
        if not 0 < speed <= FASTEST:
            raise ConfigError(f"emulated rig: speed must be above 0 and at most {FASTEST:g}, got {speed}")
        if seed < 0:
            raise ConfigError(f"emulated rig: seed must not be below 0, got {seed}")
        self._directory = directory.resolve()
        self._stage = Stage(seed, named(scene_name), speed)
        self._seed = seed
        self._poses = board_poses(seed)
        self._truth = optical_truth(seed, ROOMS[room])
        self._array_settings = ArraySettings(port="", pulse=pulse)
        self._sound = array_truth(seed, self._array_settings)
        self._bare = bare
        self._rig: Rig | None = None
        self.cameras: dict[Side, CameraPeer] = {}
        """Both cameras by side, after `start`; for tests."""
        self._opened = contextlib.ExitStack()
        self._quit = threading.Event()

    def __enter__(self) -> EmulatedRig:
        self.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    @property
    def rig(self) -> Rig:
        """The configuration that leads to this rig; valid after `start`."""
        if self._rig is None:
            raise ConfigError("emulated rig: it was not started yet")
        return self._rig

    @property
    def rig_file(self) -> Path:
        """rig.toml of this rig; it appears when all devices are ready."""
        return self._directory / "rig.toml"

    @property
    def control_address(self) -> str:
        """host:port of the control; valid after `start`."""
        return self._control.address

    @property
    def stage(self) -> Stage:
        """What the devices share; for tests."""
        return self._stage

    def start(self) -> None:
        """Start all devices, then write the rig file."""
        self._directory.mkdir(parents=True, exist_ok=True)
        try:
            self._start_devices()
        except BaseException:
            self.close()
            raise

    def _start_devices(self) -> None:
        sound = self._sound
        _warm_up(self._stage, self._truth, self._array_settings, sound)
        guide = self._begin(GrblPeer(self._stage, bare=self._bare))
        robot = self._begin(RobotPeer(self._stage))
        left = self._begin(CameraPeer(self._stage, "left", self._truth))
        right = self._begin(CameraPeer(self._stage, "right", self._truth))
        trigger = self._begin(TriggerPeer(self._stage, [left, right]))
        array = self._begin(ArrayPeer(self._stage, self._array_settings, sound))
        self._devices = {
            "guide": guide.inject,
            "robot": robot.inject,
            "camera-left": left.inject,
            "camera-right": right.inject,
            "trigger": trigger.inject,
            "array": array.inject,
        }
        self.cameras = {"left": left, "right": right}
        self._control = ControlServer(
            {
                "place": self._place,
                "truth": self._write_truth,
                "fault": self._inject,
                "status": self._status,
                "quit": self._end,
            }
        )
        self._begin(self._control)
        self._rig = Rig(
            name=f"emulated-{self._seed}",
            bus=BusSettings(endpoint=f"tcp/127.0.0.1:{_free_port()}"),
            guide=GuideSettings(port=guide.url),
            trigger=TriggerSettings(port=trigger.url),
            cameras=CamerasSettings(
                left=CameraSettings(address=left.address), right=CameraSettings(address=right.address)
            ),
            robot=RobotSettings(host=robot.address[0], port=robot.address[1]),
            array=msgspec.structs.replace(self._array_settings, port=array.url),
            recorder=RecorderSettings(directory=str(self._directory / "archive")),
        )
        self._opened.callback(self._unlink)
        (self._directory / ADDRESS_FILE).write_text(self._control.address + "\n", encoding="utf-8")
        fresh = self._directory / "rig.toml.new"
        fresh.write_text(toml_text(self._rig), encoding="utf-8")
        fresh.replace(self.rig_file)

    def _begin(self, peer: AnyPeer) -> AnyPeer:
        self._opened.callback(peer.close)
        peer.start()
        return peer

    def _unlink(self) -> None:
        for path in (self.rig_file, self._directory / ADDRESS_FILE):
            path.unlink(missing_ok=True)

    def close(self) -> None:
        """Laser off, and no PTY, port, thread or rig file left; a second call changes nothing."""
        self._stage.switch_laser(False)
        self._opened.close()

    def wait(self, timeout_s: float) -> bool:
        """Wait for the control's ``quit``; True if it came."""
        return self._quit.wait(timeout_s)

    # --- operations of the control

    def _place(self, request: Json) -> Json:
        match request:
            case {"scene": str(name)}:
                try:
                    scene = named(name)
                except ConfigError as error:
                    raise ValueError(str(error)) from error
                _see_and_hear(scene, self._truth, self._array_settings, self._sound)
                self._stage.place(scene=scene)
            case {"board": int(index)} if not isinstance(index, bool):
                if not 0 <= index < len(self._poses):
                    raise ValueError(f"board pose {index} is not among 0..{len(self._poses) - 1}")
                self._stage.place(board=board_at(self._poses[index]))
            case {"board": list(rows)}:
                pose = np.array(rows, dtype=np.float64)
                if pose.shape != (4, 4) or not np.allclose(pose[:3, :3] @ pose[:3, :3].T, np.eye(3), atol=1e-6):
                    raise ValueError("board is no rigid 4x4 matrix")
                self._stage.place(board=board_at(pose))
            case _:
                raise ValueError("give scene (a name or a file) or board (an index or a 4x4 matrix)")
        return {}

    def _write_truth(self, request: Json) -> Json:
        path = Path(str(request["path"]))
        scene = self._stage.scene
        with path.open("wb") as sink:
            np.savez(
                sink,
                front_mm=scene.front_mm,
                optical_mm=scene.optical_mm,
                material=scene.material,
                x0_mm=scene.x0_mm,
                y0_mm=scene.y0_mm,
                cell_mm=scene.cell_mm,
                region=scene.region_image,
                regions=np.array(scene.regions),
                expect=np.array(msgspec.json.encode(scene.expect).decode()),
            )
        return {"path": str(path), "scene": scene.name}

    def _inject(self, request: Json) -> Json:
        device, fault = str(request.pop("device", "")), str(request.pop("fault", ""))
        if device not in self._devices:
            raise ValueError(f"unknown device {device!r}; known: {', '.join(self._devices)}")
        self._devices[device](fault, **request)
        return {}

    def _status(self, _request: Json) -> Json:
        with self._stage.lock:
            board = self._stage.board
            return {
                "laser_on": self._stage.laser_on,
                "guide_x_mm": float(self._stage.guide_x_mm()),
                "robot_pose": [float(v) for v in self._stage.robot_pose()],
                "scene": self._stage.scene.name,
                "board": None if board is None else board.rig_from_board.tolist(),
                "missed": [camera.missed for camera in self.cameras.values()],
                "seed": self._stage.seed,
                "speed": self._stage.speed,
            }

    def _end(self, _request: Json) -> Json:
        self._quit.set()
        return {}


def toml_text(rig: Rig) -> str:
    """The rig file's text, with every setting spelt out."""
    lines: list[str] = ["# Written by the emulated rig; valid while it runs."]
    _table(lines, "", msgspec.to_builtins(rig))
    return "\n".join(lines) + "\n"


def _table(lines: list[str], path: str, content: Json) -> None:
    if path:
        lines += ["", f"[{path}]"]
    tables: dict[str, Json] = {}
    for key, value in content.items():
        if isinstance(value, dict):
            tables[key] = value
        else:
            # JSON's strings, numbers, booleans and arrays are TOML's too.
            lines.append(f"{key} = {msgspec.json.encode(value).decode()}")
    for key, table in tables.items():
        _table(lines, f"{path}.{key}" if path else key, table)


def _free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def _warm_up(stage: Stage, optics: OpticalTruth, array: ArraySettings, sound: ArrayTruth) -> None:
    """Compile the forward models and trace the cameras' rays before the first trigger needs them."""
    rng = np.random.default_rng(0)
    board = board_at(np.eye(4))
    for side in SIDES:
        for laser_on in (True, False):
            render_board(board, optics, side, 0.0, rng, 1e-3, laser_on)
    for scene in (something_of_everything(), stage.scene):
        _see_and_hear(scene, optics, array, sound)


def _see_and_hear(scene: Scene, optics: OpticalTruth, array: ArraySettings, sound: ArrayTruth) -> None:
    """Have a scene's facets and planes ready before the first trigger meets it."""
    rng = np.random.default_rng(0)
    for side in SIDES:
        for laser_on in (True, False):
            render_stripe(scene, optics, side, 0.0, rng, 1e-3, laser_on)
    pose = np.array([0.0, 0.0, 150.0, 0.0, 0.0, 0.0])
    simulate_ping(scene, sound.rig_from_array(pose), array, sound, 22.0, rng)


def something_of_everything() -> Scene:
    """A scene that needs each forward model: tilted glass, a mirror, smoke."""
    builder = SceneBuilder("everything")
    tilted = plane_through(0.0, 0.0, 30.0, (0.1, 0.1))
    builder.put(Body(builder.rectangle((-20, 20), (-20, 20)), tilted, Material.GLASS, 3.0))
    builder.box((-20, 20), (20, 40), 5.0, Material.MIRROR)
    return replace(builder.build(), air=Air(smoke_per_m=0.1))
