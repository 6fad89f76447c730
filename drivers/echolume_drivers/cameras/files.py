"""Driver that replays a folder of images as if a camera had taken them: one image for each trigger."""

from __future__ import annotations

import threading
import time
from pathlib import Path

import numpy as np

from echolume_drivers.cameras.camera import CameraFrame, CheckedCamera
from echolume_messages.errors import DeviceAbsentError, DeviceSilentError, ProtocolError
from echolume_messages.rig import CameraSettings

SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".bmp", ".tif", ".tiff", ".pgm"})


class FilesCamera(CheckedCamera):
    """`settings.address` is the folder; its images come in the order of their names, in grey."""

    def __init__(self, settings: CameraSettings, name: str) -> None:
        super().__init__(settings, name)
        self._images: tuple[Path, ...] = ()
        self._next = 0
        self._pulses = threading.Semaphore(0)

    @property
    def software_trigger(self) -> bool:
        """No wire leads to a folder."""
        return True

    def trigger(self) -> None:
        """Let `read` have one more image."""
        super().trigger()
        self._pulses.release()

    def _open(self) -> None:
        folder = Path(self.settings.address)
        try:
            self._images = tuple(sorted(p for p in folder.iterdir() if p.suffix.lower() in SUFFIXES))
        except OSError as error:
            raise DeviceAbsentError(f"{self.where}: cannot list the folder: {error.strerror}") from error
        if not self._images:
            raise DeviceAbsentError(f"{self.where}: no images in the folder; expected {', '.join(sorted(SUFFIXES))}")

    def _start(self) -> None:
        self._next = 0
        self._pulses = threading.Semaphore(0)

    def _read(self, timeout_s: float) -> CameraFrame:
        import cv2

        if not self._pulses.acquire(timeout=timeout_s):
            raise DeviceSilentError(f"{self.where}: no frame within {timeout_s} s: it was not triggered")
        if self._next >= len(self._images):
            raise DeviceSilentError(
                f"{self.where}: no frame {self._next + 1}: only {len(self._images)} images in the folder"
            )
        path = self._images[self._next]
        self._next += 1
        pixels = cv2.imread(str(path), cv2.IMREAD_GRAYSCALE)
        if pixels is None:
            raise ProtocolError(f"{self.where}: {path.name} is not an image")
        return CameraFrame(np.asarray(pixels, dtype=np.uint8), self._next, time.monotonic_ns(), None)

    def _stop(self) -> None:
        self._next = 0

    def _close(self) -> None:
        self._images = ()
