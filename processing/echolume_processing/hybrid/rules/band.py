"""What the band of an array says of its echoes: wavelength, footprint, and whether whole waves can be mistaken."""

from __future__ import annotations

import numpy as np

from echolume_messages.calibration import ArrayCalibration

NARROW = 0.3
"""Below this relative bandwidth a contact point may be off by whole half wavelengths."""


def wavelength_mm(array: ArrayCalibration) -> float:
    """Wavelength in the middle of an array's band."""
    return 2e3 * array.speed_of_sound_mps / (array.low_hz + array.high_hz)


def narrow(array: ArrayCalibration) -> bool:
    """Whether an array's echoes look alike from one wave to the next."""
    return array.high_hz - array.low_hz < NARROW * array.low_hz


def slips(array: ArrayCalibration, pings: bool) -> tuple[str, ...]:
    """What a gate can know of heights from a narrow band, with pings and without."""
    if not narrow(array):
        return ()
    half_mm = 0.5 * wavelength_mm(array)
    if pings:
        return (f"narrow band: whole half waves of {half_mm:.2f} mm were chosen by where the echoes around begin",)
    return (
        f"narrow band: heights found by sound may be off by n x {half_mm:.2f} mm, and without pings no gate can tell",
    )


def footprint_mm(array: ArrayCalibration) -> tuple[float, str]:
    """Radius of an array's footprint at its reference distance, and where it comes from."""
    if isinstance(array.footprint_mm, float):
        return array.footprint_mm, "as calibrated"
    return float(np.sqrt(wavelength_mm(array) * array.reference_mm / 2)), "the first Fresnel zone: none was calibrated"
