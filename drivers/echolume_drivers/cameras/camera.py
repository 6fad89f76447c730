"""What a consumer needs of a camera, and the checks that all of our drivers share."""

from __future__ import annotations

from abc import ABC, abstractmethod
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from echolume_messages.errors import DeviceFaultError, ProtocolError
from echolume_messages.rig import CameraSettings
from echolume_messages.types import Frame


@dataclass(frozen=True)
class CameraFrame:
    """One frame as the camera delivered it."""

    pixels: Frame
    """uint8, shape (rows, columns)."""
    frame_id: int
    """The camera's own count since ``start``; a gap means a lost frame, a repeat a duplicate."""
    device_t_ns: int
    """The camera's own clock at the start of the exposure."""
    exposure_s: float | None
    """None where the camera does not know."""


class Camera(Protocol):
    """A triggered camera: one frame for each pulse on its trigger line."""

    def open(self) -> None:
        """Take hold of the camera and check that it is as the rig file says; a second call changes nothing."""
        ...

    def start(self) -> None:
        """Take triggers from now on; frame ids start anew."""
        ...

    @property
    def software_trigger(self) -> bool:
        """Whether no trigger wire reaches this camera: then `trigger` has to be called for every pulse."""
        ...

    def trigger(self) -> None:
        """Take one frame; from any thread, also while another one reads. Cameras on the trigger wire ignore it."""
        ...

    def read(self, timeout_s: float) -> CameraFrame:
        """The next frame; ``DeviceSilentError`` if none comes in time."""
        ...

    def stop(self) -> None:
        """Take no more triggers, and forget the frames that were not read."""
        ...

    def close(self) -> None:
        """Let go of the camera; allowed at any time, and more than once."""
        ...


class CheckedCamera(ABC):
    """Keeps a driver's calls in order and its frames in shape; drivers fill in the hooks."""

    def __init__(self, settings: CameraSettings, name: str) -> None:
        self.settings = settings
        self.name = name
        self._is_open = False
        self._is_started = False

    @property
    def where(self) -> str:
        """How messages name this camera."""
        return f"camera {self.name} ({self.settings.driver} at {self.settings.address})"

    def open(self) -> None:
        """See `Camera`."""
        if not self._is_open:
            self._open()
            self._is_open = True

    def start(self) -> None:
        """See `Camera`."""
        self._require(self._is_open, "start", "open")
        if not self._is_started:
            self._start()
            self._is_started = True

    @property
    def software_trigger(self) -> bool:
        """See `Camera`."""
        return False

    def trigger(self) -> None:
        """See `Camera`."""
        self._require(self._is_started, "trigger", "start")

    def read(self, timeout_s: float) -> CameraFrame:
        """See `Camera`."""
        self._require(self._is_started, "read", "start")
        frame = self._read(timeout_s)
        expected = (self.settings.height_px, self.settings.width_px)
        if frame.pixels.shape != expected or frame.pixels.dtype != np.uint8:
            raise ProtocolError(
                f"{self.where}: frame {frame.frame_id}: expected uint8 {expected}, "
                f"got {frame.pixels.dtype} {frame.pixels.shape}; set width_px and height_px in the rig file"
            )
        return frame

    def stop(self) -> None:
        """See `Camera`."""
        if self._is_started:
            self._is_started = False
            self._stop()

    def close(self) -> None:
        """See `Camera`."""
        was_open, self._is_open, self._is_started = self._is_open, False, False
        if was_open:
            self._close()

    def _require(self, held: bool, call: str, before: str) -> None:
        if not held:
            raise DeviceFaultError(f"{self.where}: {call}() before {before}(); call {before}() first")

    @abstractmethod
    def _open(self) -> None: ...

    @abstractmethod
    def _start(self) -> None: ...

    @abstractmethod
    def _read(self, timeout_s: float) -> CameraFrame: ...

    @abstractmethod
    def _stop(self) -> None: ...

    @abstractmethod
    def _close(self) -> None: ...
