"""Heights between the points of a cloud, on a raster: nearest, linear and natural neighbours."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Literal, TypeAlias

import cv2
import numba
import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import LinearNDInterpolator
from scipy.spatial import KDTree

from echolume_messages.geometry import Points3, require_shape
from echolume_processing.ultrasonic.raster import Raster, raster_over, require_surface

DepthMap: TypeAlias = NDArray[np.float64]
Interpolation = Literal["nearest", "linear", "natural"]
FINER = 4
"""Discrete natural neighbours are found on a raster so many times finer; even, so that the centres of fine pixels keep
off the lines between the points of a raster."""


def interpolate_nearest(points_mm: Points3, raster: Raster) -> DepthMap:
    """Height of the nearest point at each pixel, (rows, columns) mm.

    Raises
    ------
    ValueError
        If there are no points.

    References
    ----------
    The paper, figure 9.
    """
    require_shape("points_mm", points_mm, (None, 3))
    if not len(points_mm):
        raise ValueError("the cloud is empty: no ping found a surface; check the array and the scan's height")
    _, nearest = KDTree(points_mm[:, :2]).query(raster.centres().reshape(-1, 2))
    return points_mm[nearest, 2].reshape(raster.rows, raster.columns)


def interpolate_linear(points_mm: Points3, raster: Raster, pitch_mm: float) -> DepthMap:
    """Heights interpolated between the poses of a scan with the given pitch, (rows, columns) mm.

    The scan is a raster: its points are averaged on a raster of its own pitch (holes take the nearest value), which is
    then resampled bilinearly.

    Raises
    ------
    ValueError
        If there are fewer than three points, all are in one row, or the pitch is not above 0.
    """
    require_surface(points_mm)
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


def interpolate_delaunay(points_mm: Points3, raster: Raster) -> DepthMap:
    """Heights on the triangles between the points, wherever they lie; nearest outside all of them, (rows, columns) mm.

    Raises
    ------
    ValueError
        If there are fewer than three points, or all are in one row.
    """
    require_surface(points_mm)
    found = np.asarray(LinearNDInterpolator(points_mm[:, :2], points_mm[:, 2])(raster.centres()), dtype=np.float64)
    return np.where(np.isfinite(found), found, interpolate_nearest(points_mm, raster))


def interpolate_natural(points_mm: Points3, raster: Raster) -> DepthMap:
    """Heights by natural neighbours, (rows, columns) mm: smooth but at the points, and never beyond the neighbours'.

    Each fine pixel passes the height of its nearest point to all pixels that are no further from it than that point:
    these would take the fine pixel over if they were points themselves (Sibson's weights, counted instead of measured).

    Raises
    ------
    ValueError
        If there are fewer than three points, or all are in one row.

    Notes
    -----
    The weights are counted on a raster four times finer, so a plane is reproduced to about a tenth of the pixel times
    its slope. Outside the hull of the points the heights run level.

    References
    ----------
    Sibson, A brief description of natural neighbour interpolation, 1981; Park et al., IEEE TVCG 12 (2006) 243,
    doi:10.1109/TVCG.2006.27.
    """
    require_surface(points_mm)
    tree = KDTree(points_mm[:, :2])
    reach = np.asarray(tree.query(raster.centres().reshape(-1, 2))[0], dtype=np.float64).max()
    rim = int(np.ceil(reach / raster.pixel_mm)) + 1
    fine = raster.pixel_mm / FINER
    middle = rim * FINER + 0.5 * (FINER - 1)
    x = raster.x0_mm + fine * (np.arange((raster.columns + 2 * rim) * FINER) - middle)
    y = raster.y0_mm + fine * (np.arange((raster.rows + 2 * rim) * FINER) - middle)
    distance, nearest = tree.query(np.stack(np.meshgrid(x, y), axis=-1).reshape(-1, 2))
    shape = len(y), len(x)
    found = scatter_natural(
        np.asarray(distance, dtype=np.float64).reshape(shape) / raster.pixel_mm,
        points_mm[np.asarray(nearest), 2].reshape(shape),
        rim, raster.rows, raster.columns,
    )  # fmt: skip
    # Points closer together than the fine pixels may have none of their own.
    return np.where(np.isfinite(found), found, interpolate_nearest(points_mm, raster))


@numba.njit(cache=True)
def scatter_natural(
    reach_px: NDArray[np.float64], heights_mm: NDArray[np.float64], rim: int, rows: int, columns: int
) -> NDArray[np.float64]:
    """Mean height (rows, columns) of the fine pixels whose reach covers each pixel; `rim` pixels lie around."""
    total, count = np.zeros((rows, columns)), np.zeros((rows, columns))
    for j in range(reach_px.shape[0]):
        y = (j + 0.5) / FINER - 0.5 - rim
        for i in range(reach_px.shape[1]):
            x = (i + 0.5) / FINER - 0.5 - rim
            # Its own point lies exactly at its reach.
            reach = reach_px[j, i] * (1 + 1e-9)
            for row in range(max(0, int(np.ceil(y - reach))), min(rows, int(np.floor(y + reach)) + 1)):
                wide = np.sqrt(max(reach * reach - (row - y) ** 2, 0.0))
                for column in range(max(0, int(np.ceil(x - wide))), min(columns, int(np.floor(x + wide)) + 1)):
                    total[row, column] += heights_mm[j, i]
                    count[row, column] += 1
    return np.where(count > 0, total / np.maximum(count, 1), np.nan)


INTERPOLATIONS: Mapping[Interpolation, Callable[[Points3, Raster], DepthMap]] = {
    "nearest": interpolate_nearest,
    "linear": interpolate_delaunay,
    "natural": interpolate_natural,
}
"""By the name that a command takes."""
