"""The hybrid map as ASTM E57: a point a cell, every field of the cell in an extension of the format."""

from __future__ import annotations

import importlib
import uuid
from collections.abc import Iterable, Mapping
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import ConfigError
from echolume_messages.files import replacing
from echolume_messages.types import Structured
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm
from echolume_processing.hybrid.ply import LABEL_RGB
from echolume_processing.hybrid.stored import (
    BLOCK,
    RECORD,
    About,
    StoredMap,
    blocks,
    lines_of,
    put_back,
    table_of,
    unmeasured,
    with_height,
)
from echolume_processing.hybrid.witnesses import PAIR, Witnesses

libe57: Any = importlib.import_module("pye57.libe57")  # compiled, without types
PREFIX, URI = "echolume", "urn:echolume:e57:1"
NAMESPACE = uuid.UUID("6f1f2b1e-5d0c-5c0e-9a57-0e57ec401573")
COLOURS = ("colorRed", "colorGreen", "colorBlue")
POINT = np.dtype(
    [
        *((f"cartesian{axis}", "<f8") for axis in "XYZ"),
        ("rowIndex", "<u2"),
        ("columnIndex", "<u2"),
        *((name, "u1") for name in COLOURS),
        *((f"{PREFIX}:{name}", RECORD[name].str) for name in RECORD.names or ()),
    ]
)
LINE = np.dtype([(f"{PREFIX}:{name}", PAIR[name].str) for name in PAIR.names or ()])


def write(stored: StoredMap, path: Path) -> int:
    """Write the cells with a height as one scan; returns how many there are.

    Notes
    -----
    Coordinates are metres in double precision, as E57 has it; the heights in mm are in ``echolume:front_mm`` once more,
    bit for bit. JSON about the map is ``/echolume:about``, the cells without a height are ``/echolume:unmeasured``, the
    triggers that cells rest on ``/echolume:stripes`` and ``/echolume:pings``.

    Raises
    ------
    OSError
        The file cannot be written; what was at `path` stays.
    """
    found = stored.found
    points = with_height(found)
    try:
        with replacing(path) as fresh:
            file = libe57.ImageFile(str(fresh), "w")
            try:
                _write(file, stored, points)
            finally:
                file.close()
    except libe57.E57Exception as error:
        raise OSError(None, f"cannot be written as E57: {error}", str(path)) from error
    return int(points.sum())


def _write(file: Any, stored: StoredMap, points: NDArray[np.bool_]) -> None:
    about = About.of(stored)
    file.extensionsAdd("", libe57.E57_V1_0_URI)
    file.extensionsAdd(PREFIX, URI)
    root = file.root()
    _set(file, root, _root(about))
    root.set(f"{PREFIX}:about", libe57.StringNode(file, about.text()))
    scans, pictures = libe57.VectorNode(file, True), libe57.VectorNode(file, True)
    root.set("data3D", scans)
    root.set("images2D", pictures)
    scan = libe57.StructureNode(file)
    _set(file, scan, _scan(about, stored.found, points))
    found = stored.found
    vector = _vector(file, scan, "points", POINT)
    scans.append(scan)
    record = _record(RECORD.names or ())
    silent = _vector(file, root, f"{PREFIX}:unmeasured", record)
    tables = {name: _vector(file, root, f"{PREFIX}:{name}", LINE) for name in lines_of(found)}
    _fill(file, vector, POINT, (_points(found, cells) for cells in blocks(found, points)))
    _fill(file, silent, record, [unmeasured(found).view(record)])
    for name, lines in lines_of(found).items():
        _fill(file, tables[name], LINE, [lines.view(LINE)])


def _record(names: Iterable[str]) -> np.dtype[np.void]:
    """Records of cells by the names that they have in the file."""
    return np.dtype([(f"{PREFIX}:{name}", RECORD[name].str) for name in names])


def _root(about: About) -> dict[str, Any]:
    return {
        "formatName": "ASTM E57 3D Imaging Data File",
        "guid": f"{{{uuid.uuid5(NAMESPACE, f'file {about.scan} {about.digest}')}}}",
        "versionMajor": 1,
        "versionMinor": 0,
        "e57LibraryVersion": libe57.E57_LIBRARY_ID,
        "coordinateMetadata": "",
        "creationDateTime": {"dateTimeValue": 0.0, "isAtomicClockReferenced": 0},
    }


def _scan(about: About, found: HybridMap, points: NDArray[np.bool_]) -> dict[str, Any]:
    rows, columns = found.field.shape
    head: dict[str, Any] = {
        "guid": f"{{{uuid.uuid5(NAMESPACE, f'scan {about.scan} {about.digest}')}}}",
        "name": about.scan or "hybrid map",
        "description": f"echolume {version('echolume')}, hybrid map, calibration {about.calibration or 'unknown'}",
        "indexBounds": {
            "rowMinimum": 0, "rowMaximum": rows - 1, "columnMinimum": 0, "columnMaximum": columns - 1,
            "returnMinimum": 0, "returnMaximum": 0,
        },
        "colorLimits": {f"{name}{end}": value for name in COLOURS for end, value in (("Minimum", 0), ("Maximum", 255))},
    }  # fmt: skip
    if points.any():
        x_mm, y_mm = cell_centres_mm(found.field)
        cells = found.cells[points]
        sides = {"x": x_mm[cells["ix"]], "y": y_mm[cells["iy"]], "z": cells["front_mm"].astype(np.float64)}
        head["cartesianBounds"] = {
            f"{axis}{end}": float(pick(values) / 1e3)
            for axis, values in sides.items()
            for end, pick in (("Minimum", np.min), ("Maximum", np.max))
        }
    return head


