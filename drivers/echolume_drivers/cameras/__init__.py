"""Cameras: what a consumer needs of one, and the drivers by name."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from importlib.metadata import entry_points
from typing import cast

from echolume_drivers.cameras.camera import Camera, CameraFrame
from echolume_messages.errors import ConfigError
from echolume_messages.rig import CameraSettings

__all__ = ["Camera", "CameraFrame", "make_camera", "open_camera"]

_OWN = {
    "emulated": ("echolume_drivers.cameras.emulated", "EmulatedCamera"),
    "files": ("echolume_drivers.cameras.files", "FilesCamera"),
}


def make_camera(settings: CameraSettings, name: str) -> Camera:
    """A camera of the driver that the rig file asks for, not opened yet.

    Drivers of other makers register as ``camera.<driver>`` in the entry point group ``echolume.drivers``; theirs is
    called with the settings and the name too.

    Raises
    ------
    ConfigError
        If there is no such driver.
    """
    if settings.driver in _OWN:
        module, attribute = _OWN[settings.driver]
        maker: object = getattr(import_module(module), attribute)
    else:
        found = entry_points(group="echolume.drivers", name=f"camera.{settings.driver}")
        if not found:
            raise ConfigError(
                f"rig: $.cameras.{name}.driver: {settings.driver!r} is not installed; known: {', '.join(_OWN)}"
            )
        maker = next(iter(found)).load()
    return cast("Callable[[CameraSettings, str], Camera]", maker)(settings, name)


def open_camera(settings: CameraSettings, name: str) -> Camera:
    """An opened camera; ``camera.start()`` makes it take triggers.

    Raises
    ------
    DeviceError
        If the camera is absent, held by another process, or not as the rig file says.
    """
    camera = make_camera(settings, name)
    camera.open()
    return camera
