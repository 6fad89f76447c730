"""Rules that hold sound's height against light's: what sound finds higher is transparent."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.types import Label
from echolume_processing.hybrid import holes
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.rules.cells import Cells
from echolume_processing.hybrid.rules.plain import weighted
from echolume_processing.hybrid.rules.scan import Scan, SoundImage
from echolume_processing.hybrid.scipy_typed import Mask, labelled, opened

GATE = 2.5
"""Standard deviations apart that two heights contradict each other."""
SOUND_SIGMA_MM = 1.0
"""Of a contact point's height, whatever lies below it."""
OCCLUDED_SIGMA_MM = 2.0
REGION_MM = 9.0
LEAST_MM2 = 150.0
NARROW = 0.3
"""Below this relative bandwidth a contact point may be off by whole half wavelengths."""
"""A square of this side fits into every part of a region, and it is at least this large."""


def constant_gate(scan: Scan) -> HybridMap:
    """Mahalanobis gate with one sigma for all contact points.

    Notes
    -----
    Sound is heard from all of its footprint, so at the foot of every step its height is that of the step: this rule
    calls the rims of matte things transparent.
    """
    closed = holes.close(scan.light)
    sigma_mm = np.full(scan.field.shape, SOUND_SIGMA_MM)
    return gated(scan, closed, SoundImage(scan.sound.height_mm, sigma_mm)).finish(*slips(scan.calibration.array))


def footprint_gate(scan: Scan) -> HybridMap:
    """The gate with the relief below the beam as variance, and whole regions only.

    Notes
    -----
    The variance of a contact point grows by ((highest - lowest) / 2)^2 of light's surface within its footprint. Glass
    lower than about two and a half times that is missed; a beam that is wider than calibrated is not forgiven.
    """
    closed = holes.close(scan.light)
    radius_mm, whence = footprint_mm(scan.calibration.array)
    surface_mm = closed.height_mm.copy()
    for hole in closed.absorbing:
        heard = hole & np.isfinite(scan.sound.height_mm)
        surface_mm[heard] = scan.sound.height_mm[heard]
    relief_mm = relief(surface_mm, radius_mm, scan.field.cell_mm)
    variance = scan.sound.sigma_mm**2 + SOUND_SIGMA_MM**2 + (0.5 * relief_mm) ** 2
    sound = SoundImage(scan.sound.height_mm, np.sqrt(variance))
    note = f"footprint of {radius_mm:.1f} mm radius, {whence}"
    return gated(scan, closed, sound, whole=True).finish(note, *slips(scan.calibration.array))


def slips(array: ArrayCalibration) -> tuple[str, ...]:
    """What a gate cannot know of heights from a narrow band."""
    if array.high_hz - array.low_hz >= NARROW * array.low_hz:
        return ()
    half_wave_mm = 1e3 * array.speed_of_sound_mps / (array.low_hz + array.high_hz)
    return (f"narrow band: heights found by sound may be off by n x {half_wave_mm:.2f} mm, and no gate can tell",)


def footprint_mm(array: ArrayCalibration) -> tuple[float, str]:
    """Radius of an array's footprint at its reference distance, and where it comes from."""
    if isinstance(array.footprint_mm, float):
        return array.footprint_mm, "as calibrated"
    wave_mm = 2e3 * array.speed_of_sound_mps / (array.low_hz + array.high_hz)
    return float(np.sqrt(wave_mm * array.reference_mm / 2)), "the first Fresnel zone: none was calibrated"


def relief(height_mm: NDArray[np.float64], radius_mm: float, cell_mm: float) -> NDArray[np.float64]:
    """Highest less lowest height within a radius of each cell, of the image's shape."""
    reach = max(1, round(radius_mm / cell_mm))
    y, x = np.mgrid[-reach : reach + 1, -reach : reach + 1]
    disk = ((x**2 + y**2) * cell_mm**2 <= radius_mm**2).astype(np.uint8)
    disk[reach, reach] = 1
    image = np.ascontiguousarray(height_mm, dtype=np.float32)
    return np.asarray(cv2.dilate(image, disk) - cv2.erode(image, disk), dtype=np.float64)


def regions(flagged: Mask, cell_mm: float) -> Mask:
    """The flagged cells that form regions."""
    wide = opened(flagged, max(1, round(REGION_MM / cell_mm)))
    labels, number = labelled(wide)
    large = np.bincount(labels.ravel(), minlength=number + 1) * cell_mm**2 >= LEAST_MM2
    large[0] = False
    return large[labels]


def gated(scan: Scan, closed: holes.Closed, sound: SoundImage, whole: bool = False) -> Cells:
    """Light, sound in its large holes, and transparent where sound is higher by more than the gate.

    Parameters
    ----------
    scan
        The evidence.
    closed
        Light's surface without holes.
    sound
        Sound's heights, with the sigmas that the gate takes.
    whole
        Only regions count, no lone cells.
    """
    light, seen = scan.light, closed.seen
    heard = np.isfinite(sound.height_mm)
    difference_mm = sound.height_mm - light.height_mm
    with np.errstate(invalid="ignore"):
        limit_mm = GATE * np.hypot(light.sigma_mm, sound.sigma_mm)
        above = seen & heard & (difference_mm > limit_mm)
        agree = seen & heard & (np.abs(difference_mm) <= limit_mm)
    if whole:
        above = regions(above, scan.field.cell_mm)
    cells = with_holes(scan, closed, sound)
    cells.both(light, *weighted(light.height_mm, light.sigma_mm, sound.height_mm, sound.sigma_mm), agree & ~above)
    cells.transparent(light, sound.height_mm, sound.sigma_mm, above)
    return cells


def with_holes(scan: Scan, closed: holes.Closed, sound: SoundImage) -> Cells:
    """Light where it was seen; of its holes the large ones from sound, the narrow ones from their lower neighbour."""
    cells = Cells(scan.field)
    cells.light(scan.light, closed.seen)
    cells.occluded(closed.height_mm, OCCLUDED_SIGMA_MM, closed.occluded)
    heard = np.isfinite(sound.height_mm)
    for hole in closed.absorbing:
        cells.sound(sound.height_mm, sound.sigma_mm, hole & heard, Label.ABSORBING)
    cells.sound(sound.height_mm, sound.sigma_mm, closed.outside & heard)
    return cells
