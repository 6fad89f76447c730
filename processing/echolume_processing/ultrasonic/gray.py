"""Gray-level images of heights, and their filters."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, TypeAlias

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_processing.ultrasonic.interpolate import DepthMap

GrayImage: TypeAlias = NDArray[np.uint8]
TOP = 255


@dataclass(frozen=True)
class GrayScale:
    """Linear map of heights to gray levels: 0 at `low_mm`, 255 at `high_mm`."""

    low_mm: float
    high_mm: float

    @property
    def resolution_mm(self) -> float:
        """Height of one gray level."""
        return (self.high_mm - self.low_mm) / TOP

    def image(self, heights_mm: DepthMap) -> GrayImage:
        """Gray levels of heights, clipped at both ends."""
        level = (heights_mm - self.low_mm) / self.resolution_mm
        return np.asarray(np.clip(np.rint(level), 0, TOP), dtype=np.uint8)

    def heights(self, image: GrayImage) -> DepthMap:
        """Heights of gray levels, in mm."""
        return self.low_mm + self.resolution_mm * image.astype(np.float64)


def gray_scale_of(heights_mm: DepthMap) -> GrayScale:
    """The scale that spans a map's heights.

    Raises
    ------
    ValueError
        If there are none.
    """
    if not heights_mm.size:
        raise ValueError("heights_mm: there are none to make an image of")
    low, high = float(heights_mm.min()), float(heights_mm.max())
    return GrayScale(low, high if high > low else low + 1.0)


def gray_scale_from(heights_mm: DepthMap, level_mm: float) -> GrayScale:
    """The scale with a chosen height per gray level, from a map's lowest height on.

    Raises
    ------
    ValueError
        If the map's heights do not fit into 256 levels.
    """
    span = gray_scale_of(heights_mm)
    if not level_mm > 0:
        raise ValueError(f"level_mm: expected above 0, got {level_mm}")
    needed_mm = (float(heights_mm.max()) - span.low_mm) / TOP
    if level_mm < needed_mm * (1 - 1e-9):
        raise ValueError(
            f"heights of {float(heights_mm.max()) - span.low_mm:.1f} mm do not fit into 256 gray levels of "
            f"{level_mm:g} mm; take {needed_mm:.3f} mm or more"
        )
    return GrayScale(span.low_mm, span.low_mm + TOP * level_mm)


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
    return np.asarray(cv2.threshold(image, 0 if level == "otsu" else level, TOP, mode)[1], dtype=np.uint8)
