"""Sound that goes straight from the emitter to a receiver beside it, and what is left of it when an echo arrives.

The paper takes the energy below a 1 kHz envelope. Long after a burst has passed, its envelope still dies away in the
filter; where the plate is near and the receiver nearer, that rest lies below the echo's envelope and adds to it.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import numpy as np
from numpy.typing import NDArray
from scipy import fft, signal

from echolume_processing.ultrasonic.envelope import CUTOFF_HZ

CARRIER_HZ = 40_000.0
CYCLES = 8
QUALITY = 20.0
"""The transducers of which the paper says nothing: a burst of eight cycles, resonance of emitter and receiver."""
SPEED_MM_PER_S = 343_200.0
RATE_HZ = 200_000.0
LONGEST_S = 0.012


@dataclass(frozen=True)
class CrossTalk:
    """Direct sound beside the echo, as energy below the paper's envelope from a sweep's first echo on."""

    level: float
    """Amplitude of what a receiver gets sideways, over what it would get face to face at the same distance."""
    quality: float = QUALITY
    cycles: int = CYCLES

    def energy(
        self, amplitudes: NDArray[np.float64], paths_mm: NDArray[np.float64], apart_mm: float
    ) -> NDArray[np.float64]:
        """Energy of echo and direct sound together, in units of an echo of amplitude 1; shape of the amplitudes.

        Parameters
        ----------
        amplitudes, paths_mm : float64
            Of all echoes of a sweep, the amplitudes in 1/mm as of a point source; the gate opens with the first.
        apart_mm : float
            Emitter to receiver.

        Notes
        -----
        The burst is over when the echo comes, so the rectified signals add: their envelopes, not their carriers.
        With e(t) the envelope of a burst, A and X / apart the amplitudes and d the delay of the echo behind the direct
        sound, the energy is the integral over the gate of (A e(t) + X / apart e(t + d))^2.
        """
        overlap, rest = _overlap(self.quality, self.cycles)
        late = (paths_mm - apart_mm) / SPEED_MM_PER_S * RATE_HZ
        steps = np.arange(len(rest))
        direct = self.level / apart_mm
        both = 2 * amplitudes * direct * np.interp(late, steps, overlap)
        return amplitudes**2 + both + direct**2 * np.interp(late.min(), steps, rest)


@lru_cache(maxsize=32)
def _overlap(quality: float, cycles: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How a burst's envelope overlaps itself, later by each number of steps of 5 us, as shares of its energy.

    Parameters
    ----------
    quality : float
        Of the emitter's and of the receiver's resonance at 40 kHz.
    cycles : int
        Length of the burst.

    Returns
    -------
    (n,), (n,) float64
        Integral over t > 0 of e(t) e(t + d), and of e(t + d)^2.
    """
    time_s = np.arange(round(LONGEST_S * RATE_HZ)) / RATE_HZ
    ring = np.exp(-time_s * np.pi * CARRIER_HZ / quality)
    burst = (time_s < cycles / CARRIER_HZ).astype(np.float64)
    for _ in ("emitter", "receiver"):
        burst = np.asarray(signal.fftconvolve(burst, ring), dtype=np.float64)[: len(time_s)]
    low_pass = signal.butter(3, CUTOFF_HZ, fs=RATE_HZ, output="sos")
    envelope = np.asarray(signal.sosfilt(low_pass, burst), dtype=np.float64)
    length = 2 * len(envelope)
    power = np.abs(np.asarray(fft.rfft(envelope, length))) ** 2
    overlap = np.asarray(fft.irfft(power, length), dtype=np.float64)[: len(envelope)]
    rest = np.cumsum(envelope[::-1] ** 2)[::-1]
    return overlap / rest[0], rest / rest[0]
