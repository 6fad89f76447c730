"""The rig file (TOML): which devices hang on which wires, and where the bus and the archive are."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import msgspec

from echolume_messages.errors import ConfigError
from echolume_messages.files import read_text

Finite = Annotated[float, msgspec.Meta(ge=-1e6, le=1e6)]
Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e9)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0, le=1e6)]
Count = Annotated[int, msgspec.Meta(ge=1, le=10_000_000)]
Pixels = Annotated[int, msgspec.Meta(ge=1, le=65536)]
PortNumber = Annotated[int, msgspec.Meta(ge=1, le=65535)]
Node = Annotated[int, msgspec.Meta(ge=1, le=127)]
Text = Annotated[str, msgspec.Meta(min_length=1)]
Place3 = tuple[Finite, Finite, Finite]


class BusSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The message bus; loopback unless configured."""

    endpoint: Annotated[str, msgspec.Meta(pattern="^[a-z0-9_-]+/.+")] = "tcp/127.0.0.1:7447"
    """``<protocol>/<address>``."""
    shared_memory: bool = False
    journal_s: Positive = 5.0
    journal_mib: Count = 256


class GuideSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The Grbl controller of the linear guide and the laser."""

    port: Text
    baud: Count = 115200
    feed_mm_per_min: Positive = 6000.0
    laser_power: Annotated[int, msgspec.Meta(ge=0, le=1000)] = 500
    """S value of M3, 0 to 1000."""
    min_mm: Finite = -150.0
    max_mm: Finite = 150.0
    position_sigma_mm: NotNegative = 0.01
    x_home_mm: Finite = 0.0
    """x_mm = machine position + x_home_mm."""


class TriggerSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The pulse generator that fires both cameras."""

    port: Text
    baud: Count = 115200


class CameraSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """One camera: ``emulated`` (``address`` is host:port) or ``files`` (``address`` is a folder of images)."""

    driver: Text = "emulated"
    address: Text
    width_px: Pixels = 1280
    height_px: Pixels = 1024


class CamerasSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Both cameras; the left one is the one at negative x."""

    left: CameraSettings
    right: CameraSettings


class RobotSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Six CiA 402 axes: x, y, z (counts per mm) and rx, ry, rz (counts per degree)."""

    interface: Literal["socketcand", "socketcan", "virtual"] = "socketcand"
    channel: str = "can0"
    host: str = "127.0.0.1"
    port: PortNumber = 29536
    nodes: tuple[Node, Node, Node, Node, Node, Node] = (1, 2, 3, 4, 5, 6)
    counts_per_mm: Positive = 1000.0
    counts_per_deg: Positive = 1000.0
    speed_mm_per_s: Positive = 200.0
    speed_deg_per_s: Positive = 60.0
    pose_sigma_mm: NotNegative = 0.02


class ArrayElementLayout(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Where the elements sit on the array, in the array frame: x, y in its plane, z towards the scene."""

    emitter_mm: Place3 = (0.0, 0.0, 0.0)
    receivers_mm: Annotated[list[Place3], msgspec.Meta(min_length=8, max_length=8)] = msgspec.field(
        default_factory=lambda: [
            (x, y, 0.0) for y in (-15.0, 0.0, 15.0) for x in (-15.0, 0.0, 15.0) if (x, y) != (0.0, 0.0)
        ]
    )
    radius_mm: Positive = 6.2
    low_hz: Positive = 30e3
    high_hz: Positive = 60e3


class ArraySettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The digitiser of the ultrasonic array and the array's nominal build."""

    port: Text
    baud: Count = 115200
    sample_rate_hz: Positive = 250e3
    samples: Annotated[int, msgspec.Meta(ge=1, le=250_000)] = 1024
    start_s: NotNegative = 0.0
    pulse: Literal["wideband", "paper"] = "wideband"
    """``wideband``: 30-60 kHz; ``paper``: 40 kHz, Q 20, 8 cycles."""
    layout: ArrayElementLayout = msgspec.field(default_factory=ArrayElementLayout)
    nominal_flange_from_array_mm_deg: tuple[Finite, Finite, Finite, Finite, Finite, Finite] = (0, 0, 0, 180, 0, 0)
    """How the array was built on: x, y, z, rx, ry, rz; the calibration finds the rest. 180 deg: looks down."""


class RecorderSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Where raw archives go."""

    directory: Annotated[str, msgspec.Meta(pattern="^/")]
    """Absolute: services run in folders of their own."""
    sync_ms: Positive = 50.0


class Rig(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """A whole rig."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[^/*$#?\s]+$", max_length=100)]
    """Part of every key on the bus."""
    bus: BusSettings = msgspec.field(default_factory=BusSettings)
    guide: GuideSettings
    trigger: TriggerSettings
    cameras: CamerasSettings
    robot: RobotSettings
    array: ArraySettings
    recorder: RecorderSettings
    calibration: str = ""
    """Path of calibration.json; empty while there is none."""


def parse(text: str, where: str = "rig") -> Rig:
    """Read a rig from TOML text; errors carry the path, e.g. ``rig.toml: ... - at `$.guide```."""
    try:
        rig = msgspec.toml.decode(text, type=Rig)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{where}: {error}") from error
    _check(rig, where)
    return rig


def _check(rig: Rig, where: str) -> None:
    """What no single value is to blame for."""
    guide, sound, nodes = rig.guide, rig.array.layout, rig.robot.nodes
    if not guide.min_mm < guide.max_mm:
        raise ConfigError(f"{where}: min_mm {guide.min_mm} is not below max_mm {guide.max_mm} - at `$.guide`")
    if not sound.low_hz < sound.high_hz:
        raise ConfigError(f"{where}: low_hz {sound.low_hz} is not below high_hz {sound.high_hz} - at `$.array.layout`")
    if len(set(nodes)) < len(nodes):
        raise ConfigError(f"{where}: two axes have the same node, {list(nodes)} - at `$.robot.nodes`")


def load(path: Path) -> Rig:
    """Read a rig file."""
    return parse(read_text(path, "the rig file"), str(path))
