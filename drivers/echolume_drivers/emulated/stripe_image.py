"""Renders what a camera sees of the laser stripe on a scene: exact geometry first, then light and noise."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.flaws import ROOMS, SHARP_AT_MM
from echolume_drivers.emulated.light_kernels import (
    bend,
    cut,
    glints,
    images,
    light,
    mirrored,
    second_stripes,
    splat,
    thrown,
    veil,
)
from echolume_drivers.emulated.optics import OpticalTruth, Side
from echolume_drivers.emulated.scene import Material, Scene
from echolume_drivers.emulated.sensor import Sensor, expose
from echolume_drivers.emulated.speckle import speckle_tile
from echolume_messages.types import Frame

STRIPE_DN_PER_S = 150.0 / 4e-3
"""Crest of the stripe on a white surface that the laser meets at right angles."""
LAMP_DN_PER_S = 168.0 / 8e-3
"""Bench lamp on white; it is wired to burn only while the laser is off."""
SCENE_ALBEDO = 0.6
TRANSMISSION = 0.85
"""What a glass body lets through, once."""
SURFACES = np.array([[1.0, 0.0], [0.0, 0.0], [1.0, 0.0], [0.35, 6.0], [0.0, 0.0]])
"""Diffuse albedo and specular strength by material: matte, black, (what lies under) glass, glossy, mirror."""
WORN_EDGES = np.array([0.0, 4.0, 3.0, 4.0, 3.0])
"""Mirror strength of a worn edge by material, as `SURFACES`' second column."""
GLASS_MIRROR = (10.0, 2000.0)
"""Strength and exponent of the glass's mirror lobe at full reflection: polished, some degrees wide."""
MIRRORS = np.array([1.0, 1.2, 0.0, 8.0, 8.0])
"""How much better than a matte wall a wall of each material shows the stripe's mirror image."""
REFRACTIVE_INDEX = 1.52
"""Of glass plates that have a thickness: soda-lime glass."""
MIRROR_REFLECTANCE = 0.9
LEAST_MIRROR_MM2 = 25.0
"""A smaller plane mirror shows too little to be worth its rays."""

LENS_SIGMA_PX = 0.7
"""Blur of the lens in focus."""

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


@dataclass(frozen=True)
class _Shape:
    """What the kernels need of scene, laser and eye."""

    grid: NDArray[np.float64]
    plane: NDArray[np.float64]
    head: NDArray[np.float64]
    top_mm: float
    line_mm: float


def _shape(scene: Scene, truth: OpticalTruth, side: Side, x_mm: float) -> _Shape:
    return _Shape(
        np.array([scene.x0_mm, scene.y0_mm, scene.cell_mm]),
        np.append(truth.laser_normal, truth.plane_offset_mm(x_mm)),
        truth.head_mm(x_mm),
        max(0.0, float(scene.front_mm.max()), float(scene.optical_mm.max())) + _slack_mm(scene) + 1e-6,
        truth.stripe_sigma_px * SHARP_AT_MM / float(truth.camera(side).matrix[0, 0]),
    )


def _slack_mm(scene: Scene) -> float:
    """How far a cell's plane rises above its centre."""
    slopes = [s for s in (scene.front_slope, scene.optical_slope) if s is not None]
    return max((float(np.abs(s).sum(axis=2).max()) * 0.5 * scene.cell_mm for s in slopes), default=0.0)


