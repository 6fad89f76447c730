"""Localise a small target with one emitter and N receivers from envelopes alone, without phase.

A frame is an envelope with the target, a background one without. Both are magnitudes of sums of many echoes, so what
the target adds is found in their powers; it is then projected back onto a grid of places.
"""

from __future__ import annotations

import zipfile
import zlib
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, signal

from echolume_messages.errors import ConfigError
from echolume_messages.geometry import Points3, require_shape

UPSAMPLING = 8
SMOOTHING = 0.5
"""Standard deviation of the smoothing of an envelope, in its samples."""
BLIND_SAMPLES = 8
"""First samples, in which the emitter still rings."""
PLATEAU = 0.02
"""Places whose score is this close to the best one, and near it, are averaged."""
NEAR_MM = 25.0


@dataclass(frozen=True)
class Recordings:
    """Envelopes of one emitter and its receivers, and where the target really was."""

    frames: NDArray[np.float64]
    """(recordings, channels, samples)."""
    backgrounds: NDArray[np.float64]
    target_mm: Points3
    elements_mm: Points3
    """One per channel; the emitter is at the origin."""
    sample_rate_hz: float


@dataclass(frozen=True)
class Localiser:
    """What the calibration found: delay of each channel in samples, at one speed of sound."""

    delays: NDArray[np.float64]
    elements_mm: Points3
    sample_rate_hz: float
    speed_mps: float = 343.2


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
        or frames.shape[2] <= BLIND_SAMPLES + 2
    ):
        raise ConfigError(
            f"{path}: expected frames and background (n, 4, samples) and target_mm (n, 3) of 2 recordings or more, "
            f"got {frames.shape}, {backgrounds.shape} and {target.shape}"
        )
    if not all(a.dtype.kind in "iuf" and bool(np.isfinite(a).all()) for a in (frames, backgrounds, target)):
        raise ConfigError(f"{path}: expected finite numbers in frames, background and target_mm")
    elements = np.array([[0, 0, 0], [-37.5, -64.95, 0], [75, 0, 0], [-37.5, 64.95, 0]], dtype=np.float64)
    kept = slice(0, frames.shape[2] - 2)  # the last two columns are padding
    return Recordings(
        frames[:, :, kept].astype(np.float64),
        backgrounds[:, :, kept].astype(np.float64),
        target.astype(np.float64),
        elements,
        22e3,
    )


def paths_mm(places_mm: Points3, elements_mm: Points3) -> NDArray[np.float64]:
    """Path origin -> place -> element, (places, channels)."""
    back = np.linalg.norm(places_mm[:, None, :] - elements_mm, axis=2)
    return np.linalg.norm(places_mm, axis=1)[:, None] + back


def target_envelopes(frames: NDArray[np.float64], backgrounds: NDArray[np.float64]) -> NDArray[np.float64]:
    """What the target adds to each envelope, its largest value 1, (recordings, channels, UPSAMPLING * samples).

    Notes
    -----
    |b + e|^2 - |b|^2 = |e|^2 + 2 |b||e| cos(phase): where the background is weak this is the target's own power.
    """
    require_shape("frames", frames, (None, None, None))
    added = np.sqrt(np.maximum(frames**2 - backgrounds**2, 0.0))
    fine = np.asarray(signal.resample_poly(added, UPSAMPLING, 1, axis=2), dtype=np.float64)
    fine = np.maximum(ndimage.gaussian_filter1d(fine, SMOOTHING * UPSAMPLING, axis=2), 0.0)
    fine[:, :, : BLIND_SAMPLES * UPSAMPLING] = 0.0
    peak = fine.max(axis=2, keepdims=True)
    return fine / np.where(peak > 0, peak, 1.0)


def calibrate_delays(recordings: Recordings, chosen: NDArray[np.bool_], speed_mps: float = 343.2) -> Localiser:
    """Find the constant delay of each channel from recordings with known targets: the largest mean envelope there."""
    envelopes = target_envelopes(recordings.frames[chosen], recordings.backgrounds[chosen])
    arrive = paths_mm(recordings.target_mm[chosen], recordings.elements_mm) / (1e3 * speed_mps)
    arrive = arrive * recordings.sample_rate_hz
    candidates = np.arange(-4.0, 8.0, 1.0 / UPSAMPLING)
    last = envelopes.shape[2] - 1
    rows = np.arange(len(envelopes))[:, None]
    delays = np.zeros(envelopes.shape[1])
    for channel in range(len(delays)):
        at = np.rint((arrive[:, channel, None] + candidates) * UPSAMPLING).astype(np.int64)
        delays[channel] = candidates[np.argmax(envelopes[rows, channel, np.clip(at, 0, last)].mean(axis=0))]
    return Localiser(delays, recordings.elements_mm, recordings.sample_rate_hz, speed_mps)


def search_grid(half_mm: float = 110.0, depth_mm: tuple[float, float] = (60.0, 260.0), step_mm: float = 4.0) -> Points3:
    """Places in front of the emitter, (places, 3)."""
    side = np.arange(-half_mm, half_mm + 0.5 * step_mm, step_mm)
    depth = np.arange(depth_mm[0], depth_mm[1] + 0.5 * step_mm, step_mm)
    return np.stack(np.meshgrid(side, side, depth, indexing="ij"), axis=-1).reshape(-1, 3)


def localise(
    localiser: Localiser, frames: NDArray[np.float64], backgrounds: NDArray[np.float64], grid_mm: Points3
) -> Points3:
    """Place of the target in each recording by back-projection of its envelopes onto a grid, (recordings, 3).

    Parameters
    ----------
    frames, backgrounds : (recordings, channels, samples) float64
    grid_mm : (places, 3) float64
    """
    require_shape("grid_mm", grid_mm, (None, 3))
    envelopes = target_envelopes(frames, backgrounds).astype(np.float32)
    arrive = paths_mm(grid_mm, localiser.elements_mm) / (1e3 * localiser.speed_mps) * localiser.sample_rate_hz
    at = np.rint((arrive + localiser.delays) * UPSAMPLING).astype(np.int64)
    at = np.clip(at, 0, envelopes.shape[2] - 1)
    out = np.empty((len(envelopes), 3))
    for k, envelope in enumerate(envelopes):
        score = np.sum([row[at[:, c]] for c, row in enumerate(envelope)], axis=0)
        best = int(np.argmax(score))
        close = np.flatnonzero(score >= (1 - PLATEAU) * score[best])
        close = close[np.linalg.norm(grid_mm[close] - grid_mm[best], axis=1) < NEAR_MM]
        out[k] = grid_mm[close].mean(axis=0)
    return out


@dataclass(frozen=True)
class Score:
    """3D error over the recordings that the calibration did not see, in mm."""

    calibrated_on: int
    scored_on: int
    median_mm: float
    mean_mm: float
    p90_mm: float
    delays: list[float]


def score(recordings: Recordings) -> Score:
    """Calibrate the delays on even-numbered recordings, localise in the odd ones."""
    even = np.arange(len(recordings.frames)) % 2 == 0
    localiser = calibrate_delays(recordings, even)
    found = localise(localiser, recordings.frames[~even], recordings.backgrounds[~even], search_grid())
    error = np.linalg.norm(found - recordings.target_mm[~even], axis=1)
    return Score(
        int(np.count_nonzero(even)),
        len(error),
        float(np.median(error)),
        float(np.mean(error)),
        float(np.percentile(error, 90)),
        localiser.delays.tolist(),
    )
