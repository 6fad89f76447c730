"""Which tiles of the ground a plate covers: box-constrained least squares on the echoes that the base leaves over."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.predict import directivity
from echolume_processing.hybrid.scipy_typed import Mask, closed, interpolated, labelled
from echolume_processing.hybrid.sounding import Sounding, Spectra
from echolume_processing.hybrid.surface import Surface
from echolume_processing.hybrid.tile_kernels import solve_box, tile_spectra

TILE_CELLS = 5
NEAR_MM = 50.0
"""Pings of which neither the foot nor the mirror point on the plate is nearer to a tile's middle do not judge it."""
SMOOTHING = 0.03
RIM_SMOOTHING = 0.05
"""Where what is covered already is only refined, on smaller tiles."""
SWEEPS = 200
PINHOLE_MM2 = 60.0
"""Smaller gaps inside a plate are below what the echoes resolve, and closed."""


@dataclass(frozen=True)
class Tiles:
    """Square tiles of a window of a field; corners are cell indices of their first cell, shape (n, 2) as (j, i)."""

    corners: NDArray[np.int64]
    grid: NDArray[np.int64]
    """Number of each tile in the window's raster of tiles, -1 where there is none."""
    origin: tuple[int, int]
    cells: int = TILE_CELLS
    """Side of a tile."""

    def mean(self, mask: Mask) -> NDArray[np.float64]:
        """Share of each tile of the raster (rows, columns) that a mask covers."""
        rows, columns = self.grid.shape
        padded = np.zeros((rows * self.cells, columns * self.cells))
        j0, i0 = self.origin
        part = mask[j0 : j0 + padded.shape[0], i0 : i0 + padded.shape[1]]
        padded[: part.shape[0], : part.shape[1]] = part
        return np.asarray(padded.reshape(rows, self.cells, columns, self.cells).mean(axis=(1, 3)))

    def fine(self, coarse: NDArray[np.float64], shape: tuple[int, int]) -> NDArray[np.float64]:
        """Values of the raster's tiles (rows, columns), interpolated at every cell of a field; 0 beyond the raster."""
        rows, columns = self.grid.shape
        at_j = (np.arange(rows * self.cells) + 0.5) / self.cells + 0.5
        at_i = (np.arange(columns * self.cells) + 0.5) / self.cells + 0.5
        values = interpolated(np.pad(coarse, 1), at_j, at_i)
        out = np.zeros(shape)
        j0, i0 = self.origin
        target = out[j0 : j0 + values.shape[0], i0 : i0 + values.shape[1]]
        target[...] = values[: target.shape[0], : target.shape[1]]
        return out


@dataclass(frozen=True)
class Occupancy:
    """How much of each tile is covered, and how well that explains the echoes."""

    share: NDArray[np.float64]
    """(tiles,), 0 to 1."""
    explained: float
    """Energy that is left over after the change, as a share of what was left over before it."""


def tiles_over(mask: Mask, cells: int = TILE_CELLS) -> Tiles:
    """Tiles that cover a mask."""
    j, i = np.nonzero(mask)
    j0, i0 = int(j.min()), int(i.min())
    rows, columns = (int(j.max()) - j0) // cells + 1, (int(i.max()) - i0) // cells + 1
    whole = Tiles(np.zeros((0, 2), dtype=np.int64), np.full((rows, columns), -1, dtype=np.int64), (j0, i0), cells)
    used = whole.mean(mask) > 0
    grid = whole.grid
    grid[used] = np.arange(int(used.sum()))
    tj, ti = np.nonzero(used)
    return Tiles(np.column_stack((j0 + tj * cells, i0 + ti * cells)), grid, (j0, i0), cells)


