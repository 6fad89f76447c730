"""Straight edges of a gray-level image back in three dimensions, with what is not known about them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_processing.ultrasonic.interpolate import DepthMap
from echolume_processing.ultrasonic.raster import Raster

REACH = 1.5
"""An edge is looked for so many sampling distances to either side of its segment."""
BESIDE_PX = 3
"""The higher side begins within so many pixels of a segment: rims of a coarse scan have teeth."""
MAX_LEAN = 0.35
"""The measured edge may lean this much off its segment, no more (a Hough segment is good to a few pixels)."""


def segments_to_rig(segments_px: NDArray[np.float64], heights_mm: DepthMap, raster: Raster) -> NDArray[np.float64]:
    """Edges back in 3D: both ends of each segment in the rig frame, at the higher side of the edge, (segments, 2, 3).

    References
    ----------
    The paper, figure 10.
    """
    require_shape("segments_px", segments_px, (None, 4))
    require_shape("heights_mm", heights_mm, (raster.rows, raster.columns))
    ends = segments_px.reshape(-1, 2, 2)
    top = cv2.dilate(heights_mm.astype(np.float32), np.ones((2 * BESIDE_PX + 1,) * 2, dtype=np.uint8))
    column = np.clip(np.rint(ends[..., 0]), 0, raster.columns - 1).astype(np.int64)
    row = np.clip(np.rint(ends[..., 1]), 0, raster.rows - 1).astype(np.int64)
    x = raster.x0_mm + raster.pixel_mm * ends[..., 0]
    y = raster.y0_mm + raster.pixel_mm * ends[..., 1]
    return np.stack([x, y, np.asarray(top, dtype=np.float64)[row, column]], axis=-1)


@dataclass(frozen=True)
class Edge:
    """A straight edge between two surfaces, rig frame."""

    ends_mm: NDArray[np.float64]
    """On the higher side, (2, 3)."""
    covariance_mm2: NDArray[np.float64]
    """Of each end, (2, 3, 3)."""
    step_mm: float
    """Height between the two sides."""

    @property
    def sigma_across_mm(self) -> NDArray[np.float64]:
        """Standard deviation of each end across the edge, in the plane of the raster, (2,)."""
        along = self.ends_mm[1, :2] - self.ends_mm[0, :2]
        across = np.array([-along[1], along[0]]) / np.linalg.norm(along)
        return np.sqrt(np.einsum("i,kij,j->k", across, self.covariance_mm2[:, :2, :2], across))


def edges_in_rig(
    segments_px: NDArray[np.float64],
    heights_mm: DepthMap,
    raster: Raster,
    sampling_mm: float,
    height_sigma_mm: float = 0.0,
) -> list[Edge]:
    """Edges measured along segments found by Hough's transform, with their covariance.

    Parameters
    ----------
    segments_px : (segments, 4) float64
        x1, y1, x2, y2.
    heights_mm : (rows, columns) float64
        The map before any filter.
    raster : Raster
    sampling_mm : float
        Distance between the points that the map was interpolated from (`spacing_mm`).
    height_sigma_mm : float
        Of one point's height.

    Returns
    -------
    list of Edge
        Segments along which no step is found are left out.

    Notes
    -----
    Profiles across the segment each give the place of half the step; a line through their medians (one for each
    sampling distance, for these are independent) gives the edge. What sampling hides stays hidden from the fit: an
    edge along the rows of the scan may lie anywhere between two of them (sampling / sqrt 12); one that crosses rows
    is known better in proportion. Along the edge each end is known to a sampling distance in the same sense.

    References
    ----------
    The paper, figure 10.
    """
    require_shape("segments_px", segments_px, (None, 4))
    require_shape("heights_mm", heights_mm, (raster.rows, raster.columns))
    if not sampling_mm > 0:
        raise ValueError(f"sampling_mm: expected above 0, got {sampling_mm}")
    found = (_edge(s.reshape(2, 2), heights_mm, raster, sampling_mm, height_sigma_mm) for s in segments_px)
    return [edge for edge in found if edge is not None]


def _edge(
    ends_px: NDArray[np.float64], heights_mm: DepthMap, raster: Raster, sampling_mm: float, height_sigma_mm: float
) -> Edge | None:
    length_px = float(np.linalg.norm(ends_px[1] - ends_px[0]))
    if length_px < 1:
        return None
    along = (ends_px[1] - ends_px[0]) / length_px
    across = np.array([-along[1], along[0]])
    place = np.arange(0, length_px + 0.5)
    offset = np.arange(
        -np.ceil(REACH * sampling_mm / raster.pixel_mm), np.ceil(REACH * sampling_mm / raster.pixel_mm) + 1
    )
    at = ends_px[0] + place[:, None, None] * along + offset[:, None] * across
    profiles = _sampled(heights_mm, at)
    low, high = profiles[:, :3].mean(axis=1), profiles[:, -3:].mean(axis=1)
    step = float(np.median(high - low))
    if abs(step) < 3 * height_sigma_mm + 1e-9:
        return None
    cross = _crossings(profiles, 0.5 * (low + high), offset)
    group = np.minimum(
        (place * raster.pixel_mm / sampling_mm).astype(np.int64), int(length_px * raster.pixel_mm / sampling_mm)
    )
    bins = [g for g in np.unique(group) if np.isfinite(cross[group == g]).any()]
    if len(bins) < 2:
        return None
    x = np.array([float(place[group == g].mean()) for g in bins])
    y = np.array([float(np.nanmedian(cross[group == g])) for g in bins])
    slope, level, covariance = _line(x, y)
    if abs(slope) > MAX_LEAN:
        return None
    ends_at = np.array([0.0, length_px])
    moved = ends_px + (level + slope * ends_at)[:, None] * across
    spread = np.array([covariance[0, 0] + 2 * e * covariance[0, 1] + e * e * covariance[1, 1] for e in ends_at])
    leaving = np.abs(moved[1] - moved[0]) * raster.pixel_mm
    hidden_mm = sampling_mm / np.sqrt(12) / max(1.0, float(leaving.min()) / sampling_mm)
    across_mm2 = spread * raster.pixel_mm**2 + hidden_mm**2
    tops = np.maximum(low, high)
    top = float(np.median(tops))
    scatter = 1.4826 * float(np.median(np.abs(tops - top)))
    z_mm2 = (scatter**2 + height_sigma_mm**2) / len(bins)
    final = (moved[1] - moved[0]) / np.linalg.norm(moved[1] - moved[0])
    turned = np.array([[final[0], -final[1]], [final[1], final[0]]])
    out = np.zeros((2, 3, 3))
    for k in range(2):
        out[k, :2, :2] = turned @ np.diag([sampling_mm**2 / 12, across_mm2[k]]) @ turned.T
        out[k, 2, 2] = z_mm2
    xy = moved * raster.pixel_mm + [raster.x0_mm, raster.y0_mm]
    return Edge(np.column_stack([xy, [top, top]]), out, abs(step))


def _sampled(heights_mm: DepthMap, at_px: NDArray[np.float64]) -> NDArray[np.float64]:
    """Heights at places (n, m, 2), bilinear, the border continued."""
    where = at_px.astype(np.float32)
    out = cv2.remap(
        heights_mm.astype(np.float32), np.ascontiguousarray(where[..., 0]), np.ascontiguousarray(where[..., 1]),
        cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE,
    )  # fmt: skip
    return np.asarray(out, dtype=np.float64)


def _crossings(
    profiles: NDArray[np.float64], half: NDArray[np.float64], offset: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Offset at which each profile (n, m) crosses half its height next to the segment; not a number if it does not."""
    above = profiles > half[:, None]
    change = above[:, 1:] != above[:, :-1]
    middle = 0.5 * (offset[1:] + offset[:-1])
    cost = np.where(change, np.abs(middle), np.inf)
    best = np.argmin(cost, axis=1)
    rows = np.arange(len(profiles))
    a, b = profiles[rows, best], profiles[rows, best + 1]
    found = np.isfinite(cost[rows, best])
    part = (half - a) / np.where(found, b - a, 1.0)
    return np.where(found, offset[best] + part * (offset[best + 1] - offset[best]), np.nan)


def _line(x: NDArray[np.float64], y: NDArray[np.float64]) -> tuple[float, float, NDArray[np.float64]]:
    """Slope and level of a line through points (n,), and the covariance of (level, slope), (2, 2)."""
    rows = np.column_stack([np.ones(len(x)), x])
    inverse = np.linalg.inv(rows.T @ rows)
    level, slope = (float(v) for v in inverse @ rows.T @ y)
    left = y - level - slope * x
    variance = float(left @ left) / max(len(x) - 2, 1)
    return slope, level, np.asarray(variance * inverse, dtype=np.float64)
