"""Which format a file's name asks for, and who writes and reads it."""

from __future__ import annotations

import importlib
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import cast

from echolume_messages.errors import ConfigError
from echolume_processing.hybrid.stored import StoredMap


@dataclass(frozen=True)
class Format:
    """A format of files."""

    ending: str
    module: str
    counts: str
    """What `write` returns the number of."""
    write_name: str = "write"

    def write(self, stored: StoredMap, path: Path) -> int:
        """Write the map; returns how many points, triangles or cells."""
        return cast("Callable[[StoredMap, Path], int]", self._get(self.write_name))(stored, path)

    def read(self, path: Path) -> StoredMap:
        """Read the map back."""
        return cast("Callable[[Path], StoredMap]", self._get("read"))(path)

    def _get(self, name: str) -> object:
        try:
            module = importlib.import_module(f"echolume_processing.{self.module}")
        except ModuleNotFoundError as error:
            if error.name is None or error.name.startswith("echolume"):
                raise
            raise ConfigError(
                f"{self.ending} needs {error.name!r}, which is not installed; pip install 'echolume[lab]'"
            ) from error
        return getattr(module, name)


FORMATS = (
    Format(".mesh.ply", "export.mesh", "triangles"),
    Format(".ply", "hybrid.ply", "points", write_name="write_cloud"),
    Format(".las", "export.las", "points"),
    Format(".e57", "export.e57", "points"),
    Format(".npz", "export.npz", "cells"),
)
"""Longer endings first."""


def format_of(path: Path) -> Format:
    """The format that a file's name asks for.

    Raises
    ------
    ConfigError
        None that is known.
    """
    for known in FORMATS:
        if path.name.lower().endswith(known.ending):
            return known
    endings = ", ".join(known.ending for known in FORMATS)
    raise ConfigError(f"{path}: no format has this ending; known: {endings}")


def read(path: Path) -> StoredMap:
    """Read a map from any file that `echolume` writes.

    Raises
    ------
    ConfigError
        It is a folder, of no known format, damaged, or no map.
    OSError
        As the system says.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the map in it, e.g. {path / 'map.npz'}")
    return format_of(path).read(path)
