"""Rules that hold sound's height against light's: what sound finds higher is transparent."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages.types import Label
from echolume_processing.hybrid import holes
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.rules.band import footprint_mm, slips
from echolume_processing.hybrid.rules.cells import Cells
from echolume_processing.hybrid.rules.plain import weighted
from echolume_processing.hybrid.rules.scan import Scan
from echolume_processing.hybrid.rules.sound import SoundImage, disk
from echolume_processing.hybrid.scipy_typed import Mask, labelled, opened

GATE = 2.5
"""Standard deviations apart that two heights contradict each other."""
SOUND_SIGMA_MM = 1.0
"""Of a contact point's height, whatever lies below it."""
OCCLUDED_SIGMA_MM = 2.0
LINES_CELLS = 5
"""Side of the square whose median removes lines."""
REGION_MM = 9.0
LEAST_MM2 = 150.0
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
    return gated(scan, closed, replace(scan.sound, sigma_mm=sigma_mm)).finish(
        *slips(scan.calibration.array, bool(scan.pings))
    )


def footprint_gate(scan: Scan) -> HybridMap:
    """The gate with the relief below the beam as variance, and whole regions only.

    Notes
    -----
    The variance of a contact point grows by ((highest - lowest) / 2)^2 of light's surface within its footprint. Glass
    lower than about two and a half times that is missed; a beam that is wider than calibrated is not forgiven. Light's
    large holes count as the lower ground beside them: most of them are strips beside a plate, and with the height that
    sound gives them the plate would have its own rim for relief.
    """
    closed = holes.close(scan.light)
    radius_mm, whence = footprint_mm(scan.calibration.array)
    relief_mm = relief(without_lines(closed.height_mm), radius_mm, scan.field.cell_mm)
    variance = scan.sound.stated_mm**2 + SOUND_SIGMA_MM**2 + (0.5 * relief_mm) ** 2
    sound = replace(scan.sound, sigma_mm=np.sqrt(variance))
    note = f"footprint of {radius_mm:.1f} mm radius, {whence}"
    return gated(scan, closed, sound, whole=True).finish(note, *slips(scan.calibration.array, bool(scan.pings)))


def without_lines(height_mm: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights without what is at most two cells wide: light sees the rim of a plate as a line at its height."""
    image = np.ascontiguousarray(height_mm, dtype=np.float32)
    return np.asarray(cv2.medianBlur(image, LINES_CELLS), dtype=np.float64)


def relief(height_mm: NDArray[np.float64], radius_mm: float, cell_mm: float) -> NDArray[np.float64]:
    """Highest less lowest height within a radius of each cell, of the image's shape."""
    image = np.ascontiguousarray(height_mm, dtype=np.float32)
    within = disk(radius_mm, cell_mm)
    return np.asarray(cv2.dilate(image, within) - cv2.erode(image, within), dtype=np.float64)


def regions(flagged: Mask, cell_mm: float) -> Mask:
    """The flagged cells that form regions."""
    wide = opened(flagged, max(1, round(REGION_MM / cell_mm)))
    labels, number = labelled(wide)
    large = np.bincount(labels.ravel(), minlength=number + 1) * cell_mm**2 >= LEAST_MM2
    large[0] = False
    return large[labels]


def gated(scan: Scan, closed: holes.Closed, sound: SoundImage, whole: bool = False) -> Cells:
    """Light, sound in its large holes, and transparent where sound is higher by more than the gate.

    Whether it is, the contact points say; how high, `Scan.settled`.

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
    front = replace(scan.settled, sigma_mm=sound.sigma_mm)
    above &= np.isfinite(front.height_mm)
    cells = with_holes(scan, closed, front)
    cells.both(light, *weighted(light.height_mm, light.sigma_mm, sound.height_mm, sound.sigma_mm), agree & ~above)
    cells.transparent(light, front.height_mm, front.sigma_mm, above)
    return cells


def with_holes(scan: Scan, closed: holes.Closed, sound: SoundImage) -> Cells:
    """Light where it was seen; of its holes the large ones from sound, the narrow ones from their lower neighbour."""
    cells = Cells(scan.field, scan.light.stripes, sound.ping)
    cells.light(scan.light, closed.seen)
    cells.occluded(closed.height_mm, OCCLUDED_SIGMA_MM, closed.occluded)
    heard = np.isfinite(sound.height_mm)
    for hole in closed.absorbing:
        cells.sound(sound.height_mm, sound.sigma_mm, hole & heard, Label.ABSORBING)
    cells.sound(sound.height_mm, sound.sigma_mm, closed.outside & heard)
    return cells
