"""From raw counts and perfect impulses to comparable waveforms: gated complex samples in the array's band."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import transform
from echolume_messages.plan import MapField
from echolume_processing.hybrid.predict import Aperture, Band, Predictor
from echolume_processing.hybrid.scipy_typed import fast_length, fft, ifft, rfft
from echolume_processing.hybrid.surface import surface
from echolume_processing.ping import Ping

BAND_MARGIN = 0.05
"""The band is widened by this share of its edges, where the pulse still has energy."""
EDGE_SHARE = 0.15
"""Cosine edges of the band filter, as a share of its width: a hard edge would ring over the whole gate."""
KELVIN = 273.15


def speed_of_sound(calibration: ArrayCalibration, air_temperature_c: float) -> float:
    """The calibrated speed of sound, carried to the air temperature of a ping (m/s)."""
    return calibration.speed_of_sound_mps * float(
        np.sqrt((KELVIN + air_temperature_c) / (KELVIN + calibration.temperature_c))
    )


def band_of(calibration: ArrayCalibration, ping: Ping) -> Band:
    """The band in which pings of this kind are compared."""
    return Band(
        ping.sample_rate_hz,
        1 << (ping.echoes.shape[1] - 1).bit_length(),
        calibration.low_hz * (1 - BAND_MARGIN),
        calibration.high_hz * (1 + BAND_MARGIN),
    )


@dataclass(frozen=True)
class Channels:
    """The array's electroacoustic response: what turns a predicted impulse into counts."""

    band: Band
    response: NDArray[np.complex64]
    """(receivers, bins): transducers, their delays and gains."""
    filter: NDArray[np.float32]
    """(bins,): the band filter that measured and predicted echoes share."""

    def predicted(self, impulse: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Spectra in counts (receivers, bins) of predicted impulses (receivers, bins)."""
        return impulse * self.response * self.filter

    def measured(self, ping: Ping) -> NDArray[np.complex64]:
        """Spectra in counts (receivers, bins) of a ping, its time zero moved to the emission."""
        counts = ping.echoes.astype(np.float32)
        counts -= counts.mean(axis=1, keepdims=True)
        spectrum = rfft(counts, self.band.length)[:, self.band.bins]
        late = np.exp(-2j * np.pi * self.band.frequency_hz * ping.start_s).astype(np.complex64)
        return (spectrum * late * self.filter).astype(np.complex64)


def channels(calibration: ArrayCalibration, band: Band) -> Channels:
    """Response of each channel: its template over the predicted impulse of the same reference plate.

    Both are of the air of the calibration, so the response is the channels' alone and holds in any air.

    Raises
    ------
    CalibrationRejectedError
        If the templates' sample rate is not that of the pings.
    """
    if abs(calibration.sample_rate_hz - band.sample_rate_hz) > 1e-6 * band.sample_rate_hz:
        raise CalibrationRejectedError(
            f"array templates were taken at {calibration.sample_rate_hz} Hz, the pings at {band.sample_rate_hz} Hz; "
            "run `echolume calibrate array` with the digitiser's present settings"
        )
    plate = _reference_impulse(calibration, Predictor(calibration.radius_mm, calibration.speed_of_sound_mps, band))
    elements = np.array([calibration.emitter_mm, *calibration.receivers_mm])
    image = elements[0] + np.array([0.0, 0.0, 2 * calibration.reference_mm])
    arrival_s = np.linalg.norm(elements[1:] - image, axis=1) / (calibration.speed_of_sound_mps * 1e3)
    templates = np.array(calibration.templates, dtype=np.float64)
    peak = _envelope_peak(templates)
    templates *= (np.array(calibration.gains) / peak)[:, None]
    spectrum = rfft(templates[:, : band.length], band.length)
    spectrum = spectrum[:, band.bins]
    omega = 2 * np.pi * band.frequency_hz
    origin_s = calibration.template_origin / calibration.sample_rate_hz
    spectrum = spectrum * np.exp(1j * omega * origin_s)
    delay_s = arrival_s + np.array(calibration.delays_s)
    spectrum = spectrum * np.exp(-1j * omega * delay_s[:, None])
    return Channels(band, (spectrum / plate).astype(np.complex64), _band_filter(band))


def _reference_impulse(calibration: ArrayCalibration, predictor: Predictor) -> NDArray[np.complex64]:
    """Predicted impulses over a perpendicular plate at the reference distance, (receivers, bins)."""
    half = 100.0
    field = MapField(x_mm=(-half, half), y_mm=(-half, half), cell_mm=1.0)
    plate = surface(np.zeros(field.shape), field)
    down = transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, calibration.reference_mm]))
    elements = np.array([calibration.emitter_mm, *calibration.receivers_mm], dtype=np.float64)
    moved = elements @ down[:3, :3].T + down[:3, 3]
    return predictor.spectra(plate, Aperture(np.ascontiguousarray(moved), np.array([0.0, 0.0, -1.0])))


def _band_filter(band: Band) -> NDArray[np.float32]:
    """Flat within the band, cosine edges, shape (bins,)."""
    at = (band.frequency_hz - band.low_hz) / (band.high_hz - band.low_hz)
    edge = np.clip(np.minimum(at, 1 - at) / EDGE_SHARE, 0.0, 1.0)
    return (0.5 - 0.5 * np.cos(np.pi * edge)).astype(np.float32)


def _envelope_peak(signal: NDArray[np.float64]) -> NDArray[np.float64]:
    """Peak of the envelope along the last axis."""
    n = signal.shape[-1]
    keep = np.zeros(n)
    keep[0] = 1.0
    keep[1 : (n + 1) // 2] = 2.0
    if n % 2 == 0:
        keep[n // 2] = 1.0
    return np.abs(np.fft.ifft(np.fft.fft(signal, axis=-1) * keep, axis=-1)).max(axis=-1)


@dataclass(frozen=True)
class Gate:
    """The stretch of time in which a field's echoes arrive, as complex samples at the band's own rate."""

    band: Band
    first: int
    last: int
    samples: int
    window: NDArray[np.float32]

    @property
    def thinning(self) -> int:
        """Every how many bins are enough for what lies within the gate."""
        return max(1, self.samples // (self.last - self.first))

    def waveform(self, spectrum: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Gated complex waveform (..., last - first) of band spectra (..., bins)."""
        return self.samples_of(spectrum) * self.window

    def samples_of(self, spectrum: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """The same without the gate's soft edges, for what has passed them already."""
        padded = np.zeros((*spectrum.shape[:-1], self.samples), dtype=np.complex64)
        padded[..., : spectrum.shape[-1]] = spectrum
        return ifft(padded)[..., self.first : self.last]

    def spectrum(self, waveform: NDArray[np.complex64]) -> NDArray[np.complex64]:
        """Band spectra (..., bins) of gated waveforms (..., last - first)."""
        whole = np.zeros((*waveform.shape[:-1], self.samples), dtype=np.complex64)
        whole[..., self.first : self.last] = waveform
        return fft(whole)[..., : self.band.bins.size]


def gate(band: Band, nearest_s: float, latest_s: float) -> Gate:
    """A gate over [nearest_s, latest_s] with soft edges.

    The waveform is sampled at the width of the band or a little above, which is all it needs.
    """
    samples = fast_length(int(np.ceil(band.bins.size * 1.1)))
    rate_hz = samples * band.sample_rate_hz / band.length
    first = max(0, int(np.floor(nearest_s * rate_hz)))
    last = min(samples, int(np.ceil(latest_s * rate_hz)))
    n = last - first
    ramp = max(2, n // 12)
    window = np.ones(n, dtype=np.float32)
    rise = 0.5 - 0.5 * np.cos(np.pi * (np.arange(ramp) + 0.5) / ramp)
    window[:ramp], window[-ramp:] = rise, rise[::-1]
    return Gate(band, first, last, samples, window)
