"""The hybrid map as ``.npz``: every field an image, readable with numpy alone."""

from __future__ import annotations

import zipfile
import zlib
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import ConfigError
from echolume_messages.files import replacing
from echolume_messages.plan import MapField
from echolume_messages.types import MAP_CELL
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells
from echolume_processing.hybrid.stored import FIELDS, FORMAT, About, StoredMap, complete, names_of, require_field
from echolume_processing.hybrid.witnesses import Witnesses

ABOUT = ("about", "x_mm", "y_mm", "cell_mm")
TABLES = ("stripe_start", "stripe_ids", "ping_start", "ping_ids")
"""Where the triggers of each cell begin, and the triggers, of stripes and of pings."""


def write(stored: StoredMap, path: Path) -> int:
    """Write every field as an image (rows along y, columns along x), further layers beside, and what is known about
    the map as JSON in ``about``; returns the number of cells."""
    found = stored.found
    tables = (found.stripes.start, found.stripes.which, found.pings.start, found.pings.which)
    with replacing(path) as fresh, fresh.open("wb") as sink:
        np.savez(
            sink,
            allow_pickle=False,
            **{name: found.image(name) for name in FIELDS},
            **stored.layers,
            **dict(zip(TABLES, tables, strict=True)),
            x_mm=np.array(found.field.x_mm),
            y_mm=np.array(found.field.y_mm),
            cell_mm=np.array(found.field.cell_mm),
            about=np.array(About.of(stored).text()),
        )
    return int(found.cells.size)


def read(path: Path) -> StoredMap:
    """Read a map from ``.npz``; one without ``about`` (of an earlier version) has no origin and no notes.

    One without the fields and tables that came with format 2 has no probabilities and no triggers.

    Raises
    ------
    ConfigError
        It is no ``.npz``, cut short, or lacks a field.
    """
    images = arrays(path)
    about = About.parse(str(images["about"]), path) if "about" in images else None
    first = about.format if about else FORMAT if "probability" in images else 1
    names = [name for name in names_of(first) if name in FIELDS]
    missing = [name for name in (*names, *ABOUT[1:]) if name not in images]
    if missing:
        raise ConfigError(f"{path}: lacks {', '.join(missing)}; expected a map.npz with every field of a map's cells")
    field = _field(images, path)
    cells = empty_cells(field)
    layers: dict[str, NDArray[Any]] = {}
    for name, image in images.items():
        if name in ABOUT or name in TABLES:
            continue
        if image.shape != field.shape:
            raise ConfigError(f"{path}: {name}: expected shape {field.shape}, got {image.shape}")
        if name not in FIELDS:
            layers[name] = image
        elif image.dtype != MAP_CELL[name]:
            raise ConfigError(f"{path}: {name}: expected {MAP_CELL[name]}, got {image.dtype}")
        else:
            cells[name] = image.ravel()
    complete(cells, names)
    stripes, pings = (_table(images, start, ids, cells.size, path) for start, ids in (TABLES[:2], TABLES[2:]))
    if about is None:
        return StoredMap(HybridMap(field, cells, Registration(), (), stripes, pings), layers=layers)
    if about.field != field:
        raise ConfigError(f"{path}: its field is {field}, but it says {about.field}")
    return about.stored(cells, path, layers, stripes, pings)


def _table(images: dict[str, NDArray[Any]], start: str, ids: str, cells: int, path: Path) -> Witnesses:
    """One table of triggers; none where the file has none.

    Raises
    ------
    ConfigError
        It is no table of these cells.
    """
    if start not in images and ids not in images:
        return Witnesses()
    if start not in images or ids not in images:
        raise ConfigError(f"{path}: has only one of {start} and {ids}; expected both or neither")
    found = Witnesses(images[start], images[ids])
    first, which = found.start, found.which
    if first.dtype != np.int64 or which.dtype != np.uint32 or first.ndim != 1 or which.ndim != 1:
        raise ConfigError(f"{path}: {start}, {ids}: expected int64 and uint32, got {first.dtype} and {which.dtype}")
    whole = first.size in (1, cells + 1) and first[0] == 0 and first[-1] == which.size
    if not whole or (np.diff(first) < 0).any():
        raise ConfigError(f"{path}: {start} does not divide {which.size} triggers among {cells} cells")
    return found


def arrays(path: Path) -> dict[str, NDArray[Any]]:
    """Every array of a ``.npz``.

    Raises
    ------
    ConfigError
        It is no ``.npz``, cut short or damaged.
    """
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as found:
            if not isinstance(found, np.lib.npyio.NpzFile):
                raise ConfigError(f"{path}: is a single array; expected .npz")
            return {name: found[name] for name in found.files}
    except (ValueError, EOFError, KeyError, zipfile.BadZipFile, zlib.error) as error:
        raise ConfigError(f"{path}: cannot be read as .npz (cut short or damaged?): {error}") from error


def _field(images: dict[str, NDArray[Any]], path: Path) -> MapField:
    try:
        x0_mm, x1_mm = (float(v) for v in images["x_mm"].ravel())
        y0_mm, y1_mm = (float(v) for v in images["y_mm"].ravel())
        cell_mm = float(images["cell_mm"])
    except (TypeError, ValueError) as error:
        raise ConfigError(f"{path}: x_mm, y_mm or cell_mm is not what a map has: {error}") from error
    if not (x1_mm > x0_mm and y1_mm > y0_mm and cell_mm > 0 and np.isfinite([x0_mm, x1_mm, y0_mm, y1_mm]).all()):
        raise ConfigError(f"{path}: x_mm, y_mm and cell_mm describe no field: {x0_mm, x1_mm, y0_mm, y1_mm, cell_mm}")
    field = MapField(x_mm=(x0_mm, x1_mm), y_mm=(y0_mm, y1_mm), cell_mm=cell_mm)
    require_field(field, path)
    return field
