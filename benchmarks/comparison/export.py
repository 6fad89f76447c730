"""A million cells to each format and back, beside what the formats' own libraries take for the same fields.

python -m benchmarks.comparison.export
"""

from __future__ import annotations

import tempfile
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import laspy
import numpy as np
import plyfile
import pye57

from echolume_messages.plan import MapField
from echolume_messages.types import MAP_CELL, Label, Provenance
from echolume_processing.export import formats
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.model import HybridMap, Registration, cell_centres_mm, empty_cells
from echolume_processing.hybrid.stored import StoredMap

SIDE = 1000
ROUNDS = 3
FACTS_MS = {".ply": 72.0, ".las": 219.0, ".e57": 107.0}
"""Measured elsewhere for 1e6 points and fewer fields."""
TARGETS: Mapping[str, tuple[float, float]] = {
    "export_identical": (1.0, 1.0),
    "export_ply_x_plyfile": (3.0, 2.0),
    "export_las_x_laspy": (1.5, 1.0),
    "export_e57_x_pye57": (4.0, 3.0),
}
"""What is asked at least, and the aim: times those of the library that others would use.

Ours hashes the cells (the digest), waits for the disk, and in E57 writes thirteen fields more.
"""


def some_map() -> StoredMap:
    """A map of a million cells, every one with a height."""
    field = MapField(x_mm=(-250.0, 250.0), y_mm=(-250.0, 250.0), cell_mm=500.0 / SIDE)
    cells, rng = empty_cells(field), np.random.default_rng(0)
    for name, scale in (("front_mm", 40.0), ("behind_mm", 1.0), ("sigma_mm", 0.1)):
        cells[name] = scale * rng.random(cells.size)
    cells["label"], cells["provenance"] = rng.integers(1, 4, cells.size), Provenance.STEREO
    cells["behind_mm"][cells["label"] != Label.TRANSPARENT] = np.nan
    return StoredMap(HybridMap(field, cells, Registration()), "benchmark", "none")


def peers(kept: StoredMap, folder: Path) -> dict[str, Callable[[], object]]:
    """The same points by the formats' own libraries, all in memory at once."""
    cells = kept.found.cells
    x_mm, y_mm = cell_centres_mm(kept.found.field)
    xyz_m = np.stack([x_mm[cells["ix"]], y_mm[cells["iy"]], cells["front_mm"]], axis=1) / 1e3
    extra = list(MAP_CELL.names or ())
    colours = np.zeros((cells.size, 3), np.uint8)

    def ply() -> None:
        vertex = np.zeros(cells.size, dtype=[*((axis, "f4") for axis in "xyz"), *MAP_CELL.descr])
        for k, axis in enumerate("xyz"):
            vertex[axis] = xyz_m[:, k] * 1e3
        for name in extra:
            vertex[name] = cells[name]
        plyfile.PlyData([plyfile.PlyElement.describe(vertex, "vertex")], byte_order="<").write(str(folder / "p.ply"))

    def las() -> None:
        header = laspy.LasHeader(point_format=7, version="1.4")
        header.scales = np.full(3, 1e-9)
        header.add_extra_dims([laspy.ExtraBytesParams(name=n, type=MAP_CELL[n].str[1:]) for n in extra])
        data = laspy.LasData(header)
        data.x, data.y, data.z = xyz_m.T
        for name in extra:
            data[name] = cells[name]
        data.write(str(folder / "p.las"))

    def e57() -> None:
        # no extra fields: the library's own writer takes none
        names = ("cartesianX", "cartesianY", "cartesianZ")
        points = {name: np.ascontiguousarray(column) for name, column in zip(names, xyz_m.T, strict=True)}
        points |= {f"color{name}": colours[:, k].copy() for k, name in enumerate(("Red", "Green", "Blue"))}
        points |= {"rowIndex": cells["iy"].astype("u2"), "columnIndex": cells["ix"].astype("u2")}
        with pye57.E57(str(folder / "p.e57"), mode="w") as file:
            file.write_scan_raw(points)

    return {".ply": ply, ".las": las, ".e57": e57}


def export_rows() -> dict[str, float]:
    """All figures of the export, printed beside their peers and what is asked."""
    kept = some_map()
    same = True
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        others = peers(kept, folder)
        print(f"{'':10}{'write ms':>10}{'library ms':>12}{'times':>8}{'read ms':>9}{'MB':>7}   known elsewhere, ms")
        figures: dict[str, float] = {}
        for known in formats.FORMATS:
            path = folder / f"map{known.ending}"
            library = others.get(known.ending)
            ours_ms, theirs_ms = _turns(lambda known=known, path=path: known.write(kept, path), library)
            began_s = time.perf_counter()
            again = known.read(path)
            read_ms = 1e3 * (time.perf_counter() - began_s)
            same &= digest(again.found) == digest(kept.found)
            facts = FACTS_MS.get(known.ending, float("nan"))
            size = path.stat().st_size / 1e6
            print(
                f"{known.ending:10}{ours_ms:10.0f}{theirs_ms:12.0f}{ours_ms / theirs_ms:8.2f}{read_ms:9.0f}{size:7.0f}"
                f"{facts:10.0f}"
            )
            if library is not None:
                peer = {".ply": "plyfile", ".las": "laspy", ".e57": "pye57"}[known.ending]
                figures[f"export_{known.ending[1:]}_x_{peer}"] = ours_ms / theirs_ms
    figures["export_identical"] = float(same)
    print(f"\n{'export':28}{'measured':>10}{'bar':>10}{'aim':>8}")
    for key, (bar, aim) in TARGETS.items():
        print(f"{key:28}{figures[key]:10.3f}{bar:10g}{aim:8g}")
    return figures


def _turns(ours: Callable[[], object], theirs: Callable[[], object] | None) -> tuple[float, float]:
    """Median ms of two ways that take turns; nan where there is no other way."""
    spent_s: tuple[list[float], list[float]] = ([], [])
    for _ in range(ROUNDS):
        for work, spent in zip((ours, theirs), spent_s, strict=True):
            if work is not None:
                began_s = time.perf_counter()
                work()
                spent.append(time.perf_counter() - began_s)
    return 1e3 * float(np.median(spent_s[0])), 1e3 * float(np.median(spent_s[1])) if spent_s[1] else float("nan")


if __name__ == "__main__":
    export_rows()
