"""How well a map agrees with the truth: pure functions on height images."""

from __future__ import annotations

from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField

TRANSPARENT = 2
GLASS = 2


class Scores(TypedDict):
    """Figures of one map. A figure that nothing supports (no claim, no glass, no label) is None."""

    rmse_mm: float | None
    f1_at_0p5mm: float
    f1_at_1mm: float
    f1_at_2mm: float
    completeness: float
    glass_recall: float | None
    glass_precision: float | None


class Truth(TypedDict):
    """Truth on the cells of a map, all of shape (rows, columns)."""

    front_mm: NDArray[np.float64]
    glass: NDArray[np.bool_]


def cut(
    front_mm: NDArray[np.float64],
    material: NDArray[np.integer],
    x0_mm: float,
    y0_mm: float,
    cell_mm: float,
    field: MapField,
) -> Truth:
    """The truth arrays, cut to the cells of a map's field.

    Raises
    ------
    ValueError
        If the field is on another raster, or reaches beyond the truth.
    """
    at = window(front_mm.shape, x0_mm, y0_mm, cell_mm, field)
    return Truth(front_mm=front_mm[at].astype(np.float64), glass=material[at] == GLASS)


def window(shape: tuple[int, ...], x0_mm: float, y0_mm: float, cell_mm: float, field: MapField) -> tuple[slice, slice]:
    """Rows and columns of a truth of `shape`, with its corner at (x0_mm, y0_mm), that a map's field takes up.

    Raises
    ------
    ValueError
        If the field is on another raster, or reaches beyond the truth.
    """
    rows, columns = field.shape
    i0, j0 = (field.x_mm[0] - x0_mm) / cell_mm, (field.y_mm[0] - y0_mm) / cell_mm
    if abs(field.cell_mm - cell_mm) > 1e-9 or max(abs(i0 - round(i0)), abs(j0 - round(j0))) > 1e-6:
        raise ValueError(
            f"the map's raster ({field.cell_mm} mm from {field.x_mm[0]}) is not the truth's ({cell_mm} mm)"
        )
    i, j = round(i0), round(j0)
    if i < 0 or j < 0 or j + rows > shape[0] or i + columns > shape[1]:
        raise ValueError(f"the map's field reaches beyond the truth of shape {shape}")
    return slice(j, j + rows), slice(i, i + columns)


def away_from_edges(front_mm: NDArray[np.float64], step_mm: float = 1.0) -> NDArray[np.bool_]:
    """Cells none of whose eight neighbours is higher or lower by more than `step_mm`."""
    padded = np.pad(front_mm, 1, mode="edge")
    rows, columns = front_mm.shape
    flat = np.ones(front_mm.shape, dtype=np.bool_)
    for dj in range(3):
        for di in range(3):
            flat &= np.abs(padded[dj : dj + rows, di : di + columns] - front_mm) <= step_mm
    return flat


def score(
    front_mm: NDArray[np.floating],
    label: NDArray[np.integer] | None,
    truth: Truth,
    among: NDArray[np.bool_] | None = None,
) -> Scores:
    """Scores of a height image against the truth.

    Parameters
    ----------
    front_mm
        Claimed height of each cell (rows, columns); nan claims nothing.
    label
        ``Label`` of each cell, or None for a map that labels nothing.
    truth
        Height and glass of each cell.
    among
        The cells that count; all of them if None.

    Returns
    -------
    Scores
        A claimed cell is correct at t when |height - truth| <= t. Precision is taken over the claimed cells,
        recall over all cells, F1 is their harmonic mean. The truth of glass is its top.

    Raises
    ------
    ValueError
        If the shapes differ.
    """
    if front_mm.shape != truth["front_mm"].shape:
        raise ValueError(f"front_mm: expected shape {truth['front_mm'].shape}, got {front_mm.shape}")
    counted = np.ones(front_mm.shape, dtype=np.bool_) if among is None else among
    claimed = np.isfinite(front_mm) & counted
    error_mm = np.abs(front_mm[claimed].astype(np.float64) - truth["front_mm"][claimed])
    total = int(counted.sum())
    recall, precision = _glass(label, truth["glass"], counted)
    return Scores(
        rmse_mm=float(np.sqrt(np.mean(error_mm**2))) if error_mm.size else None,
        f1_at_0p5mm=_f1(error_mm, 0.5, total),
        f1_at_1mm=_f1(error_mm, 1.0, total),
        f1_at_2mm=_f1(error_mm, 2.0, total),
        completeness=error_mm.size / total if total else 0.0,
        glass_recall=recall,
        glass_precision=precision,
    )


def _f1(error_mm: NDArray[np.float64], tolerance_mm: float, total: int) -> float:
    """Harmonic mean of correct/claimed and correct/total, which is 2 correct / (claimed + total)."""
    correct = int((error_mm <= tolerance_mm).sum())
    return 2 * correct / (error_mm.size + total) if error_mm.size + total else 0.0


def _glass(
    label: NDArray[np.integer] | None, glass: NDArray[np.bool_], counted: NDArray[np.bool_]
) -> tuple[float | None, float | None]:
    """Recall and precision of the label transparent; None where there is nothing to divide by."""
    if label is None:
        return None, None
    named, real = (label == TRANSPARENT) & counted, glass & counted
    hit = int((named & real).sum())
    recall = hit / int(real.sum()) if real.any() else None
    return recall, (hit / int(named.sum()) if named.any() else None)