def occupancy(
    found: Sounding,
    base: Surface,
    predicted: Spectra,
    which: NDArray[np.int64],
    plane: Plane | None,
    tiles: Tiles,
    already: NDArray[np.float64] | None = None,
) -> Occupancy:
    """How much of each tile the plate covers.

    Parameters
    ----------
    base
        The surface without the plate.
    predicted
        Echoes for the pings `which`: of the base, with what is covered already.
    plane
        Where the plate lies; None: something that takes the base's echo away and returns none.
    already
        Share of each tile (tiles,) that is covered in `predicted`; None: nothing.

    Notes
    -----
    Linear in the occupancies: a covered tile adds the plate's echo and takes the base's away. The plate's shadow
    on its surroundings is left out here; the final judgement predicts it.
    """
    band = found.band
    every = found.gate.thinning
    left_over = found.gate.spectrum(found.measured[which] - found.gate.waveform(predicted))[..., ::every]
    table = directivity(found.predictor.radius_mm, band.nodes_hz, found.speed_mps)
    wave = 2 * np.pi * band.frequency_hz[::every] / (found.speed_mps * 1e3)
    response = (found.channels.response * found.channels.filter)[:, ::every]
    weights = np.ascontiguousarray(band.weights[:, ::every], dtype=np.float32)
    field = base.field
    middle = np.column_stack(
        (
            field.x_mm[0] + (tiles.corners[:, 1] + tiles.cells / 2) * field.cell_mm,
            field.y_mm[0] + (tiles.corners[:, 0] + tiles.cells / 2) * field.cell_mm,
        )
    )
    foot_mm = found.foot_mm
    count = tiles.corners.shape[0]
    gram, right, before = np.zeros((count, count)), np.zeros(count), 0.0
    there = plane or Plane(0.0, 0.0, 0.0)
    plate_mm, plate_slope = there.image(field), there.slopes(field)
    mirror_mm = foot_mm if plane is None else plane.mirror_points(np.array([a.elements_mm[0] for a in found.apertures]))
    for n, k in enumerate(which):
        away = np.minimum(np.linalg.norm(middle - foot_mm[k], axis=1), np.linalg.norm(middle - mirror_mm[k], axis=1))
        near = np.nonzero(away < NEAR_MM)[0]
        if not near.size:
            continue
        where = found.apertures[int(k)]
        effect = tile_spectra(
            tiles.corners[near], tiles.cells, plane is not None, base.height_mm, base.slope, plate_mm,
            plate_slope, field.x_mm[0], field.y_mm[0], field.cell_mm, where.elements_mm, where.axis,
            table, weights, wave,
        )  # fmt: skip
        effect = (effect * (1j * wave * response).astype(np.complex64)).reshape(near.size, -1)
        real = np.concatenate((effect.real, effect.imag), axis=1)
        target = left_over[n].reshape(-1)
        gram[np.ix_(near, near)] += real @ real.T
        right[near] += real @ np.concatenate((target.real, target.imag))
        before += float((np.abs(target).astype(np.float64) ** 2).sum())
    pull = (
        (SMOOTHING if already is None else RIM_SMOOTHING)
        * float(np.trace(gram))
        / count
        * _roughness(tiles.grid, count)
    )
    start = np.zeros(count) if already is None else already
    change = solve_box(gram + pull, right - pull @ start, -start, 1.0 - start, SWEEPS)
    after = before + float(change @ gram @ change - 2 * right @ change)
    return Occupancy(start + change, after / before if before > 0 else 1.0)


def covered(share: NDArray[np.float64], tiles: Tiles, shape: tuple[int, int], cell_mm: float) -> Mask:
    """Cells that the plate covers: occupancies interpolated between tile middles, cut at one half, pinholes closed."""
    fine = tiles.fine(np.where(tiles.grid >= 0, share[tiles.grid], 0.0), shape) > 0.5
    return without_pinholes(fine, cell_mm)


def without_pinholes(mask: Mask, cell_mm: float) -> Mask:
    """A mask with its inner holes of less than `PINHOLE_MM2` filled."""
    labels, number = labelled(closed(mask) & ~mask)
    if not number:
        return mask
    small = np.bincount(labels.ravel()) * cell_mm**2 < PINHOLE_MM2
    small[0] = False
    return mask | small[labels]


def _roughness(grid: NDArray[np.int64], count: int) -> NDArray[np.float64]:
    """Matrix of the sum of squared differences between neighbouring tiles."""
    out = np.zeros((count, count))
    for a, b in ((grid[:, :-1], grid[:, 1:]), (grid[:-1], grid[1:])):
        both = (a >= 0) & (b >= 0)
        p, q = a[both], b[both]
        np.add.at(out, (p, p), 1.0)
        np.add.at(out, (q, q), 1.0)
        np.add.at(out, (p, q), -1.0)
        np.add.at(out, (q, p), -1.0)
    return out
