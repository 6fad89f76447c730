"""A heightfield prepared for sound: facets with slopes, horizons for shadow, walls for the double bounce."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numba
import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from echolume_messages.plan import MapField

AZIMUTHS = 24
"""Directions in which the horizon of a facet is known."""
HORIZON_MM = 50.0
UNREACHED = 1e6
"""Tangent of the elevation of a horizon that hides everything."""
WALL_MM = 2.0
"""A rise of more than this between two neighbouring cells is a wall, not a slope."""


@dataclass(frozen=True)
class Surface:
    """What the predictor needs of a heightfield; images have the shape of the field."""

    field: MapField
    height_mm: NDArray[np.float64]
    slope: NDArray[np.float32]
    """dz/dx and dz/dy of each facet, shape (rows, columns, 2)."""
    horizon: NDArray[np.float32]
    """Tangent of the elevation under which the surroundings rise, shape (rows, columns, AZIMUTHS)."""
    walls: NDArray[np.float64]
    """Upright faces (n, 6): x, y of the face's middle, its lower and upper z, and its outward normal nx, ny."""
    hanging: NDArray[np.bool_] | None = None
    """Cells of plates that hang in the air, without sides down to what is below them; None: there are none."""


def surface(height_mm: NDArray[np.float64], field: MapField) -> Surface:
    """Prepare a heightfield without holes.

    Raises
    ------
    ValueError
        If a height is missing: a predictor needs a closed surface.
    """
    if height_mm.shape != field.shape or not np.isfinite(height_mm).all():
        raise ValueError(f"height_mm: expected finite heights of shape {field.shape}, got {height_mm.shape}")
    height_mm = np.ascontiguousarray(height_mm, dtype=np.float64)
    every = (0, height_mm.shape[0], 0, height_mm.shape[1])
    horizon = np.zeros((*height_mm.shape, AZIMUTHS), dtype=np.float32)
    _renew_horizons(horizon, height_mm, field.cell_mm, every)
    return Surface(field, height_mm, slopes(height_mm, field.cell_mm), horizon, _walls(height_mm, field))


def reshaped(scene: Surface, height_mm: NDArray[np.float64], hanging: NDArray[np.bool_] | None = None) -> Surface:
    """The surface with other heights; horizons are renewed only around cells that moved by more than a wall.

    Cells that `hanging` names, and those that hung before, have no sides.
    """
    if hanging is None:
        hanging = scene.hanging
    elif scene.hanging is not None:
        hanging = hanging | scene.hanging
    height_mm = np.ascontiguousarray(height_mm, dtype=np.float64)
    moved = np.abs(height_mm - scene.height_mm) > WALL_MM
    horizon = scene.horizon
    if moved.any():
        reach = round(HORIZON_MM / scene.field.cell_mm)
        j, i = np.nonzero(moved)
        rows, columns = height_mm.shape
        window = (
            max(0, int(j.min()) - reach),
            min(rows, int(j.max()) + reach + 1),
            max(0, int(i.min()) - reach),
            min(columns, int(i.max()) + reach + 1),
        )
        horizon = horizon.copy()
        _renew_horizons(horizon, height_mm, scene.field.cell_mm, window)
    walls = _walls(height_mm, scene.field, hanging)
    return Surface(scene.field, height_mm, slopes(height_mm, scene.field.cell_mm), horizon, walls, hanging)


def without_echo(scene: Surface, mask: NDArray[np.bool_]) -> Surface:
    """The surface with cells that sound does not reach: their horizon is all around and up to the zenith."""
    horizon = scene.horizon.copy()
    horizon[mask] = UNREACHED
    return replace(scene, horizon=horizon)


def _renew_horizons(
    horizon: NDArray[np.float32], height_mm: NDArray[np.float64], cell_mm: float, window: tuple[int, int, int, int]
) -> None:
    """Horizons of the cells in a window (first row, end, first column, end), in place."""
    reach = round(HORIZON_MM / cell_mm)
    _horizons(horizon, height_mm, _highest_around(height_mm, reach), cell_mm, reach, *window)


