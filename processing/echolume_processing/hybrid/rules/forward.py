"""The forward-model gate: contact points of the measured echoes against those of the echoes that light predicts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration
from echolume_messages.types import ULTRASONIC_POINT, Structured
from echolume_processing.hybrid import holes
from echolume_processing.hybrid.grid import accumulate, cell_index
from echolume_processing.hybrid.model import HybridMap, Registration, widened
from echolume_processing.hybrid.predict import Band
from echolume_processing.hybrid.registration import register
from echolume_processing.hybrid.rules.band import narrow, slips
from echolume_processing.hybrid.rules.gates import GATE, SOUND_SIGMA_MM, regions, with_holes
from echolume_processing.hybrid.rules.scan import Scan
from echolume_processing.hybrid.rules.sound import sound_image
from echolume_processing.hybrid.sounding import Sounding, Spectra, sounding
from echolume_processing.hybrid.surface import surface
from echolume_processing.hybrid.witnesses import Triggers
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline

MARGIN_MM = 80.0
"""Sound sees this far beyond the map."""


@dataclass(frozen=True)
class Compared:
    """Contact points of both kinds of echoes, and how the predicted ones were brought onto the measured ones."""

    measured: Structured
    predicted: Structured
    registration: Registration
    pings: Triggers
    """Trigger of the ping of each measured point."""


def forward_model_gate(scan: Scan) -> HybridMap:
    """Transparent where the measured echoes' contact points lie above the predicted echoes'.

    Notes
    -----
    What a beam makes of steps and rims is in both maps of points, and cancels. A plate whose echo overlaps that of
    what lies behind it is missed: both maps then show one echo.
    """
    closed = holes.close(scan.light)
    if not scan.pings or not closed.seen.any():
        missing = "no pings" if not scan.pings else "no optical points"
        return with_holes(scan, closed, scan.sound).finish(f"{missing}: nothing was compared")
    compared = compare(scan)
    array, field = scan.calibration.array, scan.field
    measured = sound_image(compared.measured, array, field, compared.pings)
    predicted = sound_image(compared.predicted, array, field)
    higher_mm = measured.height_mm - predicted.height_mm
    with np.errstate(invalid="ignore"):
        limit_mm = GATE * np.sqrt(measured.stated_mm**2 + SOUND_SIGMA_MM**2)
        flagged = closed.seen & (higher_mm > limit_mm) & (measured.height_mm > scan.light.height_mm + limit_mm)
    front_mm = measured.height_mm
    if narrow(scan.calibration.array):
        front_mm = scan.settled.height_mm + compared.registration.dz_mm
        flagged &= np.isfinite(front_mm)
    sound = replace(measured, height_mm=front_mm, sigma_mm=np.hypot(measured.stated_mm, SOUND_SIGMA_MM))
    cells = with_holes(scan, closed, sound)
    cells.transparent(scan.light, sound.height_mm, sound.sigma_mm, regions(flagged, scan.field.cell_mm))
    return cells.finish(*slips(scan.calibration.array, pings=True), registration=compared.registration)


def compare(scan: Scan) -> Compared:
    """Contact points of the measured echoes, and of those predicted from light's closed surface.

    Notes
    -----
    Both kinds of echoes pass the same band filter and then `UltrasonicPipeline.process_echoes`. Light's large holes
    take the median of the contact points in them before anything is predicted. The registration's height is added to
    all points.
    """
    wide = widened(scan.field, MARGIN_MM)
    closed = holes.close(accumulate(scan.optical, wide))
    pings = sorted(scan.pings, key=lambda p: p.trigger)
    found = sounding(pings, scan.calibration.array)
    spectra = np.stack([found.channels.measured(p) for p in pings])
    measured, triggers = _points(found, spectra, pings, scan.calibration)
    height_mm = closed.height_mm.copy()
    cell = cell_index(wide, measured["x_mm"], measured["y_mm"])
    for hole in closed.absorbing:
        over = measured["z_mm"][(cell >= 0) & hole.ravel()[cell]]
        if over.size:
            height_mm[hole] = float(np.median(over))
    scene = surface(height_mm, wide)
    found, predicted, registration = register(found, found.predict(scene, np.arange(len(pings))))
    late = np.exp(-2j * np.pi * found.band.frequency_hz * np.array(scan.calibration.array.delays_s)[:, None])
    guessed, _ = _points(found, (predicted * late).astype(np.complex64), pings, scan.calibration)
    for points in (measured, guessed):
        points["z_mm"] += np.float32(registration.dz_mm)
    return Compared(measured, guessed, registration, triggers)


def _points(
    found: Sounding, spectra: Spectra, pings: Sequence[Ping], calibration: Calibration
) -> tuple[Structured, Triggers]:
    """Contact points of band spectra (pings, receivers, bins), time zero at the emission; and the triggers of both."""
    pipeline = UltrasonicPipeline(calibration)
    parts = [
        pipeline.process_echoes(
            _waveforms(found.band, spectrum, p.echoes.shape[1]),
            p.robot_pose,
            p.sample_rate_hz,
            0.0,
            p.air_temperature_c,
        )
        for spectrum, p in zip(spectra, pings, strict=True)
    ]
    points: Structured = np.concatenate(parts).astype(ULTRASONIC_POINT)
    triggers = np.repeat(np.array([p.trigger for p in pings], dtype=np.uint32), [part.size for part in parts])
    placed = np.isfinite(points["z_mm"]) & np.isfinite(points["x_mm"]) & np.isfinite(points["y_mm"])
    return points[placed], triggers[placed]


def _waveforms(band: Band, spectrum: NDArray[np.complex64], samples: int) -> NDArray[np.float32]:
    """Waveforms in counts (receivers, samples) of band spectra (receivers, bins)."""
    whole = np.zeros((spectrum.shape[0], band.length // 2 + 1), dtype=np.complex64)
    whole[:, band.bins] = spectrum
    return np.ascontiguousarray(np.fft.irfft(whole, band.length)[:, :samples], dtype=np.float32)
