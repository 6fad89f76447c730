"""The raster that a cloud is resampled on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from echolume_messages.geometry import Points3, require_shape

MOST_PIXELS = 50_000_000
"""Larger rasters are a slip of the pixel's size."""
MIN_POINTS = 3
"""Fewer span no surface."""


@dataclass(frozen=True)
class Raster:
    """A raster in the rig frame; pixel (row, column) is centred at (x0 + column * pixel, y0 + row * pixel)."""

    x0_mm: float
    y0_mm: float
    pixel_mm: float
    rows: int
    columns: int

    def centres(self) -> NDArray[np.float64]:
        """x and y of every pixel, (rows, columns, 2)."""
        x = self.x0_mm + self.pixel_mm * np.arange(self.columns)
        y = self.y0_mm + self.pixel_mm * np.arange(self.rows)
        return np.stack(np.meshgrid(x, y), axis=-1).astype(np.float64)


def raster_over(points_mm: Points3, pixel_mm: float) -> Raster:
    """The raster that covers a cloud (n, 3).

    Raises
    ------
    ValueError
        If the cloud is empty, the pixel is not above 0, or the raster would be out of all proportion.
    """
    require_shape("points_mm", points_mm, (None, 3))
    if not len(points_mm):
        raise ValueError("the cloud is empty: no ping found a surface; check the array and the scan's height")
    if not pixel_mm > 0:
        raise ValueError(f"pixel_mm: expected above 0, got {pixel_mm}")
    low, high = points_mm[:, :2].min(axis=0), points_mm[:, :2].max(axis=0)
    columns, rows = (int(np.ceil(span / pixel_mm)) + 1 for span in high - low)
    if columns * rows > MOST_PIXELS:
        raise ValueError(
            f"{columns} x {rows} pixels of {pixel_mm} mm over {high[0] - low[0]:.0f} x {high[1] - low[1]:.0f} mm are "
            "too many; take a larger pixel, or leave out the points that lie far away"
        )
    return Raster(float(low[0]), float(low[1]), pixel_mm, rows, columns)


def require_surface(points_mm: Points3) -> None:
    """Raise ``ValueError`` unless a cloud (n, 3) has three points that are not in one row."""
    require_shape("points_mm", points_mm, (None, 3))
    if len(points_mm) < MIN_POINTS:
        raise ValueError(
            f"the cloud has {len(points_mm)} points; a surface needs {MIN_POINTS} at least: scan more poses"
        )
    away = points_mm[:, :2] - points_mm[:, :2].mean(axis=0)
    across = np.linalg.svd(away, compute_uv=False)
    if not across[1] > 1e-6 * max(float(across[0]), 1e-9):
        raise ValueError(
            f"the cloud's {len(points_mm)} points lie in one row; a surface needs two: scan at least two rows of poses"
        )


def spacing_mm(points_mm: Points3) -> float:
    """Median distance, in x and y, from a point of a cloud (n, 3) to the next one that is not the same."""
    require_surface(points_mm)
    places = np.unique(np.round(points_mm[:, :2], 3), axis=0)
    return float(np.median(np.asarray(KDTree(places).query(places, k=2)[0])[:, 1]))
