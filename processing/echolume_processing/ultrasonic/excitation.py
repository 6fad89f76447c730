"""Drives for the emitter that the matched filter compresses: bursts, chirps, and phase-coded bursts."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import signal
from scipy.signal.windows import tukey

BARKER = {
    7: (1, 1, 1, -1, -1, 1, -1),
    11: (1, 1, 1, -1, -1, -1, 1, -1, -1, 1, -1),
    13: (1, 1, 1, 1, 1, -1, -1, 1, 1, -1, 1, -1, 1),
}
"""Barker's codes: no side lobe of their correlation exceeds 1."""


def burst(carrier_hz: float, duration_s: float, sample_rate_hz: float) -> NDArray[np.float64]:
    """A few cycles of a sine, (samples,), amplitude 1."""
    time_s = np.arange(round(duration_s * sample_rate_hz)) / sample_rate_hz
    return np.sin(2 * np.pi * carrier_hz * time_s)


def chirp(low_hz: float, high_hz: float, duration_s: float, sample_rate_hz: float) -> NDArray[np.float64]:
    """A sine that rises linearly from one frequency to another, with faded ends, (samples,), amplitude 1.

    Notes
    -----
    Compressed it is as short as 1 / (high - low); over a pulse of that length and the same height it gains
    duration times bandwidth in signal to noise (power). A tenth of the length fades at either end, against side lobes.
    """
    samples = round(duration_s * sample_rate_hz)
    if samples < 8 or not 0 < low_hz < high_hz < 0.5 * sample_rate_hz:
        raise ValueError(
            f"a chirp needs 8 samples and 0 < low < high < half the sample rate; got {samples} samples from "
            f"{low_hz} to {high_hz} Hz at {sample_rate_hz} Hz"
        )
    time_s = np.arange(samples) / sample_rate_hz
    phase_rad = 2 * np.pi * (low_hz * time_s + 0.5 * (high_hz - low_hz) / duration_s * time_s**2)
    return np.sin(phase_rad) * np.asarray(tukey(samples, 0.2), dtype=np.float64)


def coded(
    code: Sequence[int] | NDArray[np.int64], carrier_hz: float, cycles: int, sample_rate_hz: float
) -> NDArray[np.float64]:
    """A sine whose sign follows a code of 1 and -1, so many cycles a chip, (samples,), amplitude 1."""
    signs = np.asarray(code, dtype=np.float64)
    if not np.all(np.abs(signs) == 1) or cycles < 1:
        raise ValueError(f"a code holds 1 and -1 and each chip a cycle at least; got {list(code)}, {cycles} cycles")
    samples = round(len(signs) * cycles / carrier_hz * sample_rate_hz)
    time_s = np.arange(samples) / sample_rate_hz
    chip = np.minimum((time_s * carrier_hz / cycles).astype(np.int64), len(signs) - 1)
    return signs[chip] * np.sin(2 * np.pi * carrier_hz * time_s)


def pseudo_random(order: int) -> NDArray[np.int64]:
    """Maximum-length sequence of 2^order - 1 chips of 1 and -1."""
    return 2 * np.asarray(signal.max_len_seq(order)[0], dtype=np.int64) - 1
