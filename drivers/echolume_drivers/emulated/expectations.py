"""Whether a map says of a scene's regions what it must: pure functions on images of one raster."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import binary_erosion

from echolume_drivers.emulated.scene_model import Expectation
from echolume_messages.geometry import require_shape
from echolume_messages.types import Label


@dataclass(frozen=True)
class Said:
    """What a map says of one region, and what is asked.

    Attributes
    ----------
    region, what
        Whose figure, and which: ``labels`` (share of cells with a label that they may carry), ``must LABEL`` (share
        with that label), ``height`` (share of the claimed heights that are right).
    share, at_least
        What it is, and what it must be; the share of nothing is 1.
    cells
        How many cells it was taken over.
    """

    region: str
    what: str
    share: float
    at_least: float
    cells: int

    @property
    def kept(self) -> bool:
        """Whether the map says what it must."""
        return self.share >= self.at_least


def judge(
    expect: Sequence[Expectation],
    regions: Sequence[str],
    region: NDArray[np.integer],
    label: NDArray[np.integer],
    front_mm: NDArray[np.floating],
    top_mm: NDArray[np.floating],
    behind_mm: NDArray[np.floating],
    cell_mm: float = 1.0,
) -> list[Said]:
    """Hold a map against a scene's expectations.

    Parameters
    ----------
    expect, regions
        The scene's; `region` counts `regions`.
    region
        Region of each cell, shape (rows, columns), as all images here.
    label, front_mm
        ``Label`` and height that the map gives; nan claims no height.
    top_mm, behind_mm
        Truth: the scene's `front_mm` and `optical_mm`.
    cell_mm
        Of the raster.

    Returns
    -------
    list of Said
        One or more a region, in the order of `expect`.

    Raises
    ------
    ValueError
        If the images differ in shape, or an expectation names no region.
    """
    for name, image in (("label", label), ("front_mm", front_mm), ("top_mm", top_mm), ("behind_mm", behind_mm)):
        require_shape(name, image, region.shape)
    found: list[Said] = []
    for expected in expect:
        if expected.region not in regions:
            raise ValueError(f"expect: no region {expected.region!r}; known: {', '.join(regions)}")
        inside = np.asarray(region == regions.index(expected.region), dtype=np.bool_)
        margin = round(expected.margin_mm / cell_mm)
        if margin > 0:
            shrunk = binary_erosion(inside, np.ones((3, 3)), iterations=margin, border_value=1)
            inside = np.asarray(shrunk, dtype=np.bool_)
        found.extend(_of_region(expected, label[inside], front_mm[inside], top_mm[inside], behind_mm[inside]))
    return found


def _of_region(
    expected: Expectation,
    label: NDArray[np.integer],
    front_mm: NDArray[np.floating],
    top_mm: NDArray[np.floating],
    behind_mm: NDArray[np.floating],
) -> Iterator[Said]:
    allowed = np.isin(label, [Label[name.upper()] for name in expected.may])
    yield Said(expected.region, "labels", _share(allowed), expected.at_least, label.size)
    for name, share in expected.must.items():
        yield Said(expected.region, f"must {name}", _share(label == Label[name.upper()]), share, label.size)
    if expected.height == "any":
        return
    claimed = np.isfinite(front_mm)
    right = np.zeros(label.shape, dtype=np.bool_)
    if expected.height != "behind":
        right |= np.abs(front_mm - top_mm) <= expected.within_mm
    if expected.height != "top":
        right |= np.abs(front_mm - behind_mm) <= expected.within_mm
    yield Said(expected.region, "height", _share(right[claimed]), expected.at_least, int(claimed.sum()))


def _share(held: NDArray[np.bool_]) -> float:
    return float(held.mean()) if held.size else 1.0
