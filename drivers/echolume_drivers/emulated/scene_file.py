"""Scene files (TOML): pieces on the bench in their order, air, room, and what a map must say; see docs/scenes.md."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Literal, TypeAlias

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated import shapes
from echolume_drivers.emulated.scene_model import (
    CLEAR_AIR,
    Air,
    Expectation,
    Finite,
    Material,
    NotNegative,
    Positive,
    RoomName,
    Scene,
)
from echolume_drivers.emulated.shapes import Body, SceneBuilder
from echolume_messages.errors import ConfigError
from echolume_messages.files import read_text

Span: TypeAlias = tuple[Finite, Finite]
Axis = Literal["x", "y"]
MaterialName = Literal["matte", "black", "glass", "glossy", "mirror"]
Tilt = Annotated[float, msgspec.Meta(ge=-60.0, le=60.0)]
PIECES_LIMIT, HOLES_LIMIT = 200, 200
HALF_LIMIT_MM = 300.0
SINKS_MM = 1e-6
PACKAGE = "echolume_drivers.emulated"
"""Holds the shipped scenes in its folder ``scenes``."""


class Hole(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """A round hole through a piece, at x, y."""

    x_mm: Finite
    y_mm: Finite
    diameter_mm: Positive


class Perforation(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """Round holes on a square grid about the middle of a piece."""

    pitch_mm: Positive
    diameter_mm: Positive


class _Piece(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, tag_field="kind"):
    name: str = ""
    """Region of its cells; pieces may share one. Without: ``elsewhere``."""
    material: MaterialName = "matte"


class Box(_Piece, tag="box", kw_only=True):
    """An upright block from what it stands on to a level top."""

    x_mm: Span
    y_mm: Span
    z_mm: Finite


class Plate(_Piece, tag="plate", kw_only=True):
    """A plate of its own thickness that hangs in the air: level or tilted, with holes or without."""

    x_mm: Span
    y_mm: Span
    z_mm: Finite
    """Height of its upper side in the middle."""
    thickness_mm: Positive
    tilt_deg: tuple[Tilt, Tilt] = (0.0, 0.0)
    """How steeply it rises towards +x and towards +y."""
    holes: Annotated[list[Hole], msgspec.Meta(max_length=HOLES_LIMIT)] = msgspec.field(default_factory=list[Hole])
    perforation: Perforation | None = None


class Stair(_Piece, tag="stair", kw_only=True):
    """Level steps of equal depth, from the low to the high end of an axis."""

    x_mm: Span
    y_mm: Span
    steps_mm: Annotated[list[Finite], msgspec.Meta(min_length=1, max_length=100)]
    along: Axis = "x"


class Wedge(_Piece, tag="wedge", kw_only=True):
    """A ramp from the first height at the low end of an axis to the second at the high end."""

    x_mm: Span
    y_mm: Span
    z_mm: Span
    along: Axis = "x"


class Cylinder(_Piece, tag="cylinder", kw_only=True):
    """A lying cylinder; below its axis it goes straight down. With a thickness it is a shell, as of a bottle."""

    x_mm: Finite
    y_mm: Finite
    z_mm: Finite = 0.0
    """Its middle."""
    radius_mm: Positive
    length_mm: Positive
    along: Axis = "x"
    thickness_mm: NotNegative = 0.0


class Sphere(_Piece, tag="sphere", kw_only=True):
    """A ball about its middle; below the equator it goes straight down."""

    x_mm: Finite
    y_mm: Finite
    z_mm: Finite
    radius_mm: Positive


class HeightField(_Piece, tag="heights", kw_only=True):
    """A raster of heights: ``height_mm`` (rows along y, columns along x) of an .npz, or a grey PNG."""

    file: Annotated[str, msgspec.Meta(min_length=1)]
    """Relative to the scene file."""
    corner_mm: Span
    """Where the first row and column begin."""
    cell_mm: Positive = 1.0
    scale_mm: Positive = 1.0
    """Height of one grey level."""
    stepped: bool = False
    """Take the scene's cells as level: for rasters with steps."""


Piece = Box | Plate | Stair | Wedge | Cylinder | Sphere | HeightField


