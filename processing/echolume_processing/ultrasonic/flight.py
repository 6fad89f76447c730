"""Time of flight: the first significant echo of each channel, refined by its phase."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_processing.ultrasonic.envelope import ComplexEnvelope, MatchedFilter

MAX_PHASE_RAD = 2.2
"""Phase at the envelope's peak beyond which phase and envelope contradict each other (a cycle is 6.28)."""


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


def noise_level(magnitude: NDArray[np.float32]) -> NDArray[np.float64]:
    """Standard deviation of the matched filter's noise per channel (receivers,), from its quietest quarter."""
    # A quarter of Rayleigh-distributed magnitudes lies below 0.7585 sigma.
    quartile = np.partition(magnitude, magnitude.shape[1] // 4, axis=1)[:, magnitude.shape[1] // 4]
    return quartile.astype(np.float64) / 0.7585


def _maxima(magnitude: NDArray[np.float32], first: int, last: int) -> list[NDArray[np.intp]]:
    middle = magnitude[:, first:last]
    is_peak = (middle > magnitude[:, first - 1 : last - 1]) & (middle >= magnitude[:, first + 1 : last + 1])
    return [np.flatnonzero(row) + first for row in is_peak]


def first_arrivals(
    compressed: ComplexEnvelope,
    bank: MatchedFilter,
    sample_rate_hz: float,
    gate: tuple[int, int],
    threshold: NDArray[np.float32],
    *,
    floor: float = 0.05,
    strongest: bool = False,
) -> Arrivals:
    """Find the first echo of each channel that reaches the threshold, else the strongest above the floor.

    Parameters
    ----------
    compressed : (receivers, samples) complex64
        Output of the matched filter.
    bank : MatchedFilter
    sample_rate_hz : float
        Rate of `compressed`.
    gate : (first, last)
        Samples of `compressed` between which an echo may lie.
    threshold : (samples,) float32
        Amplitude that counts as an echo of a surface, falling with distance.
    floor : float
        Amplitude, relative to the threshold, below which a channel has no echo at all.
    strongest : bool
        Take the strongest echo rather than the first (one plate, nothing else).

    Notes
    -----
    The envelope's peak is interpolated by a parabola; the phase there, divided by the centre frequency, refines it.
    Where phase and envelope disagree by more than a third of a cycle, the envelope alone is kept with its own sigma.
    """
    require_shape("compressed", compressed, (None, None))
    magnitude = np.abs(compressed)
    receivers, samples = magnitude.shape
    first, last = max(1, gate[0]), min(samples - 1, gate[1])
    relative = np.asarray(magnitude / threshold, dtype=np.float32)
    noise = noise_level(magnitude[:, first:last])
    time_s, amplitude, phase, sigma = (np.full(receivers, np.nan) for _ in range(4))
    count = np.zeros(receivers, dtype=np.uint8)
    for k, peaks in enumerate(_maxima(relative, first, last)):
        heights = relative[k, peaks]
        count[k] = min(255, int(np.count_nonzero(heights >= 0.5)))
        if not peaks.size or heights.max() < floor:
            continue
        above = np.flatnonzero(heights >= 1.0)
        peak = int(peaks[np.argmax(heights)] if strongest or not above.size else peaks[above[0]])
        reach = max(1, round(0.3 * sample_rate_hz / (2 * np.pi * float(bank.bandwidth_hz[k]))))
        position, value = _vertex(magnitude[k], _climb(magnitude[k], peak), reach)
        angle, slope = _phase_at(compressed[k], position, 2 * np.pi * bank.centre_hz[k] / sample_rate_hz)
        snr = value / max(float(noise[k]), 1e-3 * value)
        if abs(angle) <= MAX_PHASE_RAD:
            position -= angle / slope
            sigma[k] = 1.0 / (2 * np.pi * bank.centre_hz[k] * snr)
        else:
            sigma[k] = max(1.0 / (2 * np.pi * bank.bandwidth_hz[k] * snr), 0.25 / bank.centre_hz[k])
        time_s[k], amplitude[k], phase[k] = position / sample_rate_hz, value, angle
    return Arrivals(time_s, amplitude, phase, sigma, np.isfinite(time_s), count)


def _climb(values: NDArray[np.float32], start: int) -> int:
    """The local maximum uphill of a sample: the threshold's slope moves the maxima of their ratio."""
    peak = start
    while peak > 0 and values[peak - 1] > values[peak]:
        peak -= 1
    while peak + 1 < len(values) and values[peak + 1] > values[peak]:
        peak += 1
    return peak


def _vertex(values: NDArray[np.float32], peak: int, reach: int) -> tuple[float, float]:
    """Position and height of the parabola through a maximum and the values `reach` samples beside it."""
    reach = max(1, min(reach, peak, len(values) - 1 - peak))
    left, middle, right = (float(values[k]) for k in (peak - reach, peak, peak + reach))
    curvature = left - 2 * middle + right
    if curvature >= 0:
        return float(peak), middle
    shift = 0.5 * (left - right) / curvature
    return peak + reach * shift, middle - 0.25 * (left - right) * shift


def _phase_at(row: NDArray[np.complex64], position: float, step_rad: float) -> tuple[float, float]:
    """Phase (rad) at a fractional sample, and its local slope (rad per sample) held near the carrier's."""
    k = int(np.floor(position))
    part = position - k
    a, b = complex(row[k]), complex(row[k + 1])
    turn = complex(np.exp(-1j * step_rad))
    drift = float(np.angle(b * turn * np.conj(a)))
    value = a * (1 - part) * np.exp(1j * step_rad * part) + b * part * np.exp(1j * step_rad * (part - 1))
    return float(np.angle(value)), step_rad + float(np.clip(drift, -0.1 * step_rad, 0.1 * step_rad))
