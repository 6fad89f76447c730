"""Digest and PLY of a hybrid map."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import plyfile

from echolume_messages.plan import MapField
from echolume_messages.types import Label, Provenance
from echolume_processing.hybrid import ply
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells

FIELD = MapField(x_mm=(-2.0, 2.0), y_mm=(-1.0, 2.0), cell_mm=1.0)


def some_map() -> HybridMap:
    cells = empty_cells(FIELD)
    cells["front_mm"][:10] = np.arange(10)
    cells["label"][:10] = Label.MATTE
    cells["provenance"][:10] = Provenance.STEREO
    cells["label"][3], cells["behind_mm"][3], cells["provenance"][3] = Label.TRANSPARENT, -1.5, Provenance.ULTRASONIC
    cells["sigma_mm"][:10], cells["optical_n"][:10], cells["ultrasonic_n"][3] = 0.25, 700, 12
    cells["probability"][:10], cells["stripe_first"][:10], cells["stripe_last"][:10], cells["ping"][3] = 0.9, 7, 8, 512
    return HybridMap(FIELD, cells, Registration(), ("two heights",))


def test_the_digest_does_not_depend_on_the_order_of_the_cells_nor_on_the_notes() -> None:
    found = some_map()
    turned = replace(found, cells=found.cells[::-1], notes=(), registration=Registration(dz_mm=1.0))
    assert digest(found) == digest(turned)
    assert len(digest(found)) == 16


def test_the_digest_does_not_tell_zeros_or_nans_apart() -> None:
    found, other = some_map(), some_map()
    other.cells["front_mm"][0] = -0.0
    other.cells["behind_mm"][0] = -np.float32(np.nan)
    assert digest(found) == digest(other)


def test_every_field_of_every_cell_counts_in_the_digest() -> None:
    before = digest(some_map())
    for name in some_map().cells.dtype.names or ():
        other = some_map()
        other.cells[name][3] += 1
        assert digest(other) != before, name


def test_ply_keeps_every_field_for_somebody_elses_reader(tmp_path: Path) -> None:
    found = some_map()
    assert ply.write(found, tmp_path / "map.ply") == 10
    read = plyfile.PlyData.read(str(tmp_path / "map.ply"))
    vertex = read["vertex"].data
    assert vertex.size == 10
    assert vertex["x"][:5].tolist() == [-1.5, -0.5, 0.5, 1.5, -1.5]
    assert vertex["y"][:5].tolist() == [-0.5, -0.5, -0.5, -0.5, 0.5]
    assert vertex["z"].tolist() == list(range(10))
    for name in ("behind_mm", "sigma_mm", "label", "provenance", "optical_n", "ultrasonic_n"):
        np.testing.assert_array_equal(vertex[name], found.cells[name][:10])
    assert any("two heights" in comment for comment in read.comments)
    assert any(digest(found) in comment for comment in read.comments)
