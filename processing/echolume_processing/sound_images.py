"""From the contact points of a scan to height maps, gray levels, and edges in three dimensions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import ConfigError
from echolume_messages.geometry import Points3
from echolume_messages.types import Structured
from echolume_processing.sound_scan import SoundScan
from echolume_processing.ultrasonic.edges import Edge, edges_in_rig
from echolume_processing.ultrasonic.gray import (
    GrayImage,
    GrayScale,
    gaussian,
    gray_scale_from,
    gray_scale_of,
    threshold,
    unsharp,
)
from echolume_processing.ultrasonic.hough import canny, edge_segments
from echolume_processing.ultrasonic.interpolate import INTERPOLATIONS, DepthMap, Interpolation
from echolume_processing.ultrasonic.raster import Raster, spacing_mm

SMOOTH_MM = 2.0
SHARPEN_MM = 4.0
SHORTEST_EDGE_MM = 15.0
GAP_MM = 6.0
STRAY_MM = 5.0
"""Points further beyond the middle 99 % of the heights are left out of the images."""


@dataclass(frozen=True)
class MapSettings:
    """How fine the images are, and what they are made from."""

    pixel_mm: float = 1.0
    level_mm: float | None = None
    """Height of one gray level; None: as fine as 256 levels allow."""
    interpolation: Interpolation = "natural"


@dataclass(frozen=True)
class Images:
    """Every stage from the cloud to edges in 3D."""

    points: Structured
    """``ULTRASONIC_POINT`` (n,), those within the field."""
    raster: Raster
    heights_mm: dict[Interpolation, DepthMap]
    chosen: Interpolation
    scale: GrayScale
    gray: GrayImage
    smooth: GrayImage
    sharp: GrayImage
    binary: GrayImage
    edge_pixels: GrayImage
    segments_px: NDArray[np.float64]
    edges: list[Edge]


def make_images(scan: SoundScan, settings: MapSettings) -> Images:
    """Cloud, height maps, gray levels, filters and edges of a scan over the field of its plan.

    Raises
    ------
    ValueError
        If the cloud spans no surface.
    ConfigError
        If the heights do not fit into 256 gray levels as high as was asked for.
    """
    field = scan.start.plan.map
    points = _within(scan.points, field.x_mm, field.y_mm)
    cloud = places_mm(points)
    columns, rows = (round((high - low) / settings.pixel_mm) for low, high in (field.x_mm, field.y_mm))
    half = 0.5 * settings.pixel_mm
    raster = Raster(field.x_mm[0] + half, field.y_mm[0] + half, settings.pixel_mm, max(rows, 1), max(columns, 1))
    sampling_mm = spacing_mm(np.array([scan.pipeline.rig_from_array(p.robot_pose)[:3, 3] for p in scan.pings]))
    maps: dict[Interpolation, DepthMap] = {n: interpolate(cloud, raster) for n, interpolate in INTERPOLATIONS.items()}
    heights = maps[settings.interpolation]
    try:
        scale = gray_scale_of(heights) if settings.level_mm is None else gray_scale_from(heights, settings.level_mm)
    except ValueError as error:
        raise ConfigError(f"--levels: {error}") from error
    gray = scale.image(heights)
    smooth = gaussian(gray, SMOOTH_MM / settings.pixel_mm)
    sharp = unsharp(smooth, SHARPEN_MM / settings.pixel_mm)
    segments = edge_segments(
        sharp, round(SHORTEST_EDGE_MM / settings.pixel_mm), round(GAP_MM / settings.pixel_mm), votes=15
    )
    edges = edges_in_rig(segments, heights, raster, sampling_mm, float(np.median(points["sigma_mm"])))
    return Images(
        points, raster, maps, settings.interpolation, scale, gray, smooth, sharp, threshold(sharp), canny(sharp),
        segments, edges,
    )  # fmt: skip


def places_mm(points: Structured) -> Points3:
    """x, y and z of points, (n, 3) float64."""
    return np.column_stack([points[name] for name in ("x_mm", "y_mm", "z_mm")]).astype(np.float64)


def _within(points: Structured, x_mm: tuple[float, float], y_mm: tuple[float, float]) -> Structured:
    inside = points[
        (points["x_mm"] >= x_mm[0]) & (points["x_mm"] <= x_mm[1])
        & (points["y_mm"] >= y_mm[0]) & (points["y_mm"] <= y_mm[1])
    ]  # fmt: skip
    if not inside.size:
        raise ValueError(
            f"the cloud is empty: none of {points.size} contact points lies in the field x {x_mm}, y {y_mm} mm; check "
            "the array, the scan's height and the plan's map"
        )
    low, high = np.percentile(inside["z_mm"], [0.5, 99.5])
    return inside[(inside["z_mm"] >= low - STRAY_MM) & (inside["z_mm"] <= high + STRAY_MM)]
