"""What is compared: the images of a map, and those of the truth on the same cells."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from echolume.scoring import GLASS, window
from echolume_messages.errors import ConfigError
from echolume_messages.plan import MapField
from echolume_messages.types import Label
from echolume_processing.export import formats, npz
from echolume_processing.hybrid.stored import StoredMap

NOT_ASKED = -1
"""Truth's label of a cell that any label may have, e.g. of a glossy surface."""
MATERIAL_LABEL = {0: Label.MATTE, 1: Label.ABSORBING, 2: Label.TRANSPARENT}
"""Label that each material of ``truth.npz`` calls for: matte, black, glass."""
TRUTH_FIELDS = ("front_mm", "optical_mm", "material", "x0_mm", "y0_mm", "cell_mm")


@dataclass(frozen=True)
class Claimed:
    """A map's images, all (rows, columns); None: the map says nothing of the kind."""

    front_mm: NDArray[np.float64]
    behind_mm: NDArray[np.float64] | None = None
    sigma_mm: NDArray[np.float64] | None = None
    label: NDArray[np.int64] | None = None
    provenance: NDArray[np.int64] | None = None
    probability: NDArray[np.float64] | None = None
    """That the label is right; nan where the map does not say."""


@dataclass(frozen=True)
class Reference:
    """The truth on the same cells."""

    front_mm: NDArray[np.float64]
    """Height of what is in front; nan: not known."""
    behind_mm: NDArray[np.float64]
    """Height of what light sees behind glass; nan: nothing, or not known."""
    label: NDArray[np.int64]
    """``Label``, or ``NOT_ASKED``."""
    sigma_mm: NDArray[np.float64]
    """Of its own heights; 0: exact."""
    kind: str


def claimed(stored: StoredMap, layer: str | None, path: Path) -> Claimed:
    """The images of a map, or one layer of its file as heights that come without labels and sigmas.

    Raises
    ------
    ConfigError
        There is no such layer, or no cell has a height.
    """
    if layer is not None:
        if layer not in stored.layers:
            known = ", ".join(stored.layers) or "none"
            raise ConfigError(f"{path}: has no layer {layer!r}; it has: {known}")
        found = Claimed(stored.layers[layer].astype(np.float64))
    else:
        image = stored.found.image
        found = Claimed(
            image("front_mm").astype(np.float64),
            image("behind_mm").astype(np.float64),
            image("sigma_mm").astype(np.float64),
            image("label").astype(np.int64),
            image("provenance").astype(np.int64),
            image("probability").astype(np.float64),
        )
    if not np.isfinite(found.front_mm).any():
        raise ConfigError(f"{path}: no cell of the map has a height; there is nothing to score")
    return found


def reference(path: Path, field: MapField) -> Reference:
    """The truth on a map's cells: ``truth.npz`` of the emulated rig, or another map in any format of `export`.

    Raises
    ------
    ConfigError
        It is neither, lies on another raster, or does not cover the map.

    Notes
    -----
    In ``truth.npz`` the materials say what each cell should be called, unless there is an image ``label`` that does:
    ``Label``, or -1 where any will do. It may ask for *unknown*, as on glass tilted beyond the echo's return.
    """
    if path.is_dir():
        raise ConfigError(f"{path}: is a folder; give the truth in it, e.g. {path / 'truth.npz'}")
    if formats.format_of(path).ending == ".npz":
        images = npz.arrays(path)
        if "material" in images or "x0_mm" in images:
            return _of_truth(images, field, path)
    return _of_map(formats.read(path), field, path)


def _of_truth(images: dict[str, NDArray[Any]], field: MapField, path: Path) -> Reference:
    missing = [name for name in TRUTH_FIELDS if name not in images]
    if missing:
        raise ConfigError(f"{path}: lacks {', '.join(missing)}; expected the truth.npz of the emulated rig")
    shape = images["front_mm"].shape
    for name in ("optical_mm", "material", *(["label"] if "label" in images else [])):
        if len(shape) != 2 or images[name].shape != shape:
            raise ConfigError(f"{path}: {name}: expected an image like front_mm {shape}, got {images[name].shape}")
    x0_mm, y0_mm, cell_mm = (_number(images[name], name, path) for name in TRUTH_FIELDS[3:])
    at = _window(shape, x0_mm, y0_mm, cell_mm, field, path)
    material = images["material"][at].astype(np.int64)
    label = _labels(images["label"][at], path) if "label" in images else _labels_of(material)
    front_mm = images["front_mm"][at].astype(np.float64)
    behind_mm = np.where(material == GLASS, images["optical_mm"][at].astype(np.float64), np.nan)
    return Reference(front_mm, behind_mm, label, np.zeros_like(front_mm), "truth of the emulated rig")


def _labels_of(material: NDArray[np.int64]) -> NDArray[np.int64]:
    label = np.full(material.shape, NOT_ASKED)
    for code, wanted in MATERIAL_LABEL.items():
        label[material == code] = wanted
    return label


def _labels(label: NDArray[Any], path: Path) -> NDArray[np.int64]:
    if label.dtype.kind not in "iu" or not np.isin(label, (NOT_ASKED, *Label)).all():
        raise ConfigError(f"{path}: label: expected {NOT_ASKED} (any) to {max(Label)}, got others")
    return label.astype(np.int64)


def _number(value: NDArray[Any], name: str, path: Path) -> float:
    if value.size != 1 or value.dtype.kind not in "fiu" or not np.isfinite(value):
        raise ConfigError(f"{path}: {name}: expected a number, got {value.dtype} of shape {value.shape}")
    return float(value)


def _of_map(stored: StoredMap, field: MapField, path: Path) -> Reference:
    own = stored.found.field
    at = _window(own.shape, own.x_mm[0], own.y_mm[0], own.cell_mm, field, path)
    image = stored.found.image
    label = image("label")[at].astype(np.int64)
    return Reference(
        image("front_mm")[at].astype(np.float64),
        image("behind_mm")[at].astype(np.float64),
        np.where(label == Label.UNKNOWN, NOT_ASKED, label),
        np.nan_to_num(image("sigma_mm")[at].astype(np.float64), nan=0.0),
        "another map",
    )


def _window(
    shape: tuple[int, ...], x0_mm: float, y0_mm: float, cell_mm: float, field: MapField, path: Path
) -> tuple[slice, slice]:
    try:
        return window(shape, x0_mm, y0_mm, cell_mm, field)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}; expected a truth on the map's own cells, over all of its field") from error
