"""What every file of a map holds beside its cells, and how cells become records of a file and back."""

from __future__ import annotations

import json
import logging
from collections.abc import Collection, Generator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import ConfigError
from echolume_messages.plan import MapField
from echolume_messages.types import MAP_CELL, Label, Provenance, Structured
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells
from echolume_processing.hybrid.witnesses import Witnesses, tabled

log = logging.getLogger("echolume.export")

FORMAT = 2
ADDED = {2: ("probability", "stripe_first", "stripe_last", "ping")}
"""Fields of a cell that a format has, and those before it have not."""
BLOCK = 1 << 18
"""Cells that are held as records of a file at a time."""
RECORD = np.dtype([(name, MAP_CELL[name].str) for name in MAP_CELL.names or ()])
FIELDS = tuple(name for name in RECORD.names or () if name not in ("ix", "iy"))


@dataclass(frozen=True)
class StoredMap:
    """A map as a file holds it: the map, where it comes from, and what else lies on its cells."""

    found: HybridMap
    scan: str = ""
    calibration: str = ""
    """Digest of the calibration."""
    layers: dict[str, NDArray[Any]] = field(default_factory=dict[str, NDArray[Any]])
    """Further images on the same cells, shape (rows, columns), e.g. ``optical_mm``; only ``.npz`` holds them."""


class About(msgspec.Struct, frozen=True, kw_only=True):
    """What is written into each file, as JSON."""

    format: int
    digest: str
    scan: str
    calibration: str
    field: MapField
    unit: str = "cells and their fields in mm"
    notes: tuple[str, ...] = ()
    registration: Registration = msgspec.field(default_factory=Registration)
    labels: dict[str, int] = {}
    provenance: dict[str, int] = {}

    @classmethod
    def of(cls, stored: StoredMap) -> About:
        """What there is to say about a map."""
        return cls(
            format=FORMAT,
            digest=digest(stored.found),
            scan=stored.scan,
            calibration=stored.calibration,
            field=stored.found.field,
            notes=stored.found.notes,
            registration=stored.found.registration,
            labels={label.name.lower(): label.value for label in Label},
            provenance={bit.name.lower(): bit.value for bit in Provenance if bit.name is not None},
        )

    def text(self) -> str:
        """One line of ASCII, with spaces in its strings only."""
        return json.dumps(msgspec.to_builtins(self, enc_hook=float), separators=(",", ":"))

    @classmethod
    def parse(cls, text: str, path: Path) -> About:
        """What a file says about its map.

        Raises
        ------
        ConfigError
            It is none of ours, or of a version to come.
        """
        try:
            about = msgspec.convert(json.loads(text), cls)
        except (ValueError, msgspec.ValidationError) as error:
            raise ConfigError(f"{path}: what it says about its map cannot be read: {error}") from error
        if not 1 <= about.format <= FORMAT:
            raise ConfigError(f"{path}: is of format {about.format}; this version reads formats 1 to {FORMAT}")
        require_field(about.field, path)
        return about

    @property
    def names(self) -> tuple[str, ...]:
        """Fields of a cell that a file of this format has."""
        return names_of(self.format)

    def stored(
        self,
        cells: Structured,
        path: Path,
        layers: dict[str, NDArray[Any]] | None = None,
        stripes: Witnesses | None = None,
        pings: Witnesses | None = None,
    ) -> StoredMap:
        """The map that a file holds; says so if its cells are no longer those that were written."""
        tables = (stripes or Witnesses(), pings or Witnesses())
        found = HybridMap(self.field, cells, self.registration, self.notes, *tables)
        if digest(found, self.names) != self.digest:
            log.warning("%s: its cells are not those that it was written with (digest %s)", path, self.digest)
        return StoredMap(found, self.scan, self.calibration, layers or {})


def names_of(format_: int) -> tuple[str, ...]:
    """Fields of a cell that a file of some format has."""
    later = {name for since, names in ADDED.items() if since > format_ for name in names}
    return tuple(name for name in RECORD.names or () if name not in later)


