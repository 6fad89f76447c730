"""The scenes of the emulated rig, by name or from a file."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

from echolume_drivers.emulated import scene_file
from echolume_drivers.emulated.scene_model import (
    CLEAR_AIR,
    ELSEWHERE,
    Air,
    Expectation,
    Material,
    Scene,
)
from echolume_drivers.emulated.shapes import SceneBuilder
from echolume_messages.errors import ConfigError

__all__ = [
    "CLEAR_AIR",
    "ELSEWHERE",
    "SCENES",
    "Air",
    "Expectation",
    "Material",
    "Scene",
    "SceneBuilder",
    "block",
    "demo",
    "matte",
    "named",
    "plate",
]


def _shipped(name: str) -> Scene:
    return scene_file.build(scene_file.shipped(name), f"{name}.toml")


SCENES: dict[str, Callable[[], Scene]] = {name: partial(_shipped, name) for name in scene_file.shipped_names()}


def named(name: str, folder: Path = Path()) -> Scene:
    """The scene of a name, or of a file: what ends in ``.toml``, relative to `folder`.

    Raises
    ------
    ConfigError
        There is none of that name, or the file is wrong.
    """
    if name.endswith(".toml"):
        return scene_file.load(folder / name)
    if name not in SCENES:
        raise ConfigError(f"unknown scene {name!r}; known: {', '.join(SCENES)}, or a scene file NAME.toml")
    return SCENES[name]()


def demo() -> Scene:
    """A stair of 10/20/30/40 mm, bars 20 and 12 mm wide, a glass plate 30 mm above the base, a black block."""
    return SCENES["demo"]()


def matte() -> Scene:
    """The demo's shapes, all matte: nothing may be called transparent."""
    return SCENES["matte"]()


def block() -> Scene:
    """The calibration block that both senses see: 60 x 44 mm, 25 mm high, off the middle."""
    return SCENES["block"]()


def plate(z_mm: float = 0.0) -> Scene:
    """A matte reference plate over the whole field."""
    return SceneBuilder("plate").box((-120, 120), (-120, 120), z_mm).build()
