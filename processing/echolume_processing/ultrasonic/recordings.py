"""Pulse-echo recordings of one emitter and its receivers, envelopes only, with where the target really was."""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import ConfigError
from echolume_messages.geometry import Points3

BLIND_SAMPLES = 13
"""First samples of an envelope, in which the emitter rings and is heard directly."""
PADDING = 2
"""Columns after the last sample in the file."""


@dataclass(frozen=True)
class Recordings:
    """Envelopes of one emitter and its receivers, and where the target really was."""

    frames: NDArray[np.float64]
    """With the target, (recordings, channels, samples)."""
    backgrounds: NDArray[np.float64]
    """The same without it."""
    target_mm: Points3
    elements_mm: Points3
    """One per channel; the emitter is at the origin."""
    sample_rate_hz: float

    def chosen(self, which: NDArray[np.bool_]) -> Recordings:
        """Only these recordings, (recordings,)."""
        return Recordings(
            self.frames[which], self.backgrounds[which], self.target_mm[which], self.elements_mm, self.sample_rate_hz
        )


def load_recordings(path: Path) -> Recordings:
    """Read `frames`, `background` and `target_mm` of an ``.npz`` of one emitter and three receivers at 22 kHz.

    Raises
    ------
    ConfigError
        If the file cannot be read, or an array is missing or of another shape.
    """
    try:
        # Opened here: of a damaged file np.load would leave its own handle open.
        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as data:
            frames, backgrounds, target = (np.asarray(data[k]) for k in ("frames", "background", "target_mm"))
    except KeyError as error:
        raise ConfigError(f"{path}: expected frames, background and target_mm in it: {error.args[0]}") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot read the recordings: {error.strerror or error}") from error
    except (ValueError, TypeError, AttributeError, EOFError, zipfile.BadZipFile, zlib.error) as error:
        raise ConfigError(f"{path}: not an .npz of plain arrays, or a damaged one") from error
    if (
        frames.ndim != 3
        or frames.shape[1] != 4
        or backgrounds.shape != frames.shape
        or target.shape != (len(frames), 3)
        or len(frames) < 2
        or frames.shape[2] <= BLIND_SAMPLES + PADDING
    ):
        raise ConfigError(
            f"{path}: expected frames and background (n, 4, samples) and target_mm (n, 3) of 2 recordings or more, "
            f"got {frames.shape}, {backgrounds.shape} and {target.shape}"
        )
    if not all(a.dtype.kind in "iuf" and bool(np.isfinite(a).all()) for a in (frames, backgrounds, target)):
        raise ConfigError(f"{path}: expected finite numbers in frames, background and target_mm")
    elements = np.array([[0, 0, 0], [-37.5, -64.95, 0], [75, 0, 0], [-37.5, 64.95, 0]], dtype=np.float64)
    kept = slice(0, frames.shape[2] - PADDING)
    return Recordings(
        frames[:, :, kept].astype(np.float64),
        backgrounds[:, :, kept].astype(np.float64),
        target.astype(np.float64),
        elements,
        22e3,
    )
