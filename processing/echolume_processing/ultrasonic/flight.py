"""Time of flight: the first significant echo of each channel, refined by its phase."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_processing.ultrasonic.baseband import Baseband
from echolume_processing.ultrasonic.echo_kernels import refine, search

MAX_PHASE_RAD = 2.2
"""Phase at the envelope's peak beyond which phase and envelope contradict each other (a cycle is 6.28)."""
UNKNOWN_CYCLE = 0.25
"""Of a cycle: sigma where it is unknown which one it is."""
LEAST_NOISE = 1e-3
"""Of the echo: what template and air leave uncertain however quiet the record is."""


@dataclass(frozen=True)
class Arrivals:
    """One echo per channel; every array has shape (receivers,). A channel without echo has `found` False."""

    time_s: NDArray[np.float64]
    """After the first sample, delay of the channel included."""
    amplitude: NDArray[np.float64]
    """Relative to the template's."""
    phase_rad: NDArray[np.float64]
    sigma_s: NDArray[np.float64]
    found: NDArray[np.bool_]
    lobes: NDArray[np.uint8]
    """Echoes within the gate that reach half the threshold."""
    envelope_s: NDArray[np.float64]
    """When the envelope alone, without its phase, says that the echo arrived."""
    envelope_sigma_s: NDArray[np.float64]
    noise: NDArray[np.float64]
    """Standard deviation of the compressed noise, real or imaginary, relative to the template."""
    white_noise: NDArray[np.float64]
    """Standard deviation of the noise of a sample."""
    onset_s: NDArray[np.float64]
    """When the echo's leading edge alone says that it arrived; not a number where nobody has looked."""
    onset_sigma_s: NDArray[np.float64]

    @property
    def doubtful(self) -> NDArray[np.bool_]:
        """Phase and envelope contradict each other, so the cycle is unknown."""
        return self.found & (np.abs(self.phase_rad) > MAX_PHASE_RAD)


def first_arrivals(
    echoes: Baseband,
    gate_s: tuple[float, float],
    threshold: NDArray[np.float32],
    *,
    floor: float = 0.05,
    strongest: bool = False,
) -> Arrivals:
    """Find the first echo of each channel that reaches the threshold, else the strongest above the floor.

    Parameters
    ----------
    echoes : Baseband
        Output of the matched filter.
    gate_s : (first, last)
        Times after the first sample between which an echo may lie.
    threshold : (samples,) float32
        Amplitude that counts as an echo of a surface, falling with distance, at the samples of `echoes`.
    floor : float
        Amplitude, relative to the threshold, below which a channel has no echo at all.
    strongest : bool
        Take the strongest echo rather than the first (one plate, nothing else).

    Notes
    -----
    The echo is looked for at the few samples of the baseband and then refined on its spectrum, which gives it at any
    instant: envelope by Newton's method, phase by the centre frequency. Where phase and envelope disagree by more than
    a third of a cycle, the envelope alone is kept with its own sigma. The wrong cycle is then only taken where the
    envelope errs by two thirds of one.
    """
    receivers, samples = echoes.magnitude.shape
    require_shape("threshold", threshold, (samples,))
    first = min(max(1, int(np.ceil(gate_s[0] * echoes.rate_hz))), samples)
    last = max(first, min(samples - 1, int(gate_s[1] * echoes.rate_hz)))
    start, count = np.empty(receivers), np.empty(receivers, dtype=np.uint8)
    search(echoes.magnitude, np.reciprocal(threshold), first, last, floor, strongest, start, count)
    bank = echoes.bank
    turn = 2 * np.pi * bank.sample_rate_hz / bank.length  # rad per second and bin
    centre = 2 * np.pi * bank.centre_hz / turn
    refined = np.empty((receivers, 4))
    step = turn / echoes.rate_hz
    refine(echoes.products, bank.first_bin, centre, start * step, step, MAX_PHASE_RAD, refined)
    peak, angle, amplitude, phase = refined.T
    found = np.isfinite(angle)
    white = echoes.white_noise(peak / turn, gate_s)
    noise = white * bank.noise_gain
    relative = np.maximum(noise / np.where(found, amplitude, 1.0), LEAST_NOISE)
    sigma_envelope = np.where(found, relative / (2 * np.pi * bank.envelope_error_hz), np.nan)
    sigma_phase = relative / (2 * np.pi * bank.centre_hz)
    unsure = np.maximum(sigma_envelope, UNKNOWN_CYCLE / bank.centre_hz)
    sigma_s = np.where(np.abs(phase) <= MAX_PHASE_RAD, sigma_phase, unsure)
    return Arrivals(
        time_s=angle / turn,
        amplitude=amplitude,
        phase_rad=phase,
        sigma_s=np.where(found, sigma_s, np.nan),
        found=found,
        lobes=count,
        envelope_s=peak / turn,
        envelope_sigma_s=sigma_envelope,
        noise=noise,
        white_noise=white,
        onset_s=np.full(receivers, np.nan),
        onset_sigma_s=np.full(receivers, np.nan),
    )