class SceneFile(msgspec.Struct, forbid_unknown_fields=True, kw_only=True):
    """A scene as it is written."""

    name: Annotated[str, msgspec.Meta(pattern=r"^[^/\x00-\x1f]+$", max_length=100)]
    about: str = ""
    """What stands there, in a sentence."""
    light_sees: str = ""
    sound_hears: str = ""
    map_must_say: str = ""
    half_mm: Annotated[float, msgspec.Meta(ge=10.0, le=HALF_LIMIT_MM)] = 120.0
    """The field reaches so far to each side of the rig's middle."""
    room: RoomName | None = None
    air: Air = CLEAR_AIR
    pieces: Annotated[list[Piece], msgspec.Meta(max_length=PIECES_LIMIT)] = msgspec.field(
        name="piece", default_factory=list[Piece]
    )
    expect: list[Expectation] = msgspec.field(default_factory=list[Expectation])


def parse(text: str, where: str = "scene") -> SceneFile:
    """Read a scene from TOML text; errors carry the path, e.g. ``x.toml: ... - at `$.piece[0].z_mm```."""
    try:
        return msgspec.toml.decode(text, type=SceneFile)
    except msgspec.DecodeError as error:
        raise ConfigError(f"{where}: {error}") from error


def build(described: SceneFile, where: str = "scene", folder: Path = Path()) -> Scene:
    """Put a described scene's pieces on the bench.

    Parameters
    ----------
    described
        What the file says.
    where
        Begins each error.
    folder
        What the files of height fields are relative to.

    Raises
    ------
    ConfigError
        A piece covers no cell, lies below what stands there already, or a region is unknown.
    """
    builder = SceneBuilder(described.name, described.half_mm)
    for number, piece in enumerate(described.pieces):
        at = f"at `$.piece[{number}]`"
        body, holes = _body(builder, piece, f"{where}: {{}} - {at}", folder)
        if not body.where.any():
            raise ConfigError(f"{where}: it covers no cell of the field of {described.half_mm:g} mm each way - {at}")
        sunk_mm = builder.sunk_mm(body)
        if sunk_mm > SINKS_MM:
            raise ConfigError(f"{where}: its top lies up to {sunk_mm:.3g} mm below what stands there already - {at}")
        builder.put(body)
        if piece.name:
            builder.call(body.where, piece.name)
            if holes.any():
                builder.call(holes, f"{piece.name}.holes")
    for number, expected in enumerate(described.expect):
        if expected.region not in builder.regions:
            known = ", ".join(builder.regions)
            raise ConfigError(
                f"{where}: no region {expected.region!r}; known: {known} - at `$.expect[{number}].region`"
            )
    return replace(builder.build(), expect=tuple(described.expect), air=described.air, room=described.room)


def load(path: Path) -> Scene:
    """Read a scene file and build it."""
    return build(parse(read_text(path, "the scene"), str(path)), str(path), path.parent)


def shipped_names() -> tuple[str, ...]:
    """Names of the scenes that ship with the program."""
    found = files(PACKAGE).joinpath("scenes").iterdir()
    return tuple(sorted(entry.name.removesuffix(".toml") for entry in found if entry.name.endswith(".toml")))


def shipped(name: str) -> SceneFile:
    """A scene that ships with the program, as it is written."""
    path = files(PACKAGE).joinpath("scenes", f"{name}.toml")
    return parse(path.read_text(encoding="utf-8"), f"{name}.toml")


