"""What pings of one kind are compared with, before any of them is known: band, channels, a predictor in still air."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_processing.hybrid.channel import Channels, band_of, channels, speed_of_sound
from echolume_processing.hybrid.predict import Aperture, Band, Predictor
from echolume_processing.hybrid.surface import Surface
from echolume_processing.ping import Ping

Kind = tuple[tuple[int, ...], float]
"""Shape and sample rate of a ping's echoes."""


def kind_of(ping: Ping) -> Kind:
    """The digitiser setting of a ping; only pings of one kind are compared with each other."""
    return ping.echoes.shape, ping.sample_rate_hz


@dataclass(frozen=True)
class Listening:
    """How pings of one kind are brought into comparable form, each by itself."""

    kind: Kind
    air_c: float
    """Predictions are made for air of this temperature, whole degrees; the measured echoes are brought to it."""
    speed_mps: float
    band: Band
    predictor: Predictor
    channels: Channels
    """Without the channels' delays."""
    early: NDArray[np.complex64]
    """(receivers, bins): takes the delays out of a measured spectrum."""

    @classmethod
    def to(cls, ping: Ping, calibration: ArrayCalibration, air_c: float) -> Listening:
        """For pings like this one, in air of about this temperature."""
        band, air_c = band_of(calibration, ping), float(np.rint(air_c))
        speed_mps = speed_of_sound(calibration, air_c)
        raw = channels(calibration, band)
        early = np.exp(2j * np.pi * band.frequency_hz * np.array(calibration.delays_s)[:, None]).astype(np.complex64)
        response = replace(raw, response=raw.response * early)
        predictor = Predictor(calibration.radius_mm, speed_mps, band)
        return cls(kind_of(ping), air_c, speed_mps, band, predictor, response, early)

    def measured(self, ping: Ping) -> NDArray[np.complex64]:
        """Band spectra (receivers, bins) of a ping, its delays taken out."""
        return self.channels.measured(ping) * self.early

    def predicted(self, scene: Surface, where: Aperture) -> NDArray[np.complex64]:
        """Band spectra (receivers, bins) in counts that a surface would return."""
        return self.channels.predicted(self.predictor.spectra(scene, where))