def _pieces(
    scene: Scene, truth: OpticalTruth, side: Side, x_mm: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Spans (n, 6) of the cut, their images (n, 4) and their brightness (n,)."""
    spans, _, pieces, brightness = _direct(scene, truth, side, _shape(scene, truth, side, x_mm))
    return spans, pieces, brightness


def _direct(
    scene: Scene, truth: OpticalTruth, side: Side, shape: _Shape
) -> tuple[NDArray[np.float64], NDArray[np.int64], NDArray[np.float64], NDArray[np.float64]]:
    """Spans (n, 6) of the cut where the light lands, their kinds (n, 3), images (n, 4) and brightness (n,)."""
    camera = truth.camera(side)
    relief_mm = shape.top_mm - min(0.0, float(scene.optical_mm.min()))
    spans, kinds = cut(scene.light_ground, scene.lit_material, shape.grid, shape.plane, _FAN_MM, _PER_MM, relief_mm)
    brightness = light(
        scene.light_ground, scene.glass, shape.grid, spans, kinds,
        shape.head, camera.centre_mm, SURFACES, TRANSMISSION, shape.top_mm,
    )  # fmt: skip
    seen = spans
    if scene.bends_light:
        spans, seen = bend(
            scene.light_ground, scene.glass, shape.grid, spans, brightness, shape.head, camera.centre_mm,
            REFRACTIVE_INDEX, shape.top_mm,
        )  # fmt: skip
    brightness *= _through_smoke(scene, spans, shape.head, camera.centre_mm)
    return spans, kinds, images(camera.packed, seen, truth.stripe_sigma_px), brightness


def _through_smoke(
    scene: Scene, spans: NDArray[np.float64], head_mm: NDArray[np.float64], eye_mm: NDArray[np.float64]
) -> NDArray[np.float64] | float:
    """Share of the light (n,) that smoke leaves on the way from the laser to each span and on to the camera."""
    if scene.air.smoke_per_m == 0:
        return 1.0
    middle = 0.5 * (spans[:, :3] + spans[:, 3:])
    way_mm = np.linalg.norm(middle - head_mm, axis=1) + np.linalg.norm(middle - eye_mm, axis=1)
    return np.exp(-scene.air.smoke_per_m * 1e-3 * way_mm)


def _astray(
    scene: Scene, truth: OpticalTruth, side: Side, shape: _Shape, spans: NDArray[np.float64],
    kinds: NDArray[np.int64], brightness: NDArray[np.float64],
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:  # fmt: skip
    """Images (n, 4) and brightness (n,) of glint, of second stripes, and of what mirrors make of the stripe."""
    flaws, camera = truth.flaws, truth.camera(side)
    field = (scene.light_ground, scene.glass, scene.lit_material, shape.grid)
    rays = (shape.head, camera.centre_mm)
    found: list[tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]] = []
    if flaws.glint > 0 or flaws.glass_haze > 0:
        glass = np.array([flaws.glass_haze, flaws.glint * GLASS_MIRROR[0], GLASS_MIRROR[1]])
        edges = flaws.glint * WORN_EDGES
        front = (scene.light_ground, scene.glass, scene.material, shape.grid)
        found.append(glints(*front, shape.plane, *rays, edges, glass, shape.line_mm, shape.top_mm))
    if flaws.secondary > 0 or flaws.sheen > 0:
        albedo = SURFACES[:, 0]
        walls = np.stack([albedo, albedo * flaws.secondary * SCENE_ALBEDO, MIRRORS * flaws.sheen], axis=1)
        found.append(second_stripes(*field, spans, kinds, *rays, walls, shape.line_mm, shape.top_mm))
    if np.any(scene.lit_material == Material.MIRROR):
        albedo = MIRROR_REFLECTANCE * SURFACES[:, 0]
        found.append(thrown(*field, spans, kinds, *rays, albedo, shape.line_mm, shape.top_mm))
        shine = MIRROR_REFLECTANCE * brightness
        found.append(mirrored(*field, _mirror_planes(scene), spans, shine, *rays, shape.line_mm, shape.top_mm))
    return [
        _spread(truth, side, stray, shine * _through_smoke(scene, stray, *rays), width_mm)
        for stray, shine, width_mm in found
    ]


def _mirror_planes(scene: Scene) -> NDArray[np.float64]:
    """Planes n.X = c of the scene's mirrors, shape (m, 4); a curved one shows nothing."""
    y, x = np.nonzero(scene.lit_material == Material.MIRROR)
    planes = scene.light_ground[y, x]
    x_mm, y_mm = scene.x0_mm + (x + 0.5) * scene.cell_mm, scene.y0_mm + (y + 0.5) * scene.cell_mm
    foot_mm = planes[:, 0] - planes[:, 1] * x_mm - planes[:, 2] * y_mm
    rows, count = np.unique(np.round(np.stack([planes[:, 1], planes[:, 2], foot_mm], axis=1), 6), axis=0,
                            return_counts=True)  # fmt: skip
    rows = rows[count * scene.cell_mm**2 >= LEAST_MIRROR_MM2]
    normal = np.stack([-rows[:, 0], -rows[:, 1], np.ones(len(rows))], axis=1)
    norm = np.linalg.norm(normal, axis=1, keepdims=True)
    return np.ascontiguousarray(np.concatenate([normal / norm, rows[:, 2:] / norm], axis=1))


def _spread(
    truth: OpticalTruth,
    side: Side,
    spans: NDArray[np.float64],
    brightness: NDArray[np.float64],
    width_mm: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Images (n, 4) of spans of their own width, and the brightness at which `splat` gives them the right crest."""
    camera, line_px = truth.camera(side), truth.stripe_sigma_px
    pieces = images(camera.packed, spans, LENS_SIGMA_PX)
    width_px = width_mm * float(camera.matrix[0, 0]) / SHARP_AT_MM
    pieces[:, 3] = np.hypot(pieces[:, 3], width_px)
    return pieces, brightness * width_px / line_px


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


def sensor_of(truth: OpticalTruth, side: Side, exposure_s: float) -> Sensor:
    """What a camera's sensor adds to an exposure."""
    camera, flaws = truth.camera(side), truth.flaws
    # Cameras of one build differ by less than a step in grain, and share the tile.
    tile = speckle_tile(round(camera.grain_px, 1), flaws.speckle_looks) if flaws.speckle_looks > 0 else None
    hot = camera.hot * np.array([1.0, 1.0, exposure_s])
    return Sensor(tile, flaws.blooming, flaws.full_well_dn, hot)


def smoke_veil(scene: Scene, truth: OpticalTruth, side: Side, x_mm: float) -> NDArray[np.float64]:
    """The laser's sheet in smoke as a camera sees it (rows, columns), in terms of white under the line's crest."""
    shape, camera = _shape(scene, truth, side, x_mm), truth.camera(side)
    shown = veil(
        scene.light_ground, scene.glass, shape.grid, shape.plane, camera.rays,
        np.ascontiguousarray(camera.camera_from_rig[:3, :3].T), shape.head, camera.centre_mm, _FAN_MM,
        scene.air.smoke_per_m * 1e-3, shape.line_mm, shape.top_mm,
    )  # fmt: skip
    return scene.air.backscatter * shown.astype(np.float64)


def _even(level_dn: float, slope_dn: tuple[float, float], shape: tuple[int, ...]) -> NDArray[np.float64]:
    """Even light that changes by `slope_dn` over the width and height of an image (rows, columns)."""
    row, column = np.arange(shape[0])[:, None], np.arange(shape[1])
    across = slope_dn[0] * (column - 0.5 * (shape[1] - 1)) / shape[1]
    return level_dn + across + slope_dn[1] * (row - 0.5 * (shape[0] - 1)) / shape[0]


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
    distortion and drawn with a Gaussian cross section that widens out of focus. Glass weakens the beam on each way;
    black returns nothing. Glint and second stripes are drawn over it, see `light_kernels`; room and lamp light the
    scene as if it were a flat grey card. Glass plates that have a thickness bend the light as plane plates do,
    each where the straight way meets it. Smoke weakens the laser's light, shows its sheet, and scatters as much of
    the room's light as it takes. Left out: light that is scattered more than once, the change of the line's width on
    slopes, and mirrors seen in mirrors.
    """
    if scene.room is not None:
        room = ROOMS[scene.room]
        lit = replace(truth.flaws, ambient_dn_per_s=room.ambient_dn_per_s, ambient_gradient=room.ambient_gradient)
        truth = replace(truth, flaws=lit)
    camera = truth.camera(side)
    sensor = sensor_of(truth, side, exposure_s)
    ambient_dn = SCENE_ALBEDO * truth.flaws.ambient_dn_per_s * exposure_s
    slope_dn = (ambient_dn * truth.flaws.ambient_gradient[0], ambient_dn * truth.flaws.ambient_gradient[1])
    if laser_on:
        shape = _shape(scene, truth, side, x_mm)
        spans, kinds, pieces, brightness = _direct(scene, truth, side, shape)
        crest_dn = STRIPE_DN_PER_S * exposure_s
        laser, touched = stripe_light(pieces, brightness * crest_dn, truth, side)
        for stray, shine in _astray(scene, truth, side, shape, spans, kinds, brightness):
            splat(stray, shine * crest_dn, truth.stripe_sigma_px, laser, touched)
        if scene.air.smoke_per_m > 0:
            lamp_dn = _even(ambient_dn, slope_dn, laser.shape) + crest_dn * smoke_veil(scene, truth, side, x_mm)
            return expose(rng, lamp_dn.astype(np.float32), laser, touched, sensor)
        return expose(rng, ambient_dn, laser, touched, sensor, slope_dn)
    dark = np.zeros((camera.height_px, camera.width_px), dtype=np.float32)
    nothing = np.zeros((camera.height_px, 2), dtype=np.int64)
    lamp_dn = SCENE_ALBEDO * LAMP_DN_PER_S * exposure_s
    return expose(rng, ambient_dn + lamp_dn, dark, nothing, sensor, slope_dn)
