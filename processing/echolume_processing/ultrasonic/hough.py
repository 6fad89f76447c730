"""Straight edges of a gray-level image by Hough's transform, each held up by edge pixels along all of its length."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from echolume_processing.ultrasonic.gray import TOP, GrayImage

WAYS = 12
"""Hough's transform looks at edge pixels of one way of the gradient at a time, so many around the circle."""
WITHIN_RAD = np.radians(35.0)
"""An edge pixel counts for lines that its gradient crosses at no more than this off a right angle."""
GRADIENT_PX = 2.0
"""Gradients are those of the image smoothed by so much: rims of a coarse scan have teeth."""
OFF_PX = 2.5
"""Edge pixels so near to a line are of it."""
GAP_PX = 3.0
"""Edge pixels hold a line up together if no gap between them is longer, or what lies beyond is another edge."""
LEAST_HELD = 0.75
"""Share of a line's length that edge pixels hold up."""


@dataclass(frozen=True)
class EdgePixels:
    """Pixels on Canny's edges: x and y (n, 2), and the unit gradient there, towards the brighter side (n, 2)."""

    at_px: NDArray[np.float64]
    gradient: NDArray[np.float64]

    def only(self, which: NDArray[np.bool_]) -> EdgePixels:
        """Some of them."""
        return EdgePixels(self.at_px[which], self.gradient[which])

    def across(self, normal: NDArray[np.float64]) -> NDArray[np.bool_]:
        """Those whose gradient goes the way of a unit normal (2,), to `WITHIN_RAD`."""
        return self.gradient @ normal >= np.cos(WITHIN_RAD)


@dataclass(frozen=True)
class HeldLine:
    """A straight edge: both ends (2, 2) in pixels, and which edge pixels hold it up (n,)."""

    ends_px: NDArray[np.float64]
    of: NDArray[np.bool_]

    @property
    def length_px(self) -> float:
        """Distance of its ends."""
        return float(np.linalg.norm(self.ends_px[1] - self.ends_px[0]))


def canny(image: GrayImage, low: int = 40, high: int = 120) -> GrayImage:
    """Canny's edges, 255 on them."""
    return np.asarray(cv2.Canny(image, low, high), dtype=np.uint8)


def edge_segments(image: GrayImage, min_length_px: int, max_gap_px: int = 4, votes: int = 20) -> NDArray[np.float64]:
    """Straight edges by Canny and the Hough transform, rows x1, y1, x2, y2 in pixels, (segments, 4).

    Notes
    -----
    The transform alone counts edge pixels wherever they come from: it joins the sides of two bars into a diagonal, or
    their ends across the gap. So it is asked for each way of the gradient by itself (`max_gap_px` is its own, on lines
    one pixel wide), and of what it finds only the part stays that pixels of that way hold up without a gap, moved to
    the line through them. Longest first, each pixel holds up one edge only.

    References
    ----------
    The paper, figure 10.
    """
    pixels = _edge_pixels(image)
    proposals = _proposals(pixels, image.shape, min_length_px, max_gap_px, votes)
    found: list[NDArray[np.float64]] = []
    free = np.ones(len(pixels.at_px), dtype=np.bool_)
    while True:
        held = [_held(pixels, free, ends, normal) for ends, normal in proposals]
        lines = [line for line in held if line is not None and line.length_px >= min_length_px]
        if not lines:
            return np.array(found).reshape(-1, 4)
        longest = max(lines, key=lambda line: line.length_px)
        found.append(longest.ends_px.ravel())
        free &= ~longest.of


def _edge_pixels(image: GrayImage) -> EdgePixels:
    y, x = np.nonzero(canny(image))
    smooth = cv2.GaussianBlur(image.astype(np.float64), (0, 0), GRADIENT_PX)
    gradient = np.stack([cv2.Sobel(smooth, cv2.CV_64F, *order)[y, x] for order in ((1, 0), (0, 1))], axis=-1)
    length = np.linalg.norm(gradient, axis=1, keepdims=True)
    return EdgePixels(np.column_stack([x, y]).astype(np.float64), gradient / np.maximum(length, 1e-9))


def _proposals(
    pixels: EdgePixels, shape: tuple[int, ...], min_length_px: int, max_gap_px: int, votes: int
) -> list[tuple[NDArray[np.float64], NDArray[np.float64]]]:
    """Ends (2, 2) of each line that Hough's transform finds, and its normal (2,) towards the brighter side."""
    out: list[tuple[NDArray[np.float64], NDArray[np.float64]]] = []
    for turn in np.arange(WAYS) * 2 * np.pi / WAYS:
        way = np.array([np.cos(turn), np.sin(turn)])
        x, y = pixels.only(pixels.across(way)).at_px.astype(np.int64).T
        drawn = np.zeros(shape, dtype=np.uint8)
        drawn[y, x] = TOP
        found = cv2.HoughLinesP(drawn, 1, np.pi / 180, votes, minLineLength=min_length_px, maxLineGap=max_gap_px)
        for row in () if found is None else np.asarray(found, dtype=np.float64).reshape(-1, 2, 2):
            along = (row[1] - row[0]) / np.linalg.norm(row[1] - row[0])
            normal = np.array([-along[1], along[0]])
            out.append((row, normal if normal @ way > 0 else -normal))
    return out


def _held(
    pixels: EdgePixels, free: NDArray[np.bool_], ends_px: NDArray[np.float64], normal: NDArray[np.float64]
) -> HeldLine | None:
    """The longest part of a line that free edge pixels hold up, laid through them."""
    along = np.array([-normal[1], normal[0]])
    place = (pixels.at_px - ends_px[0]) @ along
    first, last = sorted((0.0, float((ends_px[1] - ends_px[0]) @ along)))
    near = np.abs((pixels.at_px - ends_px[0]) @ normal) <= OFF_PX
    near &= free & pixels.across(normal) & (place >= first - OFF_PX) & (place <= last + OFF_PX)
    which = np.nonzero(near)[0]
    which = which[np.argsort(place[which], kind="stable")]
    if which.size < 2:
        return None
    parts = np.split(which, np.nonzero(np.diff(place[which]) > GAP_PX)[0] + 1)
    longest = max(parts, key=lambda part: float(place[part[-1]] - place[part[0]]))
    length_px = float(place[longest[-1]] - place[longest[0]])
    held = np.unique(np.rint(place[longest])).size
    if held < LEAST_HELD * (length_px + 1):
        return None
    of = np.zeros(len(place), dtype=np.bool_)
    of[longest] = True
    return HeldLine(_through(pixels.at_px[longest], along), of)


def _through(at_px: NDArray[np.float64], along: NDArray[np.float64]) -> NDArray[np.float64]:
    """Ends (2, 2) of the line through pixels (n, 2), their squared distances the least, in the order of `along`."""
    middle = at_px.mean(axis=0)
    main = np.linalg.svd(at_px - middle, full_matrices=False)[2][0]
    main = main if main @ along > 0 else -main
    place = (at_px - middle) @ main
    return middle + np.array([[place.min()], [place.max()]]) * main