def _body(builder: SceneBuilder, piece: Piece, complaint: str, folder: Path) -> tuple[Body, shapes.Mask]:
    """A piece as a body, and the cells of its holes; errors are put into `complaint`."""
    material = Material[piece.material.upper()]
    none = np.zeros(builder.x_mm.shape, dtype=np.bool_)
    if isinstance(piece, Cylinder):
        return _cylinder(builder, piece, material), none
    if isinstance(piece, Sphere):
        top = shapes.sphere_about(piece.x_mm, piece.y_mm, piece.z_mm, piece.radius_mm)
        return Body(builder.disc(piece.x_mm, piece.y_mm, piece.radius_mm), top, material), none
    if isinstance(piece, HeightField):
        return _heights(builder, piece, material, complaint, folder), none
    for axis, (low, high) in (("x_mm", piece.x_mm), ("y_mm", piece.y_mm)):
        if not low < high:
            raise ConfigError(complaint.format(f"{axis} runs from {low:g} to {high:g}"))
    where = builder.rectangle(piece.x_mm, piece.y_mm)
    if isinstance(piece, Box):
        return Body(where, shapes.level_at(piece.z_mm), material, level=True), none
    ends = (piece.x_mm, piece.y_mm)
    if isinstance(piece, Stair):
        top = shapes.stair_along(ends["xy".index(piece.along)], piece.steps_mm, piece.along)
        return Body(where, top, material, level=True), none
    if isinstance(piece, Wedge):
        top = shapes.wedge_along(ends["xy".index(piece.along)], piece.z_mm, piece.along)
        return Body(where, top, material), none
    holes = _holes(builder, piece) & where
    top = shapes.plane_through(
        sum(piece.x_mm) / 2, sum(piece.y_mm) / 2, piece.z_mm,
        (math.radians(piece.tilt_deg[0]), math.radians(piece.tilt_deg[1])),
    )  # fmt: skip
    return Body(where & ~holes, top, material, piece.thickness_mm, level=piece.tilt_deg == (0.0, 0.0)), holes


def _holes(builder: SceneBuilder, plate: Plate) -> shapes.Mask:
    out = np.zeros(builder.x_mm.shape, dtype=np.bool_)
    for hole in plate.holes:
        out |= builder.disc(hole.x_mm, hole.y_mm, hole.diameter_mm / 2)
    if plate.perforation is not None:
        pitch_mm = plate.perforation.pitch_mm
        off_x = (builder.x_mm - sum(plate.x_mm) / 2 + pitch_mm / 2) % pitch_mm - pitch_mm / 2
        off_y = (builder.y_mm - sum(plate.y_mm) / 2 + pitch_mm / 2) % pitch_mm - pitch_mm / 2
        out |= np.hypot(off_x, off_y) < plate.perforation.diameter_mm / 2
    return out


def _cylinder(builder: SceneBuilder, piece: Cylinder, material: Material) -> Body:
    half_mm = piece.length_mm / 2
    if piece.along == "x":
        where = builder.rectangle((piece.x_mm - half_mm, piece.x_mm + half_mm), (-1e4, 1e4))
        where &= np.abs(builder.y_mm - piece.y_mm) < piece.radius_mm
        top = shapes.cylinder_along(piece.y_mm, piece.z_mm, piece.radius_mm, "x")
    else:
        where = builder.rectangle((-1e4, 1e4), (piece.y_mm - half_mm, piece.y_mm + half_mm))
        where &= np.abs(builder.x_mm - piece.x_mm) < piece.radius_mm
        top = shapes.cylinder_along(piece.x_mm, piece.z_mm, piece.radius_mm, "y")
    return Body(where, top, material, piece.thickness_mm)


def _heights(builder: SceneBuilder, piece: HeightField, material: Material, complaint: str, folder: Path) -> Body:
    path = folder / piece.file
    height_mm = _raster(path, complaint) * piece.scale_mm
    x0, y0 = piece.corner_mm
    rows, columns = height_mm.shape
    where = builder.rectangle((x0, x0 + columns * piece.cell_mm), (y0, y0 + rows * piece.cell_mm))
    return Body(where, shapes.sampled(height_mm, piece.corner_mm, piece.cell_mm), material, level=piece.stepped)


def _raster(path: Path, complaint: str) -> NDArray[np.float64]:
    """Heights (rows, columns) of an .npz or a PNG; a PNG's upper row is the one with the highest y."""
    if path.suffix == ".npz":
        try:
            with np.load(path) as held:
                found = _named(held, "height_mm")
        except (OSError, ValueError) as error:
            raise ConfigError(complaint.format(f"{path}: cannot read heights: {error}")) from error
    else:
        import cv2

        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED) if path.is_file() else None
        found = None if image is None else np.asarray(image, dtype=np.float64)[::-1]
    if found is None or found.ndim != 2 or found.size == 0 or not np.isfinite(found).all():
        raise ConfigError(
            complaint.format(f"{path}: expected finite heights, `height_mm` (rows, columns) of an .npz or a grey PNG")
        )
    return np.ascontiguousarray(found, dtype=np.float64)


def _named(held: Mapping[str, NDArray[np.float64]], name: str) -> NDArray[np.float64] | None:
    return np.asarray(held[name], dtype=np.float64) if name in held else None
