"""The onset of an echo as a witness of its own: when its leading edge alone says that it arrived."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import signal

from echolume_messages.geometry import require_shape
from echolume_processing.ultrasonic.echo_kernels import leading_edges
from echolume_processing.ultrasonic.envelope import Waveforms

RISEN = 0.8
"""The leading edge ends where the template's envelope reaches this share of its peak."""


@dataclass(frozen=True)
class LeadingEdge:
    """Filters that fit height and shift of the leading edge of each channel's template."""

    height: NDArray[np.complex64]
    """(receivers, samples); the height is relative to the template's and complex."""
    slope: NDArray[np.complex64]
    """(receivers, samples); their output over the height is the negative shift in samples."""
    lengths: NDArray[np.int64]
    """Samples of each channel's leading edge, (receivers,)."""
    origin: float
    """Sample of the template that belongs to the arrival."""
    sample_rate_hz: float
    noise_gain: NDArray[np.float64]
    """Standard deviation of the shift in samples for white noise as large as the template, (receivers,)."""


def leading_edge(
    templates: Waveforms, origin: float, sample_rate_hz: float, centre_hz: NDArray[np.float64]
) -> LeadingEdge:
    """Filters for the part of each template before its peak.

    Parameters
    ----------
    templates : (receivers, samples) float32
    origin : float
    sample_rate_hz : float
    centre_hz : (receivers,) float64

    Notes
    -----
    The echo's envelope is a (s(t) - shift s'(t)) over the leading edge, with a complex height a: least squares over
    that edge alone. Bandwidth and resonance of the transducer shape an echo's later part; its beginning hardly.
    """
    require_shape("templates", templates, (None, None))
    receivers, samples = templates.shape
    height, slope = np.zeros((2, receivers, samples), dtype=np.complex64)
    lengths, gain = np.empty(receivers, dtype=np.int64), np.empty(receivers)
    for r in range(receivers):
        first, second = _edge_filters(templates[r].astype(np.float64), float(centre_hz[r]) / sample_rate_hz)
        lengths[r] = len(first)
        height[r, : len(first)], slope[r, : len(first)] = first, second
        gain[r] = np.sqrt(0.5 * np.sum(np.abs(second) ** 2))
    longest = int(lengths.max())
    return LeadingEdge(
        np.ascontiguousarray(height[:, :longest]),
        np.ascontiguousarray(slope[:, :longest]),
        lengths,
        origin,
        sample_rate_hz,
        gain,
    )


def _edge_filters(
    template: NDArray[np.float64], centre: float
) -> tuple[NDArray[np.complex128], NDArray[np.complex128]]:
    """Filters of one channel; `centre` in cycles per sample."""
    analytic = np.asarray(signal.hilbert(template), dtype=np.complex128)
    envelope = np.abs(analytic)
    peak = int(envelope.argmax())
    low = np.flatnonzero(envelope[:peak] < RISEN * envelope[peak])
    length = max(8, int(low[-1]) + 1 if low.size else peak)
    carrier = np.exp(2j * np.pi * centre * np.arange(len(template)))
    turning = 2j * np.pi * np.fft.fftfreq(len(template))
    change = np.fft.ifft(np.fft.fft(analytic / carrier) * turning) * carrier
    model = np.array([analytic[:length], change[:length]])
    fade = max(4, length // 3)
    window = np.ones(length)
    window[length - fade :] = np.cos(np.linspace(0, np.pi / 2, fade)) ** 2
    weighted = np.conj(model * window)
    # Twice, because a real record holds half of its analytic signal.
    first, second = 2 * np.linalg.solve(weighted @ model.T, weighted)
    return first, second


def onsets(
    waveforms: Waveforms, edge: LeadingEdge, arrival_s: NDArray[np.float64], white_noise: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """When each channel's leading edge says that its echo arrived, and the sigma of that, (receivers,) each.

    Parameters
    ----------
    waveforms : (receivers, samples) float32
    edge : LeadingEdge
    arrival_s : (receivers,) float64
        What the matched filter found, after the first sample; not a number where nothing.
    white_noise : (receivers,) float64
        Standard deviation of the noise of a sample.
    """
    require_shape("waveforms", waveforms, (len(edge.lengths), None))
    found = np.empty((len(waveforms), 2))
    leading_edges(
        waveforms, edge.height, edge.slope, edge.lengths, arrival_s * edge.sample_rate_hz - edge.origin, found
    )
    sigma = edge.noise_gain * white_noise / np.maximum(found[:, 1], np.finfo(np.float64).tiny)
    return arrival_s + found[:, 0] / edge.sample_rate_hz, sigma / edge.sample_rate_hz
