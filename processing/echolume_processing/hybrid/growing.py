"""A map that grows with each stripe and ping, and in the end is the one that all of them give at once."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import Calibration
from echolume_messages.plan import MapField
from echolume_messages.types import OPTICAL_POINT, ULTRASONIC_POINT, Structured
from echolume_processing.hybrid import holes
from echolume_processing.hybrid.cells import wide_field
from echolume_processing.hybrid.fuse import Foreseen, explain
from echolume_processing.hybrid.heard import Contact, contact, together
from echolume_processing.hybrid.light_cells import LightCells
from echolume_processing.hybrid.listening import Listening, kind_of
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.predict import aperture
from echolume_processing.hybrid.rules.gates import footprint_gate
from echolume_processing.hybrid.rules.scan import Scan
from echolume_processing.hybrid.sounding import listening_to, sounding
from echolume_processing.hybrid.surface import Surface, surface
from echolume_processing.hybrid.witnesses import Triggers
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline


@dataclass(frozen=True)
class _Taken:
    """A ping, and all that can be said of it before the others are known."""

    ping: Ping
    points: Structured
    contact: Contact
    measured: NDArray[np.complex64] | None
    """None if it is of another kind than the first."""


class GrowingMap:
    """Takes stripes and pings in any order; of a trigger that comes twice the later counts.

    Parameters
    ----------
    calibration
        What the scan is made with.
    field
        Cells of the map.

    Notes
    -----
    A stripe renews the cells of the columns that it falls into. A ping gives its contact points and its spectra, and,
    once light's surface `settle`\\ d, the echoes that this surface would have returned: that is most of what `finish`
    needs of it. `live` shows what there is by the footprint gate, which compares points; `finish` explains the echoes.
    """

    def __init__(self, calibration: Calibration, field: MapField) -> None:
        self._calibration, self._field = calibration, field
        self._inner, self._wide = LightCells(field), LightCells(wide_field(field))
        self._pipeline = UltrasonicPipeline(calibration)
        self._pings: dict[int, _Taken] = {}
        self._listening: Listening | None = None
        self._scene: Surface | None = None
        self._foreseen: dict[int, NDArray[np.complex64]] = {}

    @property
    def settled(self) -> bool:
        """Whether pings are compared with a surface as they come: after `settle`, until the next stripe."""
        return self._scene is not None

    def add_stripe(self, trigger: int, points: Structured) -> None:
        """Take the ``OPTICAL_POINT`` records (n,) of a stripe."""
        for cells in (self._inner, self._wide):
            cells.put(trigger, points)
        self._scene = None
        self._foreseen.clear()

    def add_ping(self, ping: Ping) -> None:
        """Take a ping."""
        if self._listening is None:
            self._listening = Listening.to(ping, self._calibration.array, ping.air_temperature_c)
        points = self._pipeline.process(ping)
        measured = self._listening.measured(ping) if kind_of(ping) == self._listening.kind else None
        self._pings[ping.trigger] = _Taken(
            ping, points, contact(points, len(self._calibration.array.receivers_mm)), measured
        )
        self._foreseen.pop(ping.trigger, None)
        self._foresee(ping)

    def settle(self) -> None:
        """Light's pass is over: close its holes and prepare its surface, so that echoes can be predicted from it."""
        if np.isfinite(self._wide.grid.height_mm).any():
            self._scene = surface(holes.close(self._wide.grid).height_mm, self._wide.grid.field)

    def live(self) -> HybridMap:
        """The map of what came so far, by the footprint gate: quick, safe with a wide band, blind to low plates."""
        taken = self._in_order()
        points, soundings = _together(taken)
        pings = [each.ping for each in taken.values()]
        none = np.zeros(0, dtype=OPTICAL_POINT)
        scan = Scan(none, points, pings, self._calibration, self._field, None, soundings, self._inner.grid)
        return footprint_gate(scan)

    def finish(self) -> HybridMap:
        """The map of all that came, by `explain`: the same bits as `fuse` gives for the same stripes and pings."""
        grid, calibration = self._wide.grid, self._calibration
        if not self._pings:
            return explain(grid, None, None, calibration, self._field)
        taken = self._in_order()
        pings = [taken[trigger].ping for trigger in taken]
        listening = listening_to(pings, calibration.array)
        spectra = [each.measured for each in taken.values() if each.measured is not None]
        found = sounding(pings, calibration.array, listening, spectra)
        spoken = together([each.contact for each in taken.values()])
        return explain(grid, found, spoken, calibration, self._field, self._ahead())

    def _in_order(self) -> Mapping[int, _Taken]:
        return {trigger: self._pings[trigger] for trigger in sorted(self._pings)}

    def _foresee(self, ping: Ping) -> None:
        """Predict the echoes of one ping, if light's surface is known."""
        listening = self._listening
        if self._scene is None or listening is None or kind_of(ping) != listening.kind:
            return
        where = aperture(self._calibration.array, ping.robot_pose)
        self._foreseen[ping.trigger] = listening.predicted(self._scene, where)

    def _ahead(self) -> Foreseen | None:
        if self._scene is None or self._listening is None:
            return None
        return Foreseen(self._scene.height_mm, self._listening.speed_mps, self._foreseen)


def _together(taken: Mapping[int, _Taken]) -> tuple[Structured, Triggers]:
    """Contact points of pings, and the trigger of each."""
    parts = [each.points for each in taken.values()]
    triggers = np.repeat(np.array(list(taken), dtype=np.uint32), [part.size for part in parts])
    return np.concatenate(parts) if parts else np.zeros(0, dtype=ULTRASONIC_POINT), triggers
