"""A map with everything in it: every label, holes, glass with and without something behind, cells that only heard."""

from __future__ import annotations

import numpy as np

from echolume_messages.plan import MapField
from echolume_messages.types import Label, Provenance, Structured
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells
from echolume_processing.hybrid.stored import StoredMap
from echolume_processing.hybrid.witnesses import Witnesses, tabled

FIELD = MapField(x_mm=(-20.0, 20.0), y_mm=(-10.5, 19.5), cell_mm=0.5)
NOTES = ("two heights, 4.3 mm apart", "line one\nline two, with ü and <&>")


def some_map(field: MapField = FIELD, seed: int = 1) -> StoredMap:
    rng = np.random.default_rng(seed)
    cells = empty_cells(field)
    image = {name: cells[name].reshape(field.shape) for name in cells.dtype.names or ()}
    image["front_mm"][:] = 12.0 + rng.normal(0, 0.013, field.shape)
    image["sigma_mm"][:] = rng.gamma(4.0, 0.01, field.shape)
    image["label"][:] = Label.MATTE
    image["provenance"][:] = rng.integers(1, 32, field.shape)
    image["optical_n"][:] = rng.integers(0, 65536, field.shape)
    image["ultrasonic_n"][:] = rng.integers(0, 65536, field.shape)
    image["front_mm"][:, -20:] += 30.0
    glass = (slice(10, 25), slice(8, 30))
    image["label"][glass], image["front_mm"][glass] = Label.TRANSPARENT, 1.0 / 3.0
    image["behind_mm"][glass] = -(10.0 ** rng.uniform(-9, 2, image["front_mm"][glass].shape))
    image["behind_mm"][12, 10:14] = np.nan
    image["label"][30:35, 30:40] = Label.ABSORBING
    image["label"][40, 5:20] = Label.OCCLUDED
    unknown = (slice(45, 52), slice(50, 64))
    for name, blank in (("front_mm", np.nan), ("sigma_mm", np.nan), ("label", 0), ("provenance", 0)):
        image[name][unknown] = blank
    image["optical_n"][unknown] = image["ultrasonic_n"][unknown] = 0
    image["front_mm"][3, 3:6] = np.nan
    image["label"][3, 3:6], image["provenance"][3, 3:6] = Label.OCCLUDED, Provenance.ULTRASONIC
    _add_accounts(cells, rng)
    stripes, pings = (_some_table(cells, name, rng) for name in ("optical_n", "ultrasonic_n"))
    registration = Registration(dz_mm=-0.1234567, speed_of_sound_mps=343.21, pings=441, residual_db=-17.3)
    layers = {"optical_mm": image["front_mm"] + np.float32(0.25)}
    return StoredMap(
        HybridMap(field, cells, registration, NOTES, stripes, pings), "demo-20261125", "c38a66f520514d49", layers
    )


def _add_accounts(cells: Structured, rng: np.random.Generator) -> None:
    known = cells["label"] != Label.UNKNOWN
    cells["probability"][known] = rng.random(int(known.sum()))
    for name in ("stripe_first", "stripe_last", "ping"):
        cells[name][known] = rng.integers(0, 1 << 32, int(known.sum()))


def _some_table(cells: Structured, name: str, rng: np.random.Generator) -> Witnesses:
    """Up to five triggers for each cell that counts any."""
    has = np.flatnonzero(cells[name])
    cell = np.repeat(has, rng.integers(1, 6, has.size))
    return tabled(cell, rng.integers(0, 1 << 32, cell.size), cells.size)
