"""The hybrid map as a PLY point cloud that keeps every field of a cell."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import BinaryIO

import numpy as np

from echolume_messages.errors import ConfigError
from echolume_messages.files import replacing
from echolume_messages.types import Label, Structured
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm
from echolume_processing.hybrid.stored import (
    RECORD,
    About,
    StoredMap,
    blocks,
    lines_of,
    put_back,
    require_names,
    table_of,
    unmeasured,
    with_height,
)
from echolume_processing.hybrid.witnesses import PAIR, Witnesses

KEPT = [(name, RECORD[name].str) for name in RECORD.names or () if name != "front_mm"]
"""Fields of a cell that are properties of its vertex; its height is the vertex's z."""
VERTEX = np.dtype([("x", "<f4"), ("y", "<f4"), ("z", "<f4"), ("red", "u1"), ("green", "u1"), ("blue", "u1"), *KEPT])
_PLY_TYPE = {
    "|i1": "char", "|u1": "uchar", "<i2": "short", "<u2": "ushort", "<i4": "int", "<u4": "uint", "<f4": "float",
    "<f8": "double",
}  # fmt: skip
_DTYPE = {
    **{name: code for code, name in _PLY_TYPE.items()},
    "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2", "int32": "<i4", "uint32": "<u4",
    "float32": "<f4", "float64": "<f8",
}  # fmt: skip
FACE = np.dtype([("corners", "u1"), ("vertex_indices", "<i4", (3,)), ("mesh", "u1")])
"""A triangle: the only list that these files hold."""
LONGEST_HEADER = 1 << 20
PER_COMMENT = 200
"""Characters of a comment: some readers take no line longer than 1023."""

LABEL_RGB = np.zeros((len(Label), 3), dtype=np.uint8)
"""One colour a label, shared by every picture."""
LABEL_RGB[Label.UNKNOWN] = (128, 128, 128)
LABEL_RGB[Label.MATTE] = (222, 197, 156)
LABEL_RGB[Label.TRANSPARENT] = (64, 160, 224)
LABEL_RGB[Label.ABSORBING] = (40, 40, 52)
LABEL_RGB[Label.OCCLUDED] = (224, 120, 64)


def write(found: HybridMap, path: Path, scan: str = "", calibration: str = "") -> int:
    """Write the cells with a height as the points of a binary PLY; returns how many there are.

    Notes
    -----
    Coordinates are mm in the rig frame. Cells without a height are no points; those that say anything are the
    element ``unmeasured``, the triggers that cells rest on are ``stripes`` and ``pings``: other readers pass over them.
    """
    return write_cloud(StoredMap(found, scan, calibration), path)


def write_cloud(stored: StoredMap, path: Path) -> int:
    """The same for a map that comes with its origin.

    Raises
    ------
    OSError
        As the system says; what was at `path` stays.
    """
    found = stored.found
    points, silent = with_height(found), unmeasured(found)
    count = int(points.sum())
    with replacing(path) as fresh, fresh.open("wb") as sink:
        elements = [("vertex", count, VERTEX), ("unmeasured", silent.size, np.dtype(KEPT)), *tables(found)]
        sink.write(header(stored, elements))
        for cells in blocks(found, points):
            sink.write(vertices(found, cells).tobytes())
        sink.write(kept(silent).tobytes())
        for lines in lines_of(found).values():
            sink.write(lines.tobytes())
    return count


def tables(found: HybridMap) -> list[tuple[str, int, np.dtype[np.void]]]:
    """The elements that say which triggers cells rest on."""
    return [(name, lines.size, PAIR) for name, lines in lines_of(found).items()]


def vertices(found: HybridMap, cells: Structured) -> Structured:
    """Vertices at the fronts of cells (n,)."""
    x_mm, y_mm = cell_centres_mm(found.field)
    vertex = np.zeros(cells.size, dtype=VERTEX)
    vertex["x"], vertex["y"], vertex["z"] = x_mm[cells["ix"]], y_mm[cells["iy"]], cells["front_mm"]
    for k, name in enumerate(("red", "green", "blue")):
        vertex[name] = LABEL_RGB[cells["label"], k]
    for name, _ in KEPT:
        vertex[name] = cells[name]
    return vertex


def header(stored: StoredMap, elements: Sequence[tuple[str, int, np.dtype[np.void]]]) -> bytes:
    """Header of a PLY file with what is known about its map as comments."""
    names = ", ".join(f"{label.value} {label.name.lower()}" for label in Label)
    about = About.of(stored)
    text = about.text().replace(" ", "\\u0020")  # programs that rewrite a file strip its comments
    lines = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment echolume hybrid map, millimetres, digest {about.digest}",
        f"comment label: {names}",
        "comment provenance bits: 1 stereo, 2 active left, 4 active right, 8 ultrasonic, 16 filled",
        *(f"comment note: {one_line(note)}" for note in stored.found.notes),
        *(f"comment about:{text[k : k + PER_COMMENT]}" for k in range(0, len(text), PER_COMMENT)),
    ]
    for name, count, dtype in elements:
        lines.append(f"element {name} {count}")
        lines += _properties(dtype)
    return "\n".join([*lines, "end_header\n"]).encode("ascii", "replace")


