"""The hybrid map as a PLY of triangles: the solid surface and, on its own, the glass above it."""

from __future__ import annotations

from collections.abc import Generator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from echolume_messages.files import replacing
from echolume_messages.types import Label, Structured
from echolume_processing.hybrid import ply
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.ply import FACE
from echolume_processing.hybrid.stored import BLOCK, StoredMap, lines_of, unmeasured

STEEPEST = 2.0
"""Rise over run beyond which two cells are the two sides of a step, of which nothing was measured: 63 degrees."""
SOLID, GLASS = 0, 1
BEHIND_RGB = (199, 224, 242)
"""Of what lies behind glass."""
VERTEX = np.dtype([*((name, ply.VERTEX[name].str) for name in ply.VERTEX.names or ()), ("layer", "u1")])


@dataclass(frozen=True)
class Sheet:
    """A surface with at most one height a cell."""

    mesh: int
    height_mm: NDArray[np.float32]
    """Shape (rows, columns); nan: a hole."""
    behind: NDArray[np.bool_]
    """Where the height is what lies behind glass."""


def sheets(found: HybridMap) -> tuple[Sheet, Sheet]:
    """What light could touch (under glass: what lies behind it), and the glass.

    Notes
    -----
    Cells without a height are holes in both; glass of which nothing is known behind it is a hole in the solid.
    """
    front_mm, behind_mm = found.image("front_mm"), found.image("behind_mm")
    glass = (found.image("label") == Label.TRANSPARENT) & np.isfinite(front_mm)
    nowhere = np.zeros(glass.shape, dtype=np.bool_)
    return (
        Sheet(SOLID, np.where(glass, behind_mm, front_mm), glass),
        Sheet(GLASS, np.where(glass, front_mm, np.float32(np.nan)), nowhere),
    )


def triangles(height_mm: NDArray[np.floating], tallest_mm: float) -> NDArray[np.int64]:
    """Triangles between the centres of neighbouring cells.

    Parameters
    ----------
    height_mm
        Height of each cell (rows, columns); nan is a hole, and no triangle touches it.
    tallest_mm
        Most that the corners of a triangle may differ in height; infinity bridges every step.

    Returns
    -------
    ndarray
        Cells (row * columns + column) of the corners (n, 3), counter-clockwise seen from above.

    Notes
    -----
    Four cells are parted along the diagonal that is more nearly level; where one of them is a hole, the other three
    make a triangle.
    """
    rows, columns = height_mm.shape
    at = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = (at[:-1, :-1].ravel(), at[:-1, 1:].ravel(), at[1:, 1:].ravel(), at[1:, :-1].ravel())
    z_mm = height_mm.ravel()
    first = np.nan_to_num(np.abs(z_mm[a] - z_mm[c]), nan=np.inf) <= np.nan_to_num(np.abs(z_mm[b] - z_mm[d]), nan=np.inf)
    lower = np.stack([a, b, np.where(first, c, d)], axis=1)
    upper = np.stack([np.where(first, a, b), c, d], axis=1)
    corners = np.concatenate([lower, upper])
    p_mm, q_mm, r_mm = (z_mm[column] for column in corners.T)
    highest_mm, lowest_mm = np.maximum(np.maximum(p_mm, q_mm), r_mm), np.minimum(np.minimum(p_mm, q_mm), r_mm)
    return corners[np.isfinite(highest_mm) & (highest_mm - lowest_mm <= tallest_mm)]


def write(stored: StoredMap, path: Path, walls: bool = False) -> int:
    """Write both surfaces into one PLY; returns the number of triangles.

    Parameters
    ----------
    stored
        The map.
    path
        Where to; units are mm.
    walls
        Whether steps become walls. Nothing measured them, so by default they stay open.

    Notes
    -----
    Each vertex carries every field of its cell, and ``layer``: 0 front, 1 behind. Each face carries ``mesh``: 0 solid,
    1 glass.
    """
    found = stored.found
    both = sheets(found)
    tallest_mm = np.inf if walls else STEEPEST * found.field.cell_mm
    firsts = (0, int(np.isfinite(both[0].height_mm).sum()))
    count = sum(part.size for sheet in both for part in _faces(sheet, tallest_mm, 0))
    vertices = firsts[1] + int(np.isfinite(both[1].height_mm).sum())
    silent = unmeasured(found)
    elements = [
        ("vertex", vertices, VERTEX),
        ("unmeasured", silent.size, np.dtype(ply.KEPT)),
        *ply.tables(found),
        ("face", count, FACE),
    ]
    with replacing(path) as fresh, fresh.open("wb") as sink:
        sink.write(ply.header(stored, elements))
        for sheet in both:
            for part in _vertices(found, sheet):
                sink.write(part.tobytes())
        sink.write(ply.kept(silent).tobytes())
        for lines in lines_of(found).values():
            sink.write(lines.tobytes())
        for sheet, first in zip(both, firsts, strict=True):
            for part in _faces(sheet, tallest_mm, first):
                sink.write(part.tobytes())
    return count


def read(path: Path) -> StoredMap:
    """Read the map back from the vertices at its fronts.

    Raises
    ------
    ConfigError
        It is no PLY, cut short, or none that a map can be read from.
    """
    return ply.read(path)


def _faces(sheet: Sheet, tallest_mm: float, first: int) -> Generator[Structured]:
    """Faces of a sheet whose first vertex is number `first` of the file, some rows at a time."""
    rows, columns = sheet.height_mm.shape
    number = np.cumsum(np.isfinite(sheet.height_mm).ravel()) - 1 + first
    strip = max(1, BLOCK // columns)
    for top in range(0, rows - 1, strip):
        corners = triangles(sheet.height_mm[top : top + strip + 1], tallest_mm) + top * columns
        faces = np.zeros(len(corners), dtype=FACE)
        faces["corners"], faces["vertex_indices"], faces["mesh"] = 3, number[corners], sheet.mesh
        yield faces


def _vertices(found: HybridMap, sheet: Sheet) -> Generator[Structured]:
    height_mm, behind = sheet.height_mm.ravel(), sheet.behind.ravel()
    places = np.flatnonzero(np.isfinite(height_mm))
    for start in range(0, places.size, BLOCK):
        at = places[start : start + BLOCK]
        plain = ply.vertices(found, found.cells[at])
        vertex = np.zeros(at.size, dtype=VERTEX)
        for name in plain.dtype.names or ():
            vertex[name] = plain[name]
        vertex["z"], vertex["layer"] = height_mm[at], behind[at]
        for name, value in zip(("red", "green", "blue"), BEHIND_RGB, strict=True):
            vertex[name][behind[at]] = value
        yield vertex