def _set(file: Any, node: Any, values: Mapping[str, Any]) -> None:
    """Put strings, integers, doubles and structures of them into a structure."""
    for name, value in values.items():
        if isinstance(value, dict):
            child = libe57.StructureNode(file)
            node.set(name, child)
            _set(file, child, value)  # pyright: ignore[reportUnknownArgumentType]
        else:
            kind = {str: libe57.StringNode, int: libe57.IntegerNode, float: libe57.FloatNode}[type(value)]
            node.set(name, kind(file, value))


def _vector(file: Any, parent: Any, name: str, dtype: np.dtype[np.void]) -> Any:
    """An empty vector of records in a structure."""
    prototype = libe57.StructureNode(file)
    for field in dtype.names or ():
        code = dtype[field]
        if code.kind == "f":
            precision = libe57.E57_DOUBLE if code.itemsize == 8 else libe57.E57_SINGLE
            node = libe57.FloatNode(file, 0.0, precision)
        else:
            bounds = np.iinfo(code)
            node = libe57.IntegerNode(file, 0, int(bounds.min), int(bounds.max))
        prototype.set(field, node)
    vector = libe57.CompressedVectorNode(file, prototype, libe57.VectorNode(file, True))
    parent.set(name, vector)
    return vector


def _buffers(file: Any, dtype: np.dtype[np.void], size: int) -> tuple[dict[str, NDArray[Any]], Any]:
    kinds = {name: np.dtype(np.longlong) if dtype[name] == np.uint32 else dtype[name] for name in dtype.names or ()}
    columns = {name: np.zeros(size, dtype=kind) for name, kind in kinds.items()}  # the library takes no uint32
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in columns.items():
        buffers.append(libe57.SourceDestBuffer(file, name, column, size, True, True))
    return columns, buffers


def _fill(file: Any, vector: Any, dtype: np.dtype[np.void], parts: Iterable[Structured]) -> None:
    columns, buffers = _buffers(file, dtype, BLOCK)
    writer = vector.writer(buffers)
    for part in parts:
        for start in range(0, part.size, BLOCK):
            some = part[start : start + BLOCK]
            for name, column in columns.items():
                column[: some.size] = some[name]
            writer.write(some.size)
    writer.close()


def _points(found: HybridMap, cells: Structured) -> Structured:
    x_mm, y_mm = cell_centres_mm(found.field)
    points = np.zeros(cells.size, dtype=POINT)
    points["cartesianX"], points["cartesianY"] = x_mm[cells["ix"]] / 1e3, y_mm[cells["iy"]] / 1e3
    points["cartesianZ"] = cells["front_mm"].astype(np.float64) / 1e3
    points["rowIndex"], points["columnIndex"] = cells["iy"], cells["ix"]
    for k, name in enumerate(COLOURS):
        points[name] = LABEL_RGB[cells["label"], k]
    for name in RECORD.names or ():
        points[f"{PREFIX}:{name}"] = cells[name]
    return points


def read(path: Path) -> StoredMap:
    """Read a map from an E57 file that this module wrote.

    Raises
    ------
    ConfigError
        It is no E57, cut short, or none that a map can be read from.
    """
    with path.open("rb"):  # says by name what the system has against it
        pass
    try:
        file = libe57.ImageFile(str(path), "r")
    except libe57.E57Exception as error:
        raise ConfigError(f"{path}: cannot be read as E57 (cut short or damaged?): {error}") from error
    try:
        root = file.root()
        if not root.isDefined(f"{PREFIX}:about"):
            raise ConfigError(f"{path}: does not say which field its points lie on; expected E57 by `echolume`")
        about = About.parse(root[f"{PREFIX}:about"].value(), path)
        points = _cells(file, root["data3D"][0]["points"], about)
        silent = _cells(file, root[f"{PREFIX}:unmeasured"], about)
        stripes, pings = (_table(file, root, name, about, path) for name in ("stripes", "pings"))
    except (libe57.E57Exception, KeyError) as error:
        raise ConfigError(f"{path}: cannot be read as a map's E57 (damaged?): {error}") from error
    finally:
        file.close()
    return about.stored(put_back(about, [points, silent], path), path, stripes=stripes, pings=pings)


def _cells(file: Any, vector: Any, about: About) -> Structured:
    """Records of cells from a vector of the file."""
    columns = _columns(file, vector, _record(about.names))
    cells = np.zeros(int(vector.childCount()), dtype=RECORD)
    for name in about.names:
        cells[name] = columns[f"{PREFIX}:{name}"]
    return cells


def _table(file: Any, root: Any, name: str, about: About, path: Path) -> Witnesses:
    if not root.isDefined(f"{PREFIX}:{name}"):
        return Witnesses()
    columns = _columns(file, root[f"{PREFIX}:{name}"], LINE)
    lines = np.zeros(columns[f"{PREFIX}:cell"].size, dtype=PAIR)
    for key in PAIR.names or ():
        lines[key] = columns[f"{PREFIX}:{key}"]
    return table_of(lines, about.field, path)


def _columns(file: Any, vector: Any, dtype: np.dtype[np.void]) -> dict[str, NDArray[Any]]:
    """Every record of a vector of the file, by field."""
    columns, buffers = _buffers(file, dtype, max(1, int(vector.childCount())))
    if not vector.childCount():
        return {name: column[:0] for name, column in columns.items()}
    reader = vector.reader(buffers)
    reader.read()
    reader.close()
    return columns
