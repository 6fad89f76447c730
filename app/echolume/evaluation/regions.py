"""Pieces of the truth that metrology can be done on: flats and spheres, found by their heights alone."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.sparse import coo_array
from scipy.sparse.csgraph import connected_components

from echolume.evaluation.fits import fit_plane, fit_sphere
from echolume.evaluation.images import Reference
from echolume_messages.plan import MapField

LEVEL_MM = 1e-6
EXACT_MM = 1e-3
"""Most that the truth of a flat or sphere may be off: nominal shapes are, measured ones never."""
STEEPEST = 1.0
"""Rise over run within one smooth piece."""
SMALLEST = 25
"""Cells that lie among cells of the same piece on all sides."""


@dataclass(frozen=True)
class Region:
    """A piece of the truth; images (rows, columns)."""

    shape: Literal["level", "tilted", "sphere"]
    cells: NDArray[np.bool_]
    inside_mm: NDArray[np.float64]
    """How far the centre of each cell lies inside the piece's outline; 0 outside."""

    @property
    def width_mm(self) -> float:
        """Twice the radius of the largest circle in it."""
        return 2 * float(self.inside_mm.max())


def components(right: NDArray[np.bool_], up: NDArray[np.bool_]) -> tuple[NDArray[np.int64], int]:
    """Number the connected pieces of a raster.

    Parameters
    ----------
    right
        Whether each cell is connected with its neighbour along x, shape (rows, columns - 1).
    up
        The same along y, shape (rows - 1, columns).

    Returns
    -------
    number, count
        The piece of each cell (rows, columns), and how many there are.
    """
    rows, columns = right.shape[0], up.shape[1]
    at = np.arange(rows * columns).reshape(rows, columns)
    one = np.concatenate([at[:, :-1][right], at[:-1][up]])
    other = np.concatenate([at[:, 1:][right], at[1:][up]])
    graph = coo_array((np.ones(one.size, dtype=np.bool_), (one, other)), shape=(at.size, at.size))
    count, number = connected_components(graph, directed=False)
    return np.asarray(number, dtype=np.int64).reshape(rows, columns), int(count)


def regions(truth: Reference, field: MapField) -> list[Region]:
    """Flats and spheres of the truth, largest first.

    Notes
    -----
    A piece has one label. Level flats are taken first, then what is left is parted at steps, and each part is kept if
    it is a plane or a sphere to within a micrometre. A measured truth has none.
    """
    known = np.isfinite(truth.front_mm)
    level = _pieces(truth, known, LEVEL_MM)
    taken = np.zeros(known.shape, dtype=np.bool_)
    found: list[Region] = []
    for cells in level:
        taken |= cells
        found.append(Region("level", cells, _inside_mm(cells, field)))
    for cells in _pieces(truth, known & ~taken, STEEPEST * field.cell_mm):
        shape = _shape_of(cells, truth.front_mm, field)
        if shape is not None:
            found.append(Region(shape, cells, _inside_mm(cells, field)))
    return sorted(found, key=lambda region: -int(region.cells.sum()))


def _pieces(truth: Reference, among: NDArray[np.bool_], rise_mm: float) -> list[NDArray[np.bool_]]:
    """Connected pieces of one label whose neighbours differ by at most `rise_mm`, if they are more than lines."""
    height_mm, label = np.where(among, truth.front_mm, np.nan), truth.label
    right = (np.abs(np.diff(height_mm, axis=1)) <= rise_mm) & (np.diff(label, axis=1) == 0)
    up = (np.abs(np.diff(height_mm, axis=0)) <= rise_mm) & (np.diff(label, axis=0) == 0)
    number, count = components(right, up)
    inner = np.zeros(number.shape, dtype=np.bool_)
    if min(number.shape) >= 3:
        middle = number[1:-1, 1:-1]
        around = [
            number[1 + j : number.shape[0] - 1 + j, 1 + i : number.shape[1] - 1 + i]
            for j in (-1, 0, 1)
            for i in (-1, 0, 1)
        ]
        inner[1:-1, 1:-1] = np.logical_and.reduce([middle == other for other in around])
    inner &= among
    sizes = np.bincount(number[inner], minlength=count)
    return [number == k for k in np.flatnonzero(sizes >= SMALLEST)]


def _shape_of(
    cells: NDArray[np.bool_], front_mm: NDArray[np.float64], field: MapField
) -> Literal["tilted", "sphere"] | None:
    points_mm = points_of(cells, front_mm, field)
    if np.ptp(fit_plane(points_mm).off_mm) <= EXACT_MM:
        return "tilted"
    sphere = fit_sphere(points_mm)
    return "sphere" if sphere is not None and np.ptp(sphere.off_mm) <= EXACT_MM else None


def points_of(cells: NDArray[np.bool_], height_mm: NDArray[np.float64], field: MapField) -> NDArray[np.float64]:
    """Points (n, 3) at the centres of cells, in mm."""
    iy, ix = np.nonzero(cells)
    x_mm = field.x_mm[0] + (ix + 0.5) * field.cell_mm
    y_mm = field.y_mm[0] + (iy + 0.5) * field.cell_mm
    return np.asarray(np.stack([x_mm, y_mm, height_mm[cells]], axis=1), dtype=np.float64)


def distance_mm(cells: NDArray[np.bool_], field: MapField) -> NDArray[np.float64]:
    """How far each cell's centre is from the outline of other cells; 0 inside them."""
    away_mm = np.zeros(cells.shape)
    away_mm[~cells] = (np.asarray(distance_transform_edt(~cells))[~cells] - 0.5) * field.cell_mm
    return away_mm


def _inside_mm(cells: NDArray[np.bool_], field: MapField) -> NDArray[np.float64]:
    """The border of the field is no outline; a piece that fills the field lies infinitely deep in itself."""
    if cells.all():
        return np.full(cells.shape, np.inf)
    return distance_mm(~cells, field)
