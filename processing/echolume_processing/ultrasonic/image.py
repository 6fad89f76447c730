"""Images from an ultrasonic cloud: interpolation on a raster, gray levels, filters, edges, and back to 3D."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial import KDTree

from echolume_messages.geometry import Points3, require_shape

GrayImage = NDArray[np.uint8]
DepthMap = NDArray[np.float64]


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
    """The raster that covers a cloud (n, 3)."""
    require_shape("points_mm", points_mm, (None, 3))
    low, high = points_mm[:, :2].min(axis=0), points_mm[:, :2].max(axis=0)
    columns, rows = (int(np.ceil(span / pixel_mm)) + 1 for span in high - low)
    return Raster(float(low[0]), float(low[1]), pixel_mm, rows, columns)


def interpolate_nearest(points_mm: Points3, raster: Raster) -> DepthMap:
    """Height of the nearest point at each pixel, (rows, columns) mm.

    References
    ----------
    The paper, figure 9.
    """
    require_shape("points_mm", points_mm, (None, 3))
    _, nearest = KDTree(points_mm[:, :2]).query(raster.centres().reshape(-1, 2))
    return points_mm[nearest, 2].reshape(raster.rows, raster.columns)


def interpolate_linear(points_mm: Points3, raster: Raster, pitch_mm: float) -> DepthMap:
    """Heights interpolated between the poses of a scan with the given pitch, (rows, columns) mm.

    The scan is a raster: its points are averaged on a raster of its own pitch (holes take the nearest value), which is
    then resampled bilinearly.
    """
    require_shape("points_mm", points_mm, (None, 3))
    coarse = raster_over(points_mm, pitch_mm)
    column = np.rint((points_mm[:, 0] - coarse.x0_mm) / pitch_mm).astype(np.int64)
    row = np.rint((points_mm[:, 1] - coarse.y0_mm) / pitch_mm).astype(np.int64)
    cell = row * coarse.columns + column
    size = coarse.rows * coarse.columns
    count = np.bincount(cell, minlength=size)
    total = np.bincount(cell, weights=points_mm[:, 2], minlength=size)
    filled = interpolate_nearest(points_mm, coarse).ravel()
    heights = np.where(count > 0, total / np.maximum(count, 1), filled).reshape(coarse.rows, coarse.columns)
    where = ((raster.centres() - [coarse.x0_mm, coarse.y0_mm]) / pitch_mm).astype(np.float32)
    out = cv2.remap(
        heights.astype(np.float32), where[..., 0], where[..., 1], cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE
    )
    return np.asarray(out, dtype=np.float64)


@dataclass(frozen=True)
class GrayScale:
    """Linear map of heights to gray levels: 0 at `low_mm`, 255 at `high_mm`."""

    low_mm: float
    high_mm: float

    @property
    def resolution_mm(self) -> float:
        """Height of one gray level."""
        return (self.high_mm - self.low_mm) / 255

    def image(self, heights_mm: DepthMap) -> GrayImage:
        """Gray levels of heights, clipped at both ends."""
        level = (heights_mm - self.low_mm) / self.resolution_mm
        return np.asarray(np.clip(np.rint(level), 0, 255), dtype=np.uint8)

    def heights(self, image: GrayImage) -> DepthMap:
        """Heights of gray levels, in mm."""
        return self.low_mm + self.resolution_mm * image.astype(np.float64)


def gray_scale_of(heights_mm: DepthMap) -> GrayScale:
    """The scale that spans a map's heights."""
    low, high = float(heights_mm.min()), float(heights_mm.max())
    return GrayScale(low, high if high > low else low + 1.0)


def gaussian(image: GrayImage, sigma_px: float) -> GrayImage:
    """Gaussian filter."""
    return np.asarray(cv2.GaussianBlur(image, (0, 0), sigma_px), dtype=np.uint8)


def unsharp(image: GrayImage, sigma_px: float, amount: float = 1.0) -> GrayImage:
    """Unsharp filter: the image plus `amount` times what a Gaussian takes away."""
    smooth = cv2.GaussianBlur(image, (0, 0), sigma_px)
    return np.asarray(cv2.addWeighted(image, 1 + amount, smooth, -amount, 0), dtype=np.uint8)


def threshold(image: GrayImage, level: int | Literal["otsu"] = "otsu") -> GrayImage:
    """Binary image: 255 above the level; Otsu's method finds the level if none is given."""
    mode = cv2.THRESH_BINARY | (cv2.THRESH_OTSU if level == "otsu" else 0)
    return np.asarray(cv2.threshold(image, 0 if level == "otsu" else level, 255, mode)[1], dtype=np.uint8)


def edge_segments(image: GrayImage, min_length_px: int, max_gap_px: int = 4, votes: int = 20) -> NDArray[np.float64]:
    """Straight edges by Canny and the Hough transform, rows x1, y1, x2, y2 in pixels, (segments, 4)."""
    edges = cv2.Canny(image, 40, 120)
    found = cv2.HoughLinesP(edges, 1, np.pi / 180, votes, minLineLength=min_length_px, maxLineGap=max_gap_px)
    return np.zeros((0, 4)) if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 4)


def segments_to_rig(segments_px: NDArray[np.float64], heights_mm: DepthMap, raster: Raster) -> NDArray[np.float64]:
    """Edges back in 3D: both ends of each segment in the rig frame, at the higher side of the edge, (segments, 2, 3).

    References
    ----------
    The paper, figure 10.
    """
    require_shape("segments_px", segments_px, (None, 4))
    ends = segments_px.reshape(-1, 2, 2)
    top = cv2.dilate(heights_mm.astype(np.float32), np.ones((3, 3), dtype=np.uint8))
    column = np.clip(np.rint(ends[..., 0]), 0, raster.columns - 1).astype(np.int64)
    row = np.clip(np.rint(ends[..., 1]), 0, raster.rows - 1).astype(np.int64)
    x = raster.x0_mm + raster.pixel_mm * ends[..., 0]
    y = raster.y0_mm + raster.pixel_mm * ends[..., 1]
    return np.stack([x, y, np.asarray(top, dtype=np.float64)[row, column]], axis=-1)
