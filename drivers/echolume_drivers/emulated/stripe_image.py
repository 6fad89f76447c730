"""Renders what a camera sees of the laser stripe on a scene: exact geometry first, then light and noise."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.optics import OpticalTruth, Side
from echolume_drivers.emulated.scene import Scene
from echolume_drivers.emulated.sensor import expose
from echolume_drivers.emulated.stripe_kernels import cut, images, light, splat
from echolume_messages.types import Frame

STRIPE_DN_PER_S = 150.0 / 4e-3
"""Crest of the stripe on a white surface that the laser meets at right angles."""
AMBIENT_DN_PER_S = 5.0 / 4e-3
"""Room light that passes the cameras' filter."""
LAMP_DN_PER_S = 168.0 / 8e-3
"""Bench lamp on white; it is wired to burn only while the laser is off."""
SCENE_ALBEDO = 0.6
TRANSMISSION = 0.85
"""What a glass body lets through, once."""
SURFACES = np.array([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.35, 6.0]])
"""Diffuse albedo and specular strength by material: matte, black, (what lies under) glass, glossy."""

_FAN_MM = (-150.0, 150.0)
_PER_MM = 8


@dataclass(frozen=True)
class StripeTruth:
    """Visible pieces of a stripe in the order of y: image (n, 2) in px, points (n, 3) in mm, crest brightness (n,)."""

    pixels: NDArray[np.float64]
    points_mm: NDArray[np.float64]
    brightness: NDArray[np.float64]
    piece: NDArray[np.int64]
    """Number of the piece along the cut; neighbours that differ by 1 touch."""

    def rows(self, height_px: int) -> NDArray[np.float64]:
        """Column u of the stripe at each image row (height_px,); nan where there is none, or more than one."""
        out = np.full(height_px, np.nan)
        seen = np.zeros(height_px, dtype=np.int64)
        for i in range(len(self.piece) - 1):
            if self.piece[i + 1] - self.piece[i] != 1:
                continue
            (ua, va), (ub, vb) = self.pixels[i], self.pixels[i + 1]
            low, high = min(va, vb), max(va, vb)
            for row in range(max(0, int(np.ceil(low))), min(height_px, int(np.ceil(high)))):
                out[row] = ua + (ub - ua) * (row - va) / (vb - va)
                seen[row] += 1
        out[seen > 1] = np.nan
        return out


def _pieces(
    scene: Scene, truth: OpticalTruth, side: Side, x_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Spans (n, 6) of the cut, their images (n, 3) and their brightness (n,)."""
    grid = np.array([scene.x0_mm, scene.y0_mm, scene.cell_mm])
    plane = np.append(truth.laser_normal, truth.plane_offset_mm(x_mm))
    camera = truth.camera(side)
    top_mm = max(0.0, float(scene.front_mm.max()), float(scene.optical_mm.max())) + 1e-6
    relief_mm = top_mm - min(0.0, float(scene.optical_mm.min()))
    spans, kinds = cut(scene.optical_mm, scene.material, grid, plane, _FAN_MM, _PER_MM, relief_mm)
    brightness = light(
        scene.optical_mm, scene.front_mm, scene.material, grid, spans, kinds,
        truth.head_mm(x_mm), camera.centre_mm, SURFACES, TRANSMISSION, top_mm,
    )  # fmt: skip
    return spans, images(camera.packed, spans), brightness


def true_stripe(scene: Scene, truth: OpticalTruth, side: Side, x_mm: float) -> StripeTruth:
    """Where the stripe truly is in the image, without light or noise; for tests."""
    spans, pieces, brightness = _pieces(scene, truth, side, x_mm)
    camera = truth.camera(side)
    inside = (pieces[:, 0] >= -0.5) & (pieces[:, 0] < camera.width_px - 0.5)
    inside &= (pieces[:, 1] >= -0.5) & (pieces[:, 1] < camera.height_px - 0.5)
    kept = np.flatnonzero((brightness > 0) & inside)
    middle = 0.5 * (spans[:, :3] + spans[:, 3:])
    return StripeTruth(pieces[kept, :2], middle[kept], brightness[kept], kept)


def stripe_light(
    pieces: NDArray[np.float64], brightness: NDArray[np.float64], truth: OpticalTruth, side: Side
) -> tuple[NDArray[np.float32], NDArray[np.int64]]:
    """Noiseless laser image (rows, columns), 1 = full crest, and the columns [first, last) touched in each row."""
    camera = truth.camera(side)
    image = np.zeros((camera.height_px, camera.width_px), dtype=np.float32)
    touched = np.empty((camera.height_px, 2), dtype=np.int64)
    touched[:] = (camera.width_px, 0)
    splat(pieces, brightness, truth.stripe_sigma_px, image, touched)
    return image, touched


def render_stripe(
    scene: Scene,
    truth: OpticalTruth,
    side: Side,
    x_mm: float,
    rng: np.random.Generator,
    exposure_s: float,
    laser_on: bool,
) -> Frame:
    """A frame (rows, columns) of uint8 of one camera with the guide at `x_mm`.

    Notes
    -----
    The laser plane is cut with the surface that light meets (below glass: what lies behind it), walls included.
    Each piece is marched towards the laser's head (shadow) and towards the camera (occlusion), projected with
    distortion and drawn with a Gaussian cross section. Glass weakens the beam on each way; black returns nothing.
    Secondary reflections and the glass's own glint are left out.
    """
    camera = truth.camera(side)
    if laser_on:
        _, pieces, brightness = _pieces(scene, truth, side, x_mm)
        laser, touched = stripe_light(pieces, brightness * (STRIPE_DN_PER_S * exposure_s), truth, side)
        return expose(rng, SCENE_ALBEDO * AMBIENT_DN_PER_S * exposure_s, laser, touched)
    dark = np.zeros((camera.height_px, camera.width_px), dtype=np.float32)
    nothing = np.zeros((camera.height_px, 2), dtype=np.int64)
    return expose(rng, SCENE_ALBEDO * (AMBIENT_DN_PER_S + LAMP_DN_PER_S) * exposure_s, dark, nothing)
