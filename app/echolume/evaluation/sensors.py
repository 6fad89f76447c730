"""Which sense cells rest on."""

from __future__ import annotations

from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echolume.evaluation.images import Claimed
from echolume_messages.types import Provenance

Sense = Literal["light", "sound", "both", "filled", "mixed", "unstated"]
LIGHT = int(Provenance.STEREO | Provenance.ACTIVE_LEFT | Provenance.ACTIVE_RIGHT)
PURE = 0.95
"""Share of cells that must rest on the same sense for a figure to be this sense's; else it is ``mixed``."""
BITS = {bit.name.lower(): bit.value for bit in Provenance if bit.name and bit.value}


def sense_of(map_: Claimed, cells: NDArray[np.bool_]) -> Sense:
    """The sense that cells (rows, columns) rest on."""
    if map_.provenance is None:
        return "unstated"
    bits = map_.provenance[cells]
    light, sound = (bits & LIGHT) != 0, (bits & Provenance.ULTRASONIC) != 0
    filled = (bits & Provenance.FILLED) != 0
    alone: tuple[tuple[Sense, NDArray[np.bool_]], ...] = (
        ("light", light & ~sound & ~filled),
        ("sound", sound & ~light & ~filled),
        ("both", light & sound & ~filled),
        ("filled", filled & ~light & ~sound),
    )
    for sense, which in alone:
        if bits.size and which.mean() >= PURE:
            return sense
    return "mixed"


def shares(map_: Claimed) -> dict[str, float] | None:
    """Of the cells with a height, the share that rests on each sensor; ``none`` should be 0."""
    there = np.isfinite(map_.front_mm)
    if map_.provenance is None or not there.any():
        return None
    bits = map_.provenance[there]
    found = {name: float(((bits & value) != 0).mean()) for name, value in BITS.items()}
    return {**found, "none": float((bits == 0).mean())}
