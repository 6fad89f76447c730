"""Images from an ultrasonic cloud: interpolation on a raster, gray levels, filters, edges, and back to 3D."""

from __future__ import annotations

from echolume_processing.ultrasonic.edges import Edge, edges_in_rig, segments_to_rig
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
from echolume_processing.ultrasonic.interpolate import (
    INTERPOLATIONS,
    DepthMap,
    Interpolation,
    interpolate_delaunay,
    interpolate_linear,
    interpolate_natural,
    interpolate_nearest,
)
from echolume_processing.ultrasonic.raster import Raster, raster_over, require_surface, spacing_mm

__all__ = [
    "INTERPOLATIONS",
    "DepthMap",
    "Edge",
    "GrayImage",
    "GrayScale",
    "Interpolation",
    "Raster",
    "canny",
    "edge_segments",
    "edges_in_rig",
    "gaussian",
    "gray_scale_from",
    "gray_scale_of",
    "interpolate_delaunay",
    "interpolate_linear",
    "interpolate_natural",
    "interpolate_nearest",
    "raster_over",
    "require_surface",
    "segments_to_rig",
    "spacing_mm",
    "threshold",
    "unsharp",
]