def one_line(note: str) -> str:
    """A note that cannot end its line, nor pass what a reader takes."""
    return " ".join(note.split())[:900]


def _properties(dtype: np.dtype[np.void]) -> Iterable[str]:
    if dtype == FACE:
        return ["property list uchar int vertex_indices", "property uchar mesh"]
    return [f"property {_PLY_TYPE[dtype[name].str]} {name}" for name in dtype.names or ()]


def kept(cells: Structured) -> Structured:
    """What of cells is kept beside their heights."""
    fields = np.zeros(cells.size, dtype=KEPT)
    for name, _ in KEPT:
        fields[name] = cells[name]
    return fields


def read(path: Path) -> StoredMap:
    """Read a map from a PLY file that this module or the mesh export wrote.

    Raises
    ------
    ConfigError
        It is no PLY, cut short, or none that a map can be read from.
    """
    with path.open("rb") as source:
        about_text, elements = _read_header(source, path)
        if not about_text:
            raise ConfigError(
                f"{path}: does not say which field its points lie on, so there is no map in it; "
                "expected a PLY file that `echolume` wrote (give map.npz for one of an earlier version)"
            )
        about = About.parse(about_text, path)
        found = {name: _read_element(source, count, dtype, path) for name, count, dtype in elements}
    if "vertex" not in found:
        raise ConfigError(f"{path}: has no vertices; expected a PLY file of a map")
    vertex = found["vertex"]
    fronts = vertex[vertex["layer"] == 0] if "layer" in (vertex.dtype.names or ()) else vertex
    parts = [_records(fronts, about, path)]
    if "unmeasured" in found:
        parts.append(_records(found["unmeasured"], about, path))
    stripes, pings = (_table(found, name, about, path) for name in ("stripes", "pings"))
    return about.stored(put_back(about, parts, path), path, stripes=stripes, pings=pings)


def _table(found: dict[str, Structured], name: str, about: About, path: Path) -> Witnesses:
    if name not in found:
        return Witnesses()
    lines = found[name]
    if lines.dtype != PAIR:
        raise ConfigError(f"{path}: {name}: expected lines of cell and trigger, got {lines.dtype.names}")
    return table_of(lines, about.field, path)


def _records(read: Structured, about: About, path: Path) -> Structured:
    """Records of cells from vertices, or from cells without a height."""
    there = read.dtype.names or ()
    require_names(("front_mm", *there), about, path)
    cells = np.zeros(read.size, dtype=RECORD)
    for name in about.names:
        if name != "front_mm":
            cells[name] = read[name]
    cells["front_mm"] = read["z"] if "z" in there else np.nan
    return cells


def _read_header(source: BinaryIO, path: Path) -> tuple[str, list[tuple[str, int, np.dtype[np.void]]]]:
    if source.readline(16).rstrip() != b"ply":
        raise ConfigError(f"{path}: is no PLY file")
    about = ""
    elements: list[tuple[str, int, list[tuple[str, str] | tuple[str, str, tuple[int]]]]] = []
    while source.tell() < LONGEST_HEADER:
        line = source.readline(LONGEST_HEADER).decode("ascii", "replace").rstrip("\r\n")
        words = line.split()
        match words:
            case ["end_header"]:
                return about, [(name, count, np.dtype(fields)) for name, count, fields in elements]
            case ["format", kind, *_] if kind != "binary_little_endian":
                raise ConfigError(f"{path}: is {kind} PLY; expected binary_little_endian, as `echolume` writes it")
            case ["comment", *_] if line.startswith("comment about:"):
                about += line.removeprefix("comment about:")
            case ["element", name, count] if count.isdigit():
                elements.append((name, int(count), []))
            case ["property", "list", "uchar", "int", name] if elements:
                elements[-1][2].extend([("corners", "u1"), (name, "<i4", (3,))])
            case ["property", kind, name] if elements and kind in _DTYPE:
                elements[-1][2].append((name, _DTYPE[kind]))
            case ["property", *_] | ["element", *_] | []:
                raise ConfigError(f"{path}: its header has {line!r}, which no file of a map has")
            case _:
                pass
    raise ConfigError(f"{path}: its header does not end")


def _read_element(source: BinaryIO, count: int, dtype: np.dtype[np.void], path: Path) -> Structured:
    if path.stat().st_size - source.tell() < count * dtype.itemsize:
        raise ConfigError(f"{path}: ends before its {count} records do: it is cut short")
    return np.frombuffer(source.read(count * dtype.itemsize), dtype=dtype)
