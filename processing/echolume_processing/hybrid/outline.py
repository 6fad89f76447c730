"""Straight outlines: plates have edges, and the tiles that find them round off the corners."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_processing.hybrid.scipy_typed import Mask

FINER = 8
"""Pixels a cell in which outlines are followed and filled."""
BEND_MM = 1.8
"""An outline that leaves its chord by no more is a straight side."""
SIDE_MM = 14.0
"""Shorter sides are bends, and stay as they are."""
CORNER_MM = 7.0
"""A rounded corner is no longer than this; the sides next to it meet within this distance of it."""


def straightened(mask: Mask, cell_mm: float) -> Mask:
    """A mask whose long straight sides are lines that meet in corners.

    Parameters
    ----------
    mask
        Cells (rows, columns), holes included.
    cell_mm
        Their side.

    Returns
    -------
    Mask
        The same outline where it bends.

    Notes
    -----
    Each side is the line of least absolute deviations through the outline between its ends, those left out.
    """
    finer = np.kron(np.pad(mask, 2).astype(np.uint8), np.ones((FINER, FINER), dtype=np.uint8))
    contours, _ = cv2.findContours(finer, cv2.RETR_CCOMP, cv2.CHAIN_APPROX_NONE)
    out = np.zeros_like(finer)
    scale = FINER / cell_mm
    polygons = [_polygon(np.asarray(c, dtype=np.float64)[:, 0, :], scale) for c in contours if len(c) >= 4 * FINER]
    cv2.fillPoly(out, [np.round(p * 16).astype(np.int32) for p in polygons], 1, shift=4)  # even-odd: holes stay
    rows, columns = mask.shape
    share = out.reshape(rows + 4, FINER, columns + 4, FINER).mean(axis=(1, 3))
    return np.asarray(share[2:-2, 2:-2] > 0.5)


def _polygon(contour: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Vertices (n, 2) of an outline, in pixels: corners where straight sides meet, its own points where it bends."""
    closed = contour.astype(np.int32)[:, None, :]
    vertices = np.asarray(cv2.approxPolyDP(closed, BEND_MM * scale, True))[:, 0, :]
    starts = np.sort([int(np.flatnonzero((contour == v).all(axis=1))[0]) for v in vertices])
    ends = np.append(starts[1:], starts[0] + len(contour))
    sides = [np.arange(a, b + 1) % len(contour) for a, b in zip(starts, ends, strict=True)]
    lines = [_line(contour[side], scale) for side in sides]
    if all(line is None for line in lines):
        return contour
    first = next(k for k, line in enumerate(lines) if line is not None)
    order = [(first + k) % len(sides) for k in range(len(sides))]
    straight = [k for k in order if lines[k] is not None]
    points: list[NDArray[np.float64]] = []
    for n, k in enumerate(straight):
        following = straight[(n + 1) % len(straight)]
        gap = (
            order[(order.index(k) + 1) :] if following == first else order[order.index(k) + 1 : order.index(following)]
        )
        end, begin = contour[sides[k][-1]], contour[sides[following][0]]
        corner = _meeting(lines[k], lines[following])
        near = (
            corner is not None
            and max(np.linalg.norm(corner - end), np.linalg.norm(corner - begin)) <= CORNER_MM * scale
        )
        if near and corner is not None:
            points.append(corner[None, :])
            continue
        points.append(_onto(lines[k], end)[None, :])
        points.extend(contour[sides[g]] for g in gap)
        points.append(_onto(lines[following], begin)[None, :])
    return np.concatenate(points)


Line = tuple[NDArray[np.float64], NDArray[np.float64]]
"""A point of it and its direction."""


def _line(side: NDArray[np.float64], scale: float) -> Line | None:
    """The line of a long side, from its middle part; None if it is short."""
    along = np.linalg.norm(side[-1] - side[0])
    if along < SIDE_MM * scale:
        return None
    cut = int(min(0.5 * CORNER_MM * scale, 0.25 * len(side)))
    fitted = cv2.fitLine(side[cut : len(side) - cut].astype(np.float32), cv2.DIST_L1, 0, 0.01, 0.01)
    dx, dy, x, y = np.asarray(fitted, dtype=np.float64).ravel()
    return np.array([x, y]), np.array([dx, dy])


def _meeting(one: Line | None, other: Line | None) -> NDArray[np.float64] | None:
    """Where two lines meet; None if they are all but parallel."""
    if one is None or other is None:
        return None
    (p, d), (q, e) = one, other
    cross = d[0] * e[1] - d[1] * e[0]
    if abs(cross) < 0.2:
        return None
    return p + d * ((q[0] - p[0]) * e[1] - (q[1] - p[1]) * e[0]) / cross


def _onto(line: Line | None, point: NDArray[np.float64]) -> NDArray[np.float64]:
    """The point of a line nearest to a point."""
    if line is None:
        return point
    p, d = line
    return p + d * float((point - p) @ d)
