"""The rig file (TOML): which devices hang on which wires, and where the bus and the archive are."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

import msgspec

from echolume_messages.errors import ConfigError


class BusSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The message bus; loopback unless configured."""

    endpoint: str = "tcp/127.0.0.1:7447"
    shared_memory: bool = False
    journal_s: float = 5.0
    journal_mib: int = 256


class GuideSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The Grbl controller of the linear guide and the laser."""

    port: str
    baud: int = 115200
    feed_mm_per_min: float = 6000.0
    laser_power: int = 500
    """S value of M3, 0 to 1000."""
    min_mm: float = -150.0
    max_mm: float = 150.0
    position_sigma_mm: float = 0.01
    x_home_mm: float = 0.0
    """x_mm = machine position + x_home_mm."""


class TriggerSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The pulse generator that fires both cameras."""

    port: str
    baud: int = 115200


class CameraSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """One camera: ``emulated`` (``address`` is host:port) or ``files`` (``address`` is a folder of images)."""

    driver: str = "emulated"
    address: str
    width_px: int = 1280
    height_px: int = 1024


class CamerasSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Both cameras; the left one is the one at negative x."""

    left: CameraSettings
    right: CameraSettings


class RobotSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Six CiA 402 axes: x, y, z (counts per mm) and rx, ry, rz (counts per degree)."""

    interface: Literal["socketcand", "socketcan", "virtual"] = "socketcand"
    channel: str = "can0"
    host: str = "127.0.0.1"
    port: int = 29536
    nodes: tuple[int, int, int, int, int, int] = (1, 2, 3, 4, 5, 6)
    counts_per_mm: float = 1000.0
    counts_per_deg: float = 1000.0
    speed_mm_per_s: float = 200.0
    speed_deg_per_s: float = 60.0
    pose_sigma_mm: float = 0.02


class ArrayElementLayout(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Where the elements sit on the array, in the array frame: x, y in its plane, z towards the scene."""

    emitter_mm: tuple[float, float, float] = (0.0, 0.0, 0.0)
    receivers_mm: list[tuple[float, float, float]] = msgspec.field(
        default_factory=lambda: [
            (x, y, 0.0) for y in (-15.0, 0.0, 15.0) for x in (-15.0, 0.0, 15.0) if (x, y) != (0.0, 0.0)
        ]
    )
    radius_mm: float = 6.2
    low_hz: float = 30e3
    high_hz: float = 60e3


class ArraySettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """The digitiser of the ultrasonic array and the array's nominal build."""

    port: str
    baud: int = 115200
    sample_rate_hz: float = 250e3
    samples: int = 1024
    start_s: float = 0.0
    pulse: Literal["wideband", "paper"] = "wideband"
    """``wideband``: 30-60 kHz; ``paper``: 40 kHz, Q 20, 8 cycles."""
    layout: ArrayElementLayout = msgspec.field(default_factory=ArrayElementLayout)
    nominal_flange_from_array_mm_deg: tuple[float, float, float, float, float, float] = (0, 0, 0, 180, 0, 0)
    """How the array was built on: x, y, z, rx, ry, rz; the calibration finds the rest. 180 deg: looks down."""


class RecorderSettings(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Where raw archives go."""

    directory: str
    sync_ms: float = 50.0


class Rig(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """A whole rig."""

    name: str
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
        return msgspec.toml.decode(text, type=Rig)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{where}: {error}") from error


def load(path: Path) -> Rig:
    """Read a rig file."""
    try:
        return parse(path.read_text(encoding="utf-8"), str(path))
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the rig file: {error.strerror}") from error
