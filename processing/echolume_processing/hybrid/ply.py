"""The hybrid map as a PLY point cloud that keeps every field of a cell."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from echolume_messages.types import Label
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm

VERTEX = np.dtype(
    [
        ("x", "<f4"),
        ("y", "<f4"),
        ("z", "<f4"),
        ("red", "u1"),
        ("green", "u1"),
        ("blue", "u1"),
        ("behind_mm", "<f4"),
        ("sigma_mm", "<f4"),
        ("label", "u1"),
        ("provenance", "u1"),
        ("optical_n", "<u2"),
        ("ultrasonic_n", "<u2"),
    ]
)
_PLY_TYPE = {"<f4": "float", "|u1": "uchar", "<u2": "ushort"}

LABEL_RGB = np.zeros((len(Label), 3), dtype=np.uint8)
"""One colour a label, shared by every picture."""
LABEL_RGB[Label.UNKNOWN] = (128, 128, 128)
LABEL_RGB[Label.MATTE] = (222, 197, 156)
LABEL_RGB[Label.TRANSPARENT] = (64, 160, 224)
LABEL_RGB[Label.ABSORBING] = (40, 40, 52)
LABEL_RGB[Label.OCCLUDED] = (224, 120, 64)


def write(found: HybridMap, path: Path) -> int:
    """Write the cells with a height as binary PLY; returns how many there are."""
    cells = found.cells[np.isfinite(found.cells["front_mm"])]
    x_mm, y_mm = cell_centres_mm(found.field)
    vertex = np.zeros(cells.size, dtype=VERTEX)
    vertex["x"], vertex["y"], vertex["z"] = x_mm[cells["ix"]], y_mm[cells["iy"]], cells["front_mm"]
    for k, name in enumerate(("red", "green", "blue")):
        vertex[name] = LABEL_RGB[cells["label"], k]
    for name in ("behind_mm", "sigma_mm", "label", "provenance", "optical_n", "ultrasonic_n"):
        vertex[name] = cells[name]
    names = ", ".join(f"{label.value} {label.name.lower()}" for label in Label)
    header = [
        "ply",
        "format binary_little_endian 1.0",
        f"comment echolume hybrid map, millimetres, digest {digest(found)}",
        f"comment label: {names}",
        "comment provenance bits: 1 stereo, 2 active left, 4 active right, 8 ultrasonic, 16 filled",
        *(f"comment note: {note}" for note in found.notes),
        f"element vertex {cells.size}",
        *(f"property {_PLY_TYPE[VERTEX[name].str]} {name}" for name in VERTEX.names or ()),
        "end_header\n",
    ]
    path.write_bytes("\n".join(header).encode("ascii", "replace") + vertex.tobytes())
    return int(cells.size)
