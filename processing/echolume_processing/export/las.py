"""The hybrid map as LAS 1.4: a point a cell, every field of the cell as extra bytes."""

from __future__ import annotations

import io
import math
from importlib.metadata import version
from pathlib import Path

import laspy
import numpy as np
from laspy.vlrs.known import WktCoordinateSystemVlr
from laspy.vlrs.vlrlist import VLRList

from echolume_messages.errors import ConfigError
from echolume_messages.files import replacing
from echolume_messages.types import Structured
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm
from echolume_processing.hybrid.ply import LABEL_RGB
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

USER = "echolume"
ABOUT_ID, UNMEASURED_ID = 1, 2
TABLE_IDS = {"stripes": 3, "pings": 4}
POINT_FORMAT = 7
"""Colour, and no place for a waveform."""
FINEST_M = 1e-9
LARGEST = 2**31 - 1
RIG_FRAME = 'LOCAL_CS["echolume rig frame",LOCAL_DATUM["rig",0],UNIT["metre",1]]'
MEANING = {
    "front_mm": "height of what is in front, mm",
    "behind_mm": "height behind glass, mm; nan: none",
    "sigma_mm": "standard deviation, mm",
    "label": "what the cell is, see VLR",
    "provenance": "bits of the senses, see VLR",
    "optical_n": "optical points in the cell",
    "ultrasonic_n": "pings that the height rests on",
    "probability": "that the label is right",
    "stripe_first": "lowest trigger of its stripes",
    "stripe_last": "highest trigger of its stripes",
    "ping": "trigger of the nearest ping",
}


def write(stored: StoredMap, path: Path) -> int:
    """Write the cells with a height; returns how many there are.

    Notes
    -----
    Coordinates are metres, as LAS has it, in integers of ``scale_m``: 1 nm for heights and fields up to 2 m. The
    heights are in ``front_mm`` once more, bit for bit. Extended VLRs of user ``echolume`` are: 1, JSON about the map;
    2 to 4 (NPY), the records of cells without a height, and the triggers of the stripes and pings that cells rest on.
    """
    found = stored.found
    points = with_height(found)
    header = _header(found)
    with replacing(path) as fresh, laspy.open(str(fresh), "w", header=header, do_compress=False) as sink:
        for cells in blocks(found, points):
            sink.write_points(_points(found, cells, header))
        sink.write_evlrs(
            VLRList(
                [
                    laspy.VLR(USER, ABOUT_ID, "JSON about the map", About.of(stored).text().encode("ascii")),
                    laspy.VLR(USER, UNMEASURED_ID, "NPY: cells without a height", _npy(unmeasured(found))),
                    *(
                        laspy.VLR(USER, TABLE_IDS[name], f"NPY: triggers of {name} by cell", _npy(lines))
                        for name, lines in lines_of(found).items()
                    ),
                ]
            )
        )
    return int(points.sum())


def _npy(records: Structured) -> bytes:
    into = io.BytesIO()
    np.save(into, records, allow_pickle=False)
    return into.getvalue()


def scale_m(found: HybridMap) -> float:
    """Size of the integers' unit: the finest power of ten, at least 1 nm, that holds every coordinate."""
    front_mm = found.cells["front_mm"][with_height(found)]
    field = found.field
    largest_mm = max(abs(v) for v in (*field.x_mm, *field.y_mm, float(np.abs(front_mm).max(initial=0.0))))
    return max(FINEST_M, 10.0 ** math.ceil(math.log10(max(largest_mm, 1e-3) / 1e3 / LARGEST)))


def _header(found: HybridMap) -> laspy.LasHeader:
    header = laspy.LasHeader(point_format=POINT_FORMAT, version="1.4")
    header.scales = np.full(3, scale_m(found))
    header.offsets = np.zeros(3)
    header.system_identifier = "echolume hybrid map"
    header.generating_software = f"echolume {version('echolume')}"[:32]
    header.global_encoding.wkt = True
    header.vlrs.append(WktCoordinateSystemVlr(RIG_FRAME))
    header.add_extra_dims(
        [
            laspy.ExtraBytesParams(name=name, type=RECORD[name].str[1:], description=MEANING.get(name, "")[:32])
            for name in RECORD.names or ()
        ]
    )
    return header


def _points(found: HybridMap, cells: Structured, header: laspy.LasHeader) -> laspy.ScaleAwarePointRecord:
    x_mm, y_mm = cell_centres_mm(found.field)
    points = laspy.ScaleAwarePointRecord.zeros(cells.size, header=header)
    for axis, values_mm in (("x", x_mm[cells["ix"]]), ("y", y_mm[cells["iy"]]), ("z", cells["front_mm"])):
        points[axis] = values_mm.astype(np.float64) / 1e3
    for k, name in enumerate(("red", "green", "blue")):
        points[name] = LABEL_RGB[cells["label"], k].astype(np.uint16) * 257
    for name in RECORD.names or ():
        points[name] = cells[name]
    return points


def read(path: Path) -> StoredMap:
    """Read a map from a LAS file that this module wrote.

    Raises
    ------
    ConfigError
        It is no LAS, cut short, or none that a map can be read from.
    """
    try:
        with laspy.open(str(path)) as source:
            known = {vlr.record_id: vlr.record_data_bytes() for vlr in source.evlrs or () if vlr.user_id == USER}
            if ABOUT_ID not in known:
                raise ConfigError(f"{path}: does not say which field its points lie on; expected LAS by `echolume`")
            points = source.read_points(-1)
            if len(points) != source.header.point_count:
                raise ConfigError(f"{path}: is cut short: {len(points)} of {source.header.point_count} points")
            about = About.parse(known[ABOUT_ID].decode("ascii", "replace"), path)
            require_names(set(source.header.point_format.dimension_names), about, path)
            cells = np.zeros(len(points), dtype=RECORD)
            for name in about.names:
                cells[name] = points[name]
            silent = np.load(io.BytesIO(known[UNMEASURED_ID]), allow_pickle=False)
            stripes, pings = (_table(known, name, about, path) for name in TABLE_IDS)
    except (laspy.errors.LaspyException, ValueError, KeyError, EOFError) as error:
        raise ConfigError(f"{path}: cannot be read as a map's LAS (cut short or damaged?): {error}") from error
    return about.stored(put_back(about, [cells, silent], path), path, stripes=stripes, pings=pings)


def _table(known: dict[int, bytes], name: str, about: About, path: Path) -> Witnesses:
    if TABLE_IDS[name] not in known:
        return Witnesses()
    lines = np.load(io.BytesIO(known[TABLE_IDS[name]]), allow_pickle=False)
    if lines.dtype != PAIR:
        raise ConfigError(f"{path}: {name}: expected lines of cell and trigger, got {lines.dtype}")
    return table_of(lines, about.field, path)
