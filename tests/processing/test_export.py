"""A map in every format: read back identical, and opened by others' readers with every field bit for bit."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from pathlib import Path
from typing import Any

import laspy
import numpy as np
import plyfile
import pye57
import pytest
from numpy.lib.recfunctions import repack_fields
from numpy.typing import NDArray

from echolume.main import main
from echolume_messages.errors import ConfigError
from echolume_messages.types import MAP_CELL, NO_TRIGGER, Label
from echolume_processing.export import e57, formats, las, mesh, npz
from echolume_processing.hybrid import ply, stored
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm, empty_cells
from echolume_processing.hybrid.stored import StoredMap
from echolume_processing.hybrid.witnesses import PAIR, Witnesses, tabled
from processing.some_map import FIELD, NOTES, some_map

ENDINGS = [known.ending for known in formats.FORMATS]
FIELDS = MAP_CELL.names or ()
libe57: Any = pye57.libe57


def bits(values: NDArray[Any]) -> NDArray[Any]:
    """Bytes, so that nan equals nan and -0 is not 0."""
    return np.ascontiguousarray(values).view(np.uint8)


def made(path: Path, kept: StoredMap | None = None) -> Path:
    formats.format_of(path).write(kept or some_map(), path)
    return path


def points_of(kept: StoredMap) -> NDArray[Any]:
    return kept.found.cells[np.isfinite(kept.found.cells["front_mm"])]


def assert_same_fields(
    read: dict[str, NDArray[Any]] | NDArray[Any], cells: NDArray[Any], leave: tuple[str, ...] = ()
) -> None:
    for name in FIELDS:
        if name not in leave:
            assert np.asarray(read[name]).dtype == MAP_CELL[name], name
            np.testing.assert_array_equal(bits(np.asarray(read[name])), bits(cells[name]), err_msg=name)


def assert_same_tables(again: StoredMap, kept: StoredMap) -> None:
    for name in ("stripes", "pings"):
        read, wrote = getattr(again.found, name), getattr(kept.found, name)
        assert wrote.which.size > 1000
        for part in ("start", "which"):
            assert getattr(read, part).dtype == getattr(wrote, part).dtype
            np.testing.assert_array_equal(getattr(read, part), getattr(wrote, part), err_msg=f"{name}.{part}")


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_map_is_read_back_identical_with_what_is_known_about_it(ending: str, tmp_path: Path) -> None:
    kept = some_map()
    again = formats.read(made(tmp_path / f"map{ending}", kept))
    for name in FIELDS:
        np.testing.assert_array_equal(bits(again.found.cells[name]), bits(kept.found.cells[name]), err_msg=name)
    assert (again.found.field, again.found.registration) == (FIELD, kept.found.registration)
    assert (again.found.notes, again.scan, again.calibration) == (NOTES, kept.scan, kept.calibration)
    assert_same_tables(again, kept)
    assert digest(again.found) == digest(kept.found)


@pytest.mark.parametrize("ending", ENDINGS)
def test_blocks_smaller_than_the_map_write_the_same_file(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    whole = made(tmp_path / f"whole{ending}")
    for module in (stored, mesh, e57):
        monkeypatch.setattr(module, "BLOCK", 1000)
    parts = formats.read(made(tmp_path / f"parts{ending}"))
    assert digest(parts.found) == digest(formats.read(whole).found)
    if ending in (".ply", ".npz"):  # laspy leaves unused bytes of its header as they were, E57 has packets
        assert (tmp_path / f"parts{ending}").read_bytes() == whole.read_bytes()


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_map_of_which_nothing_is_known_is_still_a_file(ending: str, tmp_path: Path) -> None:
    nothing = StoredMap(replace(some_map().found, cells=empty_cells(FIELD)))
    again = formats.read(made(tmp_path / f"empty{ending}", nothing))
    assert digest(again.found) == digest(nothing.found)
    assert again.scan == ""


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_failure_leaves_what_was_there_and_nothing_else(
    ending: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / f"map{ending}"
    path.write_bytes(b"before")

    def full(descriptor: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match="No space left"):
        made(path)
    assert path.read_bytes() == b"before"
    assert [p.name for p in tmp_path.iterdir()] == [path.name]


@pytest.mark.parametrize("ending", ENDINGS)
@pytest.mark.parametrize("share", [0.0, 0.02, 0.5, 0.98])
def test_a_file_cut_short_is_refused_by_name(ending: str, share: float, tmp_path: Path) -> None:
    path = made(tmp_path / f"map{ending}")
    whole = path.read_bytes()
    path.write_bytes(whole[: int(share * len(whole))])
    with pytest.raises(ConfigError, match="map"):
        formats.read(path)


@pytest.mark.parametrize("ending", ENDINGS)
def test_another_kind_of_file_is_refused_by_name(ending: str, tmp_path: Path) -> None:
    path = tmp_path / f"other{ending}"
    path.write_bytes(b"solid cube\n" * 100)
    with pytest.raises(ConfigError, match="other"):
        formats.read(path)


def test_plyfile_opens_the_point_cloud_with_every_field(tmp_path: Path) -> None:
    kept = some_map()
    cells = points_of(kept)
    read = plyfile.PlyData.read(str(made(tmp_path / "map.ply", kept)))
    vertex = read["vertex"].data
    x_mm, y_mm = cell_centres_mm(FIELD)
    np.testing.assert_array_equal(vertex["x"], x_mm[cells["ix"]].astype(np.float32))
    np.testing.assert_array_equal(vertex["y"], y_mm[cells["iy"]].astype(np.float32))
    np.testing.assert_array_equal(bits(vertex["z"]), bits(cells["front_mm"]))
    assert_same_fields(vertex, cells, leave=("front_mm",))
    np.testing.assert_array_equal(vertex["red"], ply.LABEL_RGB[cells["label"], 0])
    assert read["unmeasured"].data["ix"].tolist() == [3, 4, 5]
    assert max(len(comment) for comment in read.comments) < 1000


def test_plyfile_opens_the_mesh_and_no_triangle_bridges_the_unknown_or_a_step(tmp_path: Path) -> None:
    kept = some_map()
    read = plyfile.PlyData.read(str(made(tmp_path / "map.mesh.ply", kept)))
    vertex, faces = read["vertex"].data, read["face"].data
    corners = np.stack(faces["vertex_indices"])
    span_mm = np.ptp(vertex["z"][corners], axis=1)
    assert span_mm.max() <= mesh.STEEPEST * FIELD.cell_mm
    assert np.isfinite(vertex["z"]).all()
    for axis in ("ix", "iy"):
        assert np.ptp(vertex[axis][corners].astype(int), axis=1).max() == 1
    a, b, c = (np.stack([vertex["x"][k], vertex["y"][k]], axis=1) for k in corners.T)
    (abx, aby), (acx, acy) = (b - a).T, (c - a).T
    assert (abx * acy - aby * acx > 0).all(), "seen from above every triangle turns to the left"
    glass = corners[faces["mesh"] == mesh.GLASS]
    assert (vertex["label"][glass] == Label.TRANSPARENT).all()
    assert (vertex["layer"][glass] == 0).all()
    solid = corners[faces["mesh"] == mesh.SOLID]
    assert ((vertex["label"][solid] == Label.TRANSPARENT) == (vertex["layer"][solid] == 1)).all()
    fronts = vertex[vertex["layer"] == 0]
    order = np.lexsort((fronts["ix"], fronts["iy"]))
    assert_same_fields(fronts[order], points_of(kept), leave=("front_mm",))
    np.testing.assert_array_equal(bits(fronts["z"][order]), bits(points_of(kept)["front_mm"]))


def test_walls_close_steps_but_never_the_unknown(tmp_path: Path) -> None:
    kept = some_map()
    open_, closed = tmp_path / "open.mesh.ply", tmp_path / "closed.mesh.ply"
    assert mesh.write(kept, closed, walls=True) > mesh.write(kept, open_)
    read = plyfile.PlyData.read(str(closed))
    corners = np.stack(read["face"].data["vertex_indices"])
    assert np.ptp(read["vertex"].data["z"][corners], axis=1).max() > 29
    assert digest(formats.read(closed).found) == digest(kept.found)


def test_a_level_field_has_two_triangles_for_four_cells_and_a_hole_takes_what_touches_it() -> None:
    height_mm = np.zeros((4, 5))
    assert len(mesh.triangles(height_mm, 1.0)) == 2 * 3 * 4
    height_mm[1, 1] = np.nan
    assert len(mesh.triangles(height_mm, 1.0)) == 2 * 3 * 4 - 4
    assert not (mesh.triangles(height_mm, 1.0) == 6).any()
    height_mm[:, 3:] = 5.0
    assert np.ptp(height_mm.ravel()[mesh.triangles(height_mm, 1.0)], axis=1).max() == 0
    assert np.ptp(height_mm.ravel()[mesh.triangles(height_mm, np.inf)], axis=1).max() == 5


def test_laspy_opens_las_with_every_field_and_metres_to_a_nanometre(tmp_path: Path) -> None:
    kept = some_map()
    cells = points_of(kept)
    read = laspy.read(made(tmp_path / "map.las", kept))
    assert_same_fields({name: np.asarray(read[name]) for name in FIELDS}, cells)
    x_mm, y_mm = cell_centres_mm(FIELD)
    assert read.header.scales.tolist() == [1e-9] * 3
    for axis, values_mm in (("x", x_mm[cells["ix"]]), ("y", y_mm[cells["iy"]]), ("z", cells["front_mm"])):
        np.testing.assert_allclose(read[axis], values_mm.astype(float) / 1e3, rtol=0, atol=0.5001e-9)
    assert read.header.mins[2] == pytest.approx(cells["front_mm"].min() / 1e3, abs=1e-9)
    assert "metre" in read.header.vlrs.get("WktCoordinateSystemVlr")[0].string
    about = next(v for v in read.evlrs if (v.user_id, v.record_id) == ("echolume", 1))
    assert json.loads(about.record_data_bytes())["digest"] == digest(kept.found)


def test_a_field_of_kilometres_is_kept_in_las_as_finely_as_its_integers_can(tmp_path: Path) -> None:
    field = replace_field(1e6)
    cells = empty_cells(field)
    cells["front_mm"] = np.float32(0.1)
    kept = StoredMap(HybridMap(field, cells, some_map().found.registration))
    assert las.scale_m(kept.found) == 1e-6
    read = laspy.read(made(tmp_path / "big.las", kept))
    np.testing.assert_allclose(np.unique(read["x"]), (cell_centres_mm(field)[0]) / 1e3, rtol=0, atol=0.6e-6)
    assert digest(formats.read(tmp_path / "big.las").found) == digest(kept.found)


def replace_field(half_mm: float) -> Any:
    return type(FIELD)(x_mm=(-half_mm, half_mm), y_mm=(-half_mm, half_mm), cell_mm=half_mm / 2)


def test_pye57_opens_e57_with_every_field_in_metres(tmp_path: Path) -> None:
    kept = some_map()
    cells = points_of(kept)
    file = pye57.E57(str(made(tmp_path / "map.e57", kept)))
    header = file.get_header(0)
    assert header.point_count == cells.size
    assert file.scan_count == 1
    read = file.read_scan_raw(0, ignore_unsupported_fields=True)
    x_mm, y_mm = cell_centres_mm(FIELD)
    np.testing.assert_array_equal(read["cartesianX"], x_mm[cells["ix"]] / 1e3)
    np.testing.assert_array_equal(read["cartesianY"], y_mm[cells["iy"]] / 1e3)
    np.testing.assert_array_equal(
        bits((read["cartesianZ"] * 1e3).astype(np.float32)), bits(cells["front_mm"]), err_msg="mm survive metres"
    )
    np.testing.assert_array_equal(read["rowIndex"], cells["iy"])
    np.testing.assert_array_equal(read["columnIndex"], cells["ix"])
    np.testing.assert_array_equal(read["colorBlue"], ply.LABEL_RGB[cells["label"], 2])
    wider = {"<u4": "q"}  # pye57 takes no uint32
    extra = {name: np.zeros(cells.size, wider.get(MAP_CELL[name].str, MAP_CELL[name])) for name in FIELDS}
    buffers = libe57.VectorSourceDestBuffer()
    for name, column in extra.items():
        buffers.append(libe57.SourceDestBuffer(file.image_file, f"echolume:{name}", column, cells.size, True, True))
    header.points.reader(buffers).read()
    assert_same_fields({name: column.astype(MAP_CELL[name]) for name, column in extra.items()}, cells)
    assert header.zMaximum == pytest.approx(cells["front_mm"].max() / 1e3, abs=1e-12)
    about = json.loads(file.root["echolume:about"].value())
    assert (about["digest"], about["notes"]) == (digest(kept.found), list(NOTES))
    file.close()


def test_numpy_opens_npz_with_every_field_an_image(tmp_path: Path) -> None:
    kept = some_map()
    with np.load(made(tmp_path / "map.npz", kept)) as read:
        for name in stored.FIELDS:
            np.testing.assert_array_equal(bits(read[name]), bits(kept.found.image(name)), err_msg=name)
        assert json.loads(str(read["about"]))["labels"]["transparent"] == Label.TRANSPARENT
    again = npz.read(tmp_path / "map.npz")
    np.testing.assert_array_equal(again.layers["optical_mm"], kept.layers["optical_mm"])


@pytest.mark.parametrize("ending", ENDINGS)
def test_a_table_without_triggers_is_not_the_same_as_none(ending: str, tmp_path: Path) -> None:
    some = some_map()
    empty = tabled(np.zeros(0, np.int64), np.zeros(0, np.uint32), some.found.cells.size)
    kept = replace(some, found=replace(some.found, stripes=empty, pings=Witnesses()))
    again = formats.read(made(tmp_path / f"map{ending}", kept)).found
    assert (again.stripes.known, again.stripes.which.size, again.pings.known) == (True, 0, False)


def of_format_1(path: Path) -> str:
    """What a file said about its map before cells had probabilities and triggers."""
    found = replace(some_map().found, stripes=Witnesses(), pings=Witnesses())
    about = json.loads(stored.About.of(some_map()).text())
    return json.dumps({**about, "format": 1, "digest": digest(found, stored.names_of(1))})


def assert_nobody_said(again: StoredMap) -> None:
    cells = again.found.cells
    known = cells["label"] != Label.UNKNOWN
    assert np.isnan(cells["probability"][known]).all()
    assert (cells["probability"][~known] == 0).all()
    for name in ("stripe_first", "stripe_last", "ping"):
        assert (cells[name] == NO_TRIGGER).all()
    assert again.found.stripes.which.size == again.found.pings.which.size == 0
    for name in stored.names_of(1):
        np.testing.assert_array_equal(bits(cells[name]), bits(some_map().found.cells[name]), err_msg=name)


def test_an_npz_of_before_there_were_probabilities_is_read_and_holds_none(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    with np.load(made(tmp_path / "map.npz")) as read:
        held = {name: read[name] for name in read.files if name not in (*stored.ADDED[2], *npz.TABLES)}
    np.savez(tmp_path / "old.npz", **{**held, "about": np.array(of_format_1(tmp_path))})
    assert_nobody_said(npz.read(tmp_path / "old.npz"))
    del held["about"]
    np.savez(tmp_path / "older.npz", **held)
    assert_nobody_said(npz.read(tmp_path / "older.npz"))
    assert "its cells are not those" not in caplog.text


def test_a_cloud_of_before_there_were_probabilities_is_read_and_holds_none(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    read = plyfile.PlyData.read(str(made(tmp_path / "map.ply")), mmap=False)
    elements = []
    for element in read.elements[:2]:
        names = [name for name in element.data.dtype.names if name not in stored.ADDED[2]]
        elements.append(plyfile.PlyElement.describe(repack_fields(element.data[names]), element.name))
    plyfile.PlyData(elements, comments=[f"about:{of_format_1(tmp_path)}"], byte_order="<").write(
        str(tmp_path / "o.ply")
    )
    assert_nobody_said(formats.read(tmp_path / "o.ply"))
    assert "its cells are not those" not in caplog.text


def test_a_file_of_a_format_to_come_is_refused(tmp_path: Path) -> None:
    with np.load(made(tmp_path / "map.npz")) as read:
        about = json.loads(str(read["about"]))
        text = np.array(json.dumps({**about, "format": stored.FORMAT + 1}))
        np.savez(tmp_path / "new.npz", **{**{k: read[k] for k in read.files}, "about": text})
    with pytest.raises(ConfigError, match=r"new\.npz: is of format 3"):
        npz.read(tmp_path / "new.npz")


@pytest.mark.parametrize(
    ("name", "table", "said"),
    [
        ("stripe_start", np.zeros(7, np.int64), "does not divide"),
        ("stripe_start", np.zeros(FIELD.shape[0] * FIELD.shape[1] + 1, np.int64), "does not divide"),
        ("ping_start", np.zeros(7, np.int32), "expected int64"),
        ("ping_ids", np.zeros(7, np.int64), "expected int64 and uint32"),
        ("ping_ids", None, "only one of"),
    ],
)
def test_an_npz_with_a_wrong_table_is_refused(name: str, table: NDArray[Any] | None, said: str, tmp_path: Path) -> None:
    with np.load(made(tmp_path / "map.npz")) as read:
        held = {k: read[k] for k in read.files if k != name}
    np.savez(tmp_path / "bad.npz", **(held if table is None else {**held, name: table}))
    with pytest.raises(ConfigError, match=said):
        npz.read(tmp_path / "bad.npz")


def test_triggers_of_cells_beyond_the_field_are_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="beyond its field"):
        stored.table_of(np.array([(60 * 80, 1)], dtype=PAIR), FIELD, tmp_path)


def test_an_npz_of_an_earlier_version_has_no_origin(tmp_path: Path) -> None:
    with np.load(made(tmp_path / "map.npz")) as read:
        np.savez(tmp_path / "old.npz", **{name: read[name] for name in read.files if name != "about"})
    again = npz.read(tmp_path / "old.npz")
    assert digest(again.found) == digest(some_map().found)
    assert (again.scan, again.calibration, again.found.notes) == ("", "", ())


@pytest.mark.parametrize("name", ["sigma_mm", "label", "cell_mm"])
def test_an_npz_without_a_field_is_refused_and_the_field_named(name: str, tmp_path: Path) -> None:
    with np.load(made(tmp_path / "map.npz")) as read:
        np.savez(tmp_path / "less.npz", **{k: read[k] for k in read.files if k != name})
    with pytest.raises(ConfigError, match=rf"less\.npz: lacks {name}"):
        npz.read(tmp_path / "less.npz")


@pytest.mark.parametrize(
    ("name", "image", "said"),
    [
        ("label", np.zeros((2, 2), np.uint8), "expected shape"),
        ("sigma_mm", np.zeros(FIELD.shape), "expected float32"),
        ("x_mm", np.array([1.0, -1.0]), "describe no field"),
        ("x_mm", np.array([1.0]), "not what a map has"),
        ("x_mm", np.array([-1.0, np.inf]), "describe no field"),
        ("cell_mm", np.array(1e-9), "too many"),
        ("x_mm", np.array([-30.0, 10.0]), "but it says"),
        ("about", np.array("{}"), "cannot be read"),
        ("about", np.array("{"), "cannot be read"),
    ],
)
def test_an_npz_with_a_wrong_array_is_refused(name: str, image: NDArray[Any], said: str, tmp_path: Path) -> None:
    with np.load(made(tmp_path / "map.npz")) as read:
        np.savez(tmp_path / "bad.npz", **{**{k: read[k] for k in read.files}, name: image})
    with pytest.raises(ConfigError, match=said):
        npz.read(tmp_path / "bad.npz")


def test_a_cloud_that_somebody_edited_is_read_and_said_to_be_edited(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = made(tmp_path / "map.ply")
    read = plyfile.PlyData.read(str(path), mmap=False)
    cropped = plyfile.PlyElement.describe(read["vertex"].data[:100].copy(), "vertex")
    plyfile.PlyData([cropped], comments=read.comments, byte_order="<").write(str(path))
    again = formats.read(path)
    assert np.isfinite(again.found.cells["front_mm"]).sum() == 100
    assert "its cells are not those that it was written with" in caplog.text


def test_what_is_known_survives_a_program_that_strips_the_comments(tmp_path: Path) -> None:
    kept = some_map()
    notes = tuple("a " * n + "b" for n in range(150, 260, 7))
    kept = replace(kept, found=replace(kept.found, notes=notes))
    path = made(tmp_path / "map.ply", kept)
    read = plyfile.PlyData.read(str(path), mmap=False)
    stripped = [comment.strip() for comment in read.comments]
    plyfile.PlyData(read.elements, comments=stripped, byte_order="<").write(str(path))
    assert formats.read(path).found.notes == notes


def test_a_cloud_of_somebody_else_is_refused(tmp_path: Path) -> None:
    points = np.zeros(5, dtype=[("x", "f4"), ("y", "f4"), ("z", "f4")])
    plyfile.PlyData([plyfile.PlyElement.describe(points, "vertex")], byte_order="<").write(str(tmp_path / "theirs.ply"))
    with pytest.raises(ConfigError, match="does not say which field"):
        formats.read(tmp_path / "theirs.ply")


def test_a_cell_beyond_the_field_or_twice_is_refused(tmp_path: Path) -> None:
    about = stored.About.of(some_map())
    record = np.zeros(2, dtype=stored.RECORD)
    with pytest.raises(ConfigError, match="twice"):
        stored.put_back(about, [record], tmp_path)
    record["iy"] = 0, 60
    with pytest.raises(ConfigError, match="beyond its field"):
        stored.put_back(about, [record], tmp_path)


def test_the_command_writes_each_file_and_says_how_much(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    path = made(tmp_path / "map.npz")
    to = [str(tmp_path / f"again{ending}") for ending in ENDINGS]
    assert main(["export", str(path), "--to", *to, "--json"]) == 0
    rows = json.loads(capsys.readouterr().out)
    assert [row["file"] for row in rows] == to
    assert rows[1]["points"] == points_of(some_map()).size
    assert all(digest(formats.read(Path(file)).found) == digest(some_map().found) for file in to)
    assert main(["export", str(path), "--to", to[0], "--walls"]) == 0
    assert "triangles" in capsys.readouterr().out


@pytest.mark.parametrize(
    ("source", "to", "said"),
    [
        ("map.npz", "map.xyz", "no format has this ending"),
        ("map.npz", "nowhere/map.las", "there is no folder"),
        ("none.npz", "map.las", "No such file"),
        ("none.las", "map.las", "No such file"),
        ("none.e57", "map.las", "No such file"),
        (".", "map.las", "is a folder"),
    ],
)
def test_the_command_refuses_before_any_work(
    source: str, to: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    made(tmp_path / "map.npz")
    assert main(["export", str(tmp_path / source), "--to", str(tmp_path / to)]) in (1, 2)
    error = capsys.readouterr().err
    assert said in error
    assert "Traceback" not in error
    assert {p.name for p in tmp_path.iterdir()} == {"map.npz"}
