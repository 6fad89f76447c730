"""The few functions of scipy that the fusion uses, with the types that they have there (scipy ships none)."""

from __future__ import annotations

from typing import cast

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy import ndimage, spatial, special

Mask = NDArray[np.bool_]
EIGHT = np.ones((3, 3), dtype=np.bool_)
"""A cell and its eight neighbours."""


def rfft(signal: NDArray[np.floating], length: int | None = None) -> NDArray[np.complexfloating]:
    """Spectrum of real signals along the last axis; single precision stays single."""
    return cast("NDArray[np.complexfloating]", np.asarray(scipy.fft.rfft(signal, n=length, axis=-1)))


def fft(signal: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
    """Spectrum of complex signals along the last axis, complex64."""
    return np.asarray(scipy.fft.fft(signal, axis=-1), dtype=np.complex64)


def ifft(spectrum: NDArray[np.complexfloating]) -> NDArray[np.complex64]:
    """Signal of a spectrum along the last axis, complex64."""
    return np.asarray(scipy.fft.ifft(spectrum, axis=-1), dtype=np.complex64)


def fast_length(least: int) -> int:
    """Smallest length from `least` on that the transform handles fast."""
    return int(cast("int", scipy.fft.next_fast_len(least)))


def labelled(mask: Mask) -> tuple[NDArray[np.int32], int]:
    """Pieces of a mask, connected over eight neighbours, numbered from 1; and how many there are."""
    labels, number = cast("tuple[NDArray[np.int32], int]", ndimage.label(mask, structure=EIGHT))
    return labels, number


def around_each(labels: NDArray[np.int32]) -> list[tuple[slice, slice]]:
    """Where each of the pieces of `labelled` lies in the image, with one cell all around it."""
    found = cast("list[tuple[slice, slice]]", ndimage.find_objects(labels))
    return [(_wider(rows), _wider(columns)) for rows, columns in found]


def _wider(part: slice) -> slice:
    return slice(max(0, part.start - 1), part.stop + 1)


def opened(mask: Mask, square: int) -> Mask:
    """What a square of so many cells fits into; the border is continued, or a hole at the rim would be eaten."""
    padded = np.pad(mask, square, mode="edge")
    found = np.asarray(ndimage.binary_opening(padded, np.ones((square, square), dtype=np.bool_)), dtype=np.bool_)
    return found[square:-square, square:-square] & mask


def dilated(mask: Mask) -> Mask:
    """A mask grown by one cell in all eight directions."""
    return np.asarray(ndimage.binary_dilation(mask, structure=EIGHT), dtype=np.bool_)


def closed(mask: Mask) -> Mask:
    """A mask with its inner holes filled."""
    return np.asarray(ndimage.binary_fill_holes(mask), dtype=np.bool_)


def depth_inside(mask: Mask) -> NDArray[np.float64]:
    """Distance of each cell of a mask to the nearest cell outside it, in cells; what lies beyond counts as outside."""
    found = np.asarray(ndimage.distance_transform_edt(np.pad(mask, 1)), dtype=np.float64)
    return found[1:-1, 1:-1]


def distance_to(mask: Mask) -> NDArray[np.float64]:
    """Distance of each cell to the nearest cell of a mask, in cells; infinite if the mask is empty."""
    if not mask.any():
        return np.full(mask.shape, np.inf)
    return np.asarray(ndimage.distance_transform_edt(~mask), dtype=np.float64)


def interpolated(
    image: NDArray[np.float64], rows: NDArray[np.float64], columns: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Bilinear interpolation at every crossing of some rows and columns, shape (rows, columns)."""
    at = np.stack(np.meshgrid(rows, columns, indexing="ij"))
    return np.asarray(ndimage.map_coordinates(image, at, order=1), dtype=np.float64)


def normal_tail(sigmas: NDArray[np.float64]) -> NDArray[np.float64]:
    """Share of a normal distribution beyond so many standard deviations; 0 at infinity."""
    return np.asarray(special.ndtr(-sigmas), dtype=np.float64)


class NearestPoints:
    """Points (n, 2) that can be asked which of them is near."""

    def __init__(self, points: NDArray[np.float64]) -> None:
        self._points = np.asarray(points, dtype=np.float64)
        self._tree = spatial.KDTree(self._points)

    def nearest(
        self, where: NDArray[np.float64], within: float = np.inf
    ) -> tuple[NDArray[np.float64], NDArray[np.int64]]:
        """Distance and index of the nearest point of each place (m, 2); infinite and n if none is within."""
        distance, index = self._tree.query(where, distance_upper_bound=within)
        return np.asarray(distance, dtype=np.float64), np.asarray(index, dtype=np.int64)

    def some(self, where: NDArray[np.float64], number: int, within: float) -> NDArray[np.int64]:
        """Indices (m, number) of the points nearest to each place (m, 2); n where fewer are within."""
        _, index = self._tree.query(where, k=number, distance_upper_bound=within)
        return np.asarray(index, dtype=np.int64).reshape(len(where), number)

    def around(self, place: NDArray[np.float64], radius: float) -> NDArray[np.int64]:
        """Indices of the points within a radius of one place (2,), sorted."""
        return np.array(sorted(cast("list[int]", self._tree.query_ball_point(place, radius))), dtype=np.int64)

    def spacing(self) -> float:
        """Median distance of a point to the next one."""
        distance, _ = self._tree.query(self._points, k=2)
        return float(np.median(np.asarray(distance, dtype=np.float64)[:, 1]))

    def pairs(self, radius: float) -> NDArray[np.int64]:
        """Index pairs (k, 2) of points at most so far apart."""
        return np.asarray(self._tree.query_pairs(radius, output_type="ndarray"), dtype=np.int64).reshape(-1, 2)
