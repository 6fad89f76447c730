"""What a real rig's pictures suffer from: lens, light and sensor of the emulated optics, each with a switch."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

SHARP_AT_MM = 568.0
"""From the nominal camera to the middle of the bench's working height."""
PUPIL_RMS = 0.25
"""Standard deviation along one axis of an evenly filled disc, over its diameter."""


@dataclass(frozen=True)
class Lens:
    """Laser, lens and pixel: what sets the grain of speckle and the depth of field.

    Attributes
    ----------
    wavelength_nm
        Of the laser: 405 (violet, fine grain) or 660 (red) are usual.
    f_number
        Focal length over the diameter of the aperture.
    pixel_um
        Pitch of the sensor's pixels: 3.45 to 4.8 of usual global-shutter sensors.
    focus_mm
        Distance of the plane of focus along the optical axis; None: everything is sharp.
    """

    wavelength_nm: float = 405.0
    f_number: float = 8.0
    pixel_um: float = 4.8
    focus_mm: float | None = SHARP_AT_MM

    def grain_px(self, focal_px: float) -> float:
        """Width of a speckle grain, wavelength * f-number * (1 + magnification), in pixels.

        References
        ----------
        J. W. Goodman, Speckle Phenomena in Optics, 2nd ed., SPIE 2020, doi:10.1117/3.2548484.
        """
        focal_mm = focal_px * self.pixel_um * 1e-3
        magnification = focal_mm / (SHARP_AT_MM - focal_mm)
        return self.wavelength_nm * 1e-3 * self.f_number * (1 + magnification) / self.pixel_um

    def blur_px(self, focal_px: float) -> float:
        """Blur of an endlessly far point in pixels; a point at distance d is blurred by |1 - focus_mm / d| of it.

        It is a standard deviation: the aperture's disc is taken as a Gaussian of the same variance.
        """
        if self.focus_mm is None:
            return 0.0
        focal_mm = focal_px * self.pixel_um * 1e-3
        disc_mm = focal_mm / self.f_number * focal_mm / (self.focus_mm - focal_mm)
        return PUPIL_RMS * disc_mm / (self.pixel_um * 1e-3)

    def focus_row(self, focal_px: float) -> NDArray[np.float64]:
        """(blur_px, focus_mm) for the kernels; without defocus the blur is 0."""
        return np.array([self.blur_px(focal_px), self.focus_mm or SHARP_AT_MM])


LAB_LENS = Lens()


@dataclass(frozen=True)
class Flaws:
    """Strength of each disturbance; 0 switches one off.

    Attributes
    ----------
    speckle_looks
        Independent speckle patterns that add up in an exposure: two polarisations times the spread of wavelengths
        and of depths in the surface. The contrast before the pixel averages is 1 / sqrt(looks); 0: no speckle.
    glint
        Strength of the spots at worn edges of black, glossy and glass bodies, and of the mirror lobe of glass.
    glass_haze
        Diffuse albedo of the glass's own surface (dust and fingerprints).
    secondary
        Strength of what the stripe's light does to walls beside it; 1 is what Lambert's law says of matte walls.
    sheen
        Share of light that a matte wall mirrors at the usual angles, so that it shows the stripe a second time.
    ambient_dn_per_s
        Room light on white that passes the cameras' filter.
    ambient_gradient
        Change of the room light over the whole width and height of the image, relative to its mean.
    blooming
        Share of the light above the full well that leaks to the four neighbours.
    full_well_dn
        Light that fills a pixel; the converter clips at 255 before.
    hot_share
        Share of pixels with much dark current; which they are is fixed for each camera.
    hot_dn_per_s
        Their mean dark signal, exponentially distributed.
    """

    speckle_looks: int = 20
    glint: float = 1.0
    glass_haze: float = 0.01
    secondary: float = 1.0
    sheen: float = 0.04
    ambient_dn_per_s: float = 5.0 / 4e-3
    ambient_gradient: tuple[float, float] = (0.3, -0.2)
    blooming: float = 0.1
    full_well_dn: float = 280.0
    hot_share: float = 1e-4
    hot_dn_per_s: float = 6000.0


DARK_LAB = Flaws()
BRIGHT_ROOM = Flaws(ambient_dn_per_s=60.0 / 4e-3, ambient_gradient=(0.5, -0.35))
"""Lamps on, blinds open: ten times the light of the dark lab, and uneven."""
ROOMS = {"dark": DARK_LAB, "bright": BRIGHT_ROOM}
FLAWLESS = Flaws(
    speckle_looks=0, glint=0.0, glass_haze=0.0, secondary=0.0, sheen=0.0, ambient_gradient=(0.0, 0.0), blooming=0.0,
    hot_share=0.0,
)  # fmt: skip
"""Exact geometry, even light, shot and read noise only."""


def hot_pixels(rng: np.random.Generator, width_px: int, height_px: int, flaws: Flaws) -> NDArray[np.float64]:
    """Draw a sensor's hot pixels, shape (n, 3): row, column, dark signal in DN per second."""
    count = math.floor(flaws.hot_share * width_px * height_px + 0.5)
    where = rng.choice(width_px * height_px, size=count, replace=False)
    out = np.empty((count, 3))
    out[:, 0], out[:, 1] = where // width_px, where % width_px
    out[:, 2] = rng.exponential(flaws.hot_dn_per_s, count)
    return out
