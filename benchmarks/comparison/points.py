"""Figures of the way from a frame pair to points: speed beside the usual ways, wrong points in clutter, honest sigmas."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np
from scipy.spatial import cKDTree

from echolume_drivers.emulated.optics import CameraTruth, OpticalTruth, optical_truth
from echolume_drivers.emulated.scene import Scene, demo, matte
from echolume_drivers.emulated.stripe_image import render_stripe, true_stripe
from echolume_messages.calibration import CameraCalibration, LaserCalibration
from echolume_messages.types import OpticalSource
from echolume_processing.optical.pipeline import OpticalPipeline, OpticalSettings

EXPOSURE_S = 4e-3
WRONG_MM = 1.0
"""A point further than this from the lit surface is wrong, and a row without a point as near is missing."""
BLOBS, HOT_PIXELS = 12, 300
SIDES = ("left", "right")


def camera_of(truth: CameraTruth) -> CameraCalibration:
    """The emulated camera as a perfect calibration would find it."""
    return CameraCalibration(
        width_px=truth.width_px,
        height_px=truth.height_px,
        camera_matrix=truth.matrix.tolist(),
        distortion=truth.distortion.tolist(),
        camera_from_rig=truth.camera_from_rig.tolist(),
        rms_px=0.04,
    )


def laser_of(truth: OpticalTruth) -> LaserCalibration:
    """The emulated laser plane as a perfect calibration would find it."""
    n, g = truth.laser_normal.tolist(), truth.guide_direction.tolist()
    return LaserCalibration(
        normal=(n[0], n[1], n[2]), offset_mm=truth.laser_offset_mm, guide_direction=(g[0], g[1], g[2]), rms_mm=0.02
    )


def clutter(frame: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """The frame with a dozen glints, a secondary stripe of a third to two thirds of the rows, and hot pixels."""
    out = frame.astype(np.float64)
    rows, columns = frame.shape
    yy, xx = np.mgrid[-25:26, -25:26]
    for _ in range(BLOBS):
        y, x = rng.integers(30, rows - 30), rng.integers(30, columns - 30)
        size = rng.uniform(2, 7)
        out[y - 25 : y + 26, x - 25 : x + 26] += rng.uniform(60, 220) * np.exp(-(xx**2 + yy**2) / (2 * size**2))
    length = rng.integers(rows // 3, 2 * rows // 3)
    row = rng.integers(0, rows - length) + np.arange(length)
    t = np.linspace(-1, 1, length)
    column = rng.uniform(100, columns - 100) + rng.uniform(-80, 80) * t + rng.uniform(-30, 30) * t**2
    away = np.arange(columns) - column[:, None]
    grain = rng.normal(1, 0.15, (length, columns))
    out[row] += rng.uniform(20, 100) * grain * np.exp(-0.5 * (away / rng.uniform(1.6, 1.9)) ** 2)
    out.ravel()[rng.integers(0, out.size, HOT_PIXELS)] = rng.uniform(150, 255, HOT_PIXELS)
    return np.clip(np.rint(out), 0, 255).astype(np.uint8)


@dataclass
class Tally:
    """Counts over many frames."""

    points: int = 0
    wrong: int = 0
    rows: int = 0
    found: int = 0

    @property
    def wrong_pct(self) -> float:
        """Share of the published points that are wrong."""
        return 100 * self.wrong / max(self.points, 1)

    @property
    def complete_pct(self) -> float:
        """Share of the rows with a visible stripe that got a right active point."""
        return 100 * self.found / max(self.rows, 1)


def fronts(scene: Scene, truth: OpticalTruth, x_mm: float) -> np.ndarray:
    """Points (n, 3) of what stands within a millimetre of the laser plane, its walls included.

    Edges of glass and of black things glint: a point on them is right, though the map of light leaves them out.
    """
    y_mm = np.arange(-119.9, 120, 0.2)
    found = []
    for aside_mm in (-1.0, 0.0, 1.0):
        z_mm = np.zeros(len(y_mm))
        for _ in range(2):
            x = truth.plane_offset_mm(x_mm) - truth.laser_normal[1] * y_mm - truth.laser_normal[2] * z_mm + aside_mm
            ix = np.floor((x - scene.x0_mm) / scene.cell_mm).astype(int)
            iy = np.floor((y_mm - scene.y0_mm) / scene.cell_mm).astype(int)
            z_mm = scene.front_mm[iy, np.clip(ix, 0, scene.front_mm.shape[1] - 1)]
        found.append(np.column_stack([x, y_mm, z_mm]))
        for i in np.flatnonzero(np.diff(z_mm)):
            wall_mm = np.arange(min(z_mm[i : i + 2]), max(z_mm[i : i + 2]), 0.2)
            found.append(np.column_stack([np.full_like(wall_mm, x[i]), np.full_like(wall_mm, y_mm[i]), wall_mm]))
    return np.concatenate(found)


def off_mm(points: np.ndarray, lit: cKDTree) -> np.ndarray:
    """Distance along the laser plane of OPTICAL_POINTs (n,) from the nearest piece of the lit surface."""
    return lit.query(np.column_stack([points["y_mm"], points["z_mm"]]))[0]


def score(points: np.ndarray, scene: Scene, truth: OpticalTruth, x_mm: float, tally: Tally) -> dict[str, np.ndarray]:
    """Add one stripe's points to the tally; the wrong ones by source."""
    wrong = {}
    front_mm = fronts(scene, truth, x_mm)
    for side, source in (("left", 2), ("right", 3), ("left", 1)):
        stripe = true_stripe(scene, truth, side, x_mm)
        lit = cKDTree(np.concatenate([stripe.points_mm, front_mm])[:, 1:])
        mine = points[points["source"] == source]
        away = off_mm(mine, lit)
        tally.points += len(mine)
        tally.wrong += int(np.count_nonzero(away > WRONG_MM))
        wrong[f"{side}{source}"] = mine[away > WRONG_MM]
        if source != OpticalSource.STEREO:
            seen = np.isfinite(stripe.rows(truth.camera(side).height_px))
            right = np.zeros(len(seen), dtype=bool)
            right[mine["row"][away <= WRONG_MM]] = True
            tally.rows += int(np.count_nonzero(seen))
            tally.found += int(np.count_nonzero(seen & right))
    return wrong


def cluttered(seeds: range, stripes: int = 20, dirty: bool = True, settings: OpticalSettings | None = None) -> Tally:
    """Wrong points and completeness on cluttered frames of the demo's scene and its all-matte form."""
    tally = Tally()
    for seed in seeds:
        truth = optical_truth(seed)
        pipeline = OpticalPipeline.of(camera_of(truth.left), camera_of(truth.right), laser_of(truth), settings)
        rng = np.random.default_rng([seed, 77])
        for i, x_mm in enumerate(rng.uniform(-98, 98, stripes)):
            scene = (demo, matte)[i % 2]()
            pair = [render_stripe(scene, truth, side, x_mm, rng, EXPOSURE_S, True) for side in SIDES]
            if dirty:
                pair = [clutter(frame, rng) for frame in pair]
            score(pipeline.process(pair[0], pair[1], x_mm), scene, truth, x_mm, tally)
    return tally