def complete(cells: Structured, names: Collection[str]) -> None:
    """Of labels from before there were probabilities, nobody said one."""
    if "probability" not in names:
        cells["probability"][cells["label"] != Label.UNKNOWN] = np.nan


def table_of(pairs: Structured, field: MapField, path: Path) -> Witnesses:
    """A table from the lines of a file.

    Raises
    ------
    ConfigError
        A line is about a cell beyond the field.
    """
    rows, columns = field.shape
    if int(pairs["cell"].max(initial=0)) >= rows * columns:
        raise ConfigError(f"{path}: names triggers of cells beyond its field of {rows} rows and {columns} columns")
    return tabled(pairs["cell"], pairs["trigger"], rows * columns)


def lines_of(found: HybridMap) -> dict[str, Structured]:
    """The tables that a map has, line by line, by the name that they have in its files."""
    tables = {"stripes": found.stripes, "pings": found.pings}
    return {name: table.pairs() for name, table in tables.items() if table.known}


def require_field(field: MapField, path: Path) -> None:
    """See that a field read from a file is one that a map can have.

    Raises
    ------
    ConfigError
        It has no cells, or more in a row than cells have numbers for.
    """
    rows, columns = field.shape
    most = int(np.iinfo(MAP_CELL["ix"]).max)
    if not (0 < rows <= most and 0 < columns <= most):
        raise ConfigError(
            f"{path}: its field {field.x_mm}, {field.y_mm} of {field.cell_mm} mm has no cells, or too many"
        )


def with_height(found: HybridMap) -> NDArray[np.bool_]:
    """The cells that make a point, shape (cells,)."""
    return np.isfinite(found.cells["front_mm"])


def unmeasured(found: HybridMap) -> Structured:
    """Records of the cells without a height that say anything at all, e.g. that pings passed there unheard."""
    cells, empty = found.cells[~with_height(found)], empty_cells(MapField((0.0, 1.0), (0.0, 1.0), 1.0))
    says = np.zeros(cells.size, dtype=np.bool_)
    for name in FIELDS:
        same = cells[name] == empty[name]
        if MAP_CELL[name].kind == "f":
            same |= np.isnan(cells[name]) & np.isnan(empty[name])
        says |= ~same
    return cells[says].astype(RECORD)


def blocks(found: HybridMap, which: NDArray[np.bool_]) -> Generator[Structured]:
    """The chosen cells, some at a time."""
    places = np.flatnonzero(which)
    for start in range(0, places.size, BLOCK):
        at = places[start : start + BLOCK]
        gapless = at[-1] - at[0] == at.size - 1
        yield found.cells[at[0] : at[-1] + 1] if gapless else found.cells[at]


def put_back(about: About, parts: list[Structured], path: Path) -> Structured:
    """All cells of the field, from records that name their own place.

    Raises
    ------
    ConfigError
        A record lies beyond the field, two lie in one cell, or a field is missing.
    """
    cells = empty_cells(about.field)
    rows, columns = about.field.shape
    times = np.zeros(cells.size, dtype=np.int64)
    for part in parts:
        require_names(part.dtype.names or (), about, path)
        ix, iy = part["ix"].astype(np.int64), part["iy"].astype(np.int64)
        if ((ix < 0) | (ix >= columns) | (iy < 0) | (iy >= rows)).any():
            raise ConfigError(f"{path}: holds cells beyond its field of {rows} rows and {columns} columns")
        at = iy * columns + ix
        times += np.bincount(at, minlength=cells.size)
        if times.max(initial=0) > 1:
            raise ConfigError(f"{path}: holds a cell twice")
        for name in about.names:
            if name not in ("ix", "iy"):
                cells[name][at] = part[name]
    complete(cells, about.names)
    return cells


def require_names(there: Collection[str], about: About, path: Path) -> None:
    """See that a file has every field that its format has.

    Raises
    ------
    ConfigError
        One is missing.
    """
    missing = [name for name in about.names if name not in there]
    if missing:
        raise ConfigError(f"{path}: lacks {', '.join(missing)}; expected every field of a map's cells")
