"""What one cell of a map is, and what that rests on, in plain words."""

from __future__ import annotations

import re
from typing import TypedDict

import numpy as np

from echolume_messages.errors import ConfigError
from echolume_messages.types import NO_TRIGGER, Label, Provenance, Structured
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm
from echolume_processing.hybrid.stored import StoredMap
from echolume_processing.hybrid.witnesses import Witnesses

NEAR_MM = 40.0
"""A note that names a place touches cells up to so far away from it."""
PLACE = re.compile(r"around x (-?\d+), y (-?\d+) mm")
MEANING = {
    Label.UNKNOWN: "nothing is claimed here",
    Label.MATTE: "light comes back from it",
    Label.TRANSPARENT: "sound comes back from it, light goes through",
    Label.ABSORBING: "light does not come back from it, sound does",
    Label.OCCLUDED: "hidden from light; the height is that of the ground beside it",
}
HEIGHT_ALONE = "its height is known, what it is is not"
"""Of an unknown cell that has a height."""


class Explained(TypedDict):
    """Everything about one cell; None: there is none, or the map does not say."""

    ix: int
    iy: int
    x_mm: float
    y_mm: float
    """Of its centre."""
    front_mm: float | None
    behind_mm: float | None
    """What light sees behind glass."""
    sigma_mm: float | None
    label: str
    probability: float | None
    senses: list[str]
    optical_points: int
    height_pings: int
    """Pings that the height rests on."""
    stripes: list[int] | None
    """Triggers of the stripes with points in it."""
    pings: list[int] | None
    """Triggers of the pings whose echo explains it."""
    nearest_ping: int | None
    notes: list[str]
    """Of the map's notes those about this place, and those about the map as a whole."""


def explain(stored: StoredMap, x_mm: float, y_mm: float) -> Explained:
    """Gather what a map holds of the cell at a place.

    Raises
    ------
    ConfigError
        The place is outside the map.
    """
    found = stored.found
    field = found.field
    inside = field.x_mm[0] <= x_mm < field.x_mm[1] and field.y_mm[0] <= y_mm < field.y_mm[1]
    if not inside:
        raise ConfigError(
            f"x {x_mm:g}, y {y_mm:g} mm is outside the map: expected x from {field.x_mm[0]:g} to {field.x_mm[1]:g} and "
            f"y from {field.y_mm[0]:g} to {field.y_mm[1]:g} mm"
        )
    rows, columns = field.shape
    ix = min(int((x_mm - field.x_mm[0]) / field.cell_mm), columns - 1)
    iy = min(int((y_mm - field.y_mm[0]) / field.cell_mm), rows - 1)
    cell = found.cells[iy * columns + ix]
    centre_x_mm, centre_y_mm = (float(axis[k]) for axis, k in zip(cell_centres_mm(field), (ix, iy), strict=True))
    return Explained(
        ix=ix,
        iy=iy,
        x_mm=centre_x_mm,
        y_mm=centre_y_mm,
        front_mm=_number(cell, "front_mm"),
        behind_mm=_number(cell, "behind_mm"),
        sigma_mm=_number(cell, "sigma_mm"),
        label=Label(int(cell["label"])).name.lower(),
        probability=_number(cell, "probability"),
        senses=[bit.name.lower().replace("_", " ") for bit in Provenance(int(cell["provenance"])) if bit.name],
        optical_points=int(cell["optical_n"]),
        height_pings=int(cell["ultrasonic_n"]),
        stripes=_triggers(found.stripes, iy * columns + ix),
        pings=_triggers(found.pings, iy * columns + ix),
        nearest_ping=None if int(cell["ping"]) == NO_TRIGGER else int(cell["ping"]),
        notes=notes_at(found, centre_x_mm, centre_y_mm),
    )


def notes_at(found: HybridMap, x_mm: float, y_mm: float) -> list[str]:
    """The notes of a map but those about places more than `NEAR_MM` away."""

    def touches(note: str) -> bool:
        places = [(float(x), float(y)) for x, y in PLACE.findall(note)]
        return not places or any(np.hypot(x - x_mm, y - y_mm) <= NEAR_MM for x, y in places)

    return [note for note in found.notes if touches(note)]


def text(said: Explained) -> str:
    """The same for a person to read."""
    return "\n".join(f"{name:<8} {value}" for name, value in _lines(said)) + "\n"


def _lines(said: Explained) -> list[tuple[str, str]]:
    label = Label[said["label"].upper()]
    return [
        ("Cell", f"column {said['ix']}, row {said['iy']}, centre x {said['x_mm']:g}, y {said['y_mm']:g} mm"),
        ("Label", f"{said['label']}: {_meaning(said, label)}{_probable(said, label)}"),
        ("Height", _height(said)),
        ("Senses", ", ".join(said["senses"]) or "none"),
        ("Stripes", f"{_listed(said['stripes'], 'stripe')}; {said['optical_points']} points of light"),
        ("Pings", _pings(said)),
        *(("Note", note) for note in said["notes"]),
    ]


def _meaning(said: Explained, label: Label) -> str:
    return HEIGHT_ALONE if label == Label.UNKNOWN and said["front_mm"] is not None else MEANING[label]


def _probable(said: Explained, label: Label) -> str:
    if label == Label.UNKNOWN:
        return ""
    if said["probability"] is None:
        return "; the map states no probability"
    return f"; right with a probability of {100 * said['probability']:.2f} %"


def _height(said: Explained) -> str:
    if said["front_mm"] is None:
        return "none"
    sigma = "" if said["sigma_mm"] is None else f" +- {said['sigma_mm']:.3f} mm (one sigma)"
    behind = "" if said["behind_mm"] is None else f"; behind it light sees {said['behind_mm']:.3f} mm"
    return f"{said['front_mm']:.3f} mm{sigma}{behind}"


def _pings(said: Explained) -> str:
    parts = [_listed(said["pings"], "ping")]
    if said["nearest_ping"] is not None:
        parts.append(f"the nearest is {said['nearest_ping']}")
    if said["height_pings"]:
        parts.append(f"the height rests on {said['height_pings']} ping{'s' if said['height_pings'] > 1 else ''}")
    return "; ".join(parts)


def _listed(triggers: list[int] | None, what: str) -> str:
    if triggers is None:
        return f"the map does not say which {what}s"
    if not triggers:
        return f"no {what}"
    return f"trigger{'s' if len(triggers) > 1 else ''} {', '.join(map(str, triggers))}"


def _number(cell: Structured, name: str) -> float | None:
    value = float(cell[name])
    return value if np.isfinite(value) else None


def _triggers(table: Witnesses, cell: int) -> list[int] | None:
    return table.of(cell).tolist() if table.known else None