def slopes(height_mm: NDArray[np.float64], cell_mm: float) -> NDArray[np.float32]:
    """Slope of each cell from those neighbours that no wall separates from it."""
    padded = np.pad(height_mm, 1, mode="edge")
    out = np.zeros((*height_mm.shape, 2), dtype=np.float32)
    for axis, (low, high) in enumerate(((padded[1:-1, :-2], padded[1:-1, 2:]), (padded[:-2, 1:-1], padded[2:, 1:-1]))):
        back, forth = height_mm - low, high - height_mm
        use_back, use_forth = np.abs(back) <= WALL_MM, np.abs(forth) <= WALL_MM
        total = np.where(use_back, back, 0.0) + np.where(use_forth, forth, 0.0)
        out[..., axis] = total / np.maximum(1, use_back.astype(int) + use_forth.astype(int)) / cell_mm
    return out


def _highest_around(height_mm: NDArray[np.float64], reach: int) -> NDArray[np.float64]:
    """Greatest height within `reach` cells of each cell."""
    return np.asarray(ndimage.maximum_filter(height_mm, size=2 * reach + 1, mode="nearest"))


@numba.njit(cache=True)
def _horizons(
    out: NDArray[np.float32],
    height_mm: NDArray[np.float64],
    highest_mm: NDArray[np.float64],
    cell_mm: float,
    reach: int,
    j0: int,
    j1: int,
    i0: int,
    i1: int,
) -> None:
    rows, columns = height_mm.shape
    for a in range(AZIMUTHS):
        angle = 2 * np.pi * a / AZIMUTHS
        dx, dy = np.cos(angle), np.sin(angle)
        for j in range(j0, j1):
            for i in range(i0, i1):
                z, top = height_mm[j, i], highest_mm[j, i]
                best = 0.0
                if top - z > WALL_MM:
                    for s in range(1, reach + 1):
                        ii, jj = int(np.floor(i + s * dx + 0.5)), int(np.floor(j + s * dy + 0.5))
                        if ii < 0 or jj < 0 or ii >= columns or jj >= rows:
                            break
                        rise = height_mm[jj, ii] - z
                        if rise > WALL_MM and rise > best * s * cell_mm:
                            best = rise / ((s - 0.5) * cell_mm)
                        if best * s * cell_mm > top - z:
                            break
                out[j, i, a] = best


def _walls(
    height_mm: NDArray[np.float64], field: MapField, hanging: NDArray[np.bool_] | None = None
) -> NDArray[np.float64]:
    """Faces between neighbouring cells whose heights differ by more than `WALL_MM`, unless the higher one hangs."""
    x_mm = field.x_mm[0] + np.arange(height_mm.shape[1] + 1) * field.cell_mm
    y_mm = field.y_mm[0] + np.arange(height_mm.shape[0] + 1) * field.cell_mm
    found: list[NDArray[np.float64]] = []
    half = 0.5 * field.cell_mm
    rise = np.diff(height_mm, axis=1)
    stands = np.ones(rise.shape, dtype=np.bool_)
    if hanging is not None:
        stands = ~np.where(rise > 0, hanging[:, 1:], hanging[:, :-1])
    j, i = np.nonzero((np.abs(rise) > WALL_MM) & stands)
    low, high = np.minimum(height_mm[j, i], height_mm[j, i + 1]), np.maximum(height_mm[j, i], height_mm[j, i + 1])
    found.append(np.column_stack((x_mm[i + 1], y_mm[j] + half, low, high, -np.sign(rise[j, i]), 0.0 * low)))
    rise = np.diff(height_mm, axis=0)
    stands = np.ones(rise.shape, dtype=np.bool_)
    if hanging is not None:
        stands = ~np.where(rise > 0, hanging[1:], hanging[:-1])
    j, i = np.nonzero((np.abs(rise) > WALL_MM) & stands)
    low, high = np.minimum(height_mm[j, i], height_mm[j + 1, i]), np.maximum(height_mm[j, i], height_mm[j + 1, i])
    found.append(np.column_stack((x_mm[i] + half, y_mm[j + 1], low, high, 0.0 * low, -np.sign(rise[j, i]))))
    return np.ascontiguousarray(np.concatenate(found))
