"""What every rule is given, and the two images that most of them compare."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

from echolume_messages.calibration import Calibration
from echolume_messages.plan import MapField
from echolume_messages.types import Structured
from echolume_processing.hybrid.grid import OpticalGrid, accumulate
from echolume_processing.hybrid.rules.band import narrow
from echolume_processing.hybrid.rules.onsets import by_onset
from echolume_processing.hybrid.rules.sound import SoundImage, sound_image
from echolume_processing.hybrid.witnesses import Triggers
from echolume_processing.ping import Ping


@dataclass(frozen=True)
class Scan:
    """The evidence of a scan, in any order."""

    optical: Structured
    """``OPTICAL_POINT`` (n,)."""
    ultrasonic: Structured
    """``ULTRASONIC_POINT`` (m,)."""
    pings: Sequence[Ping]
    calibration: Calibration
    field: MapField
    stripes: Triggers | None = None
    """Trigger of the stripe of each optical point (n,), if known."""
    soundings: Triggers | None = None
    """Trigger of the ping of each contact point (m,), if known."""
    grid: OpticalGrid | None = None
    """Light's cells, where they are made already."""

    @cached_property
    def light(self) -> OpticalGrid:
        """Light's cells."""
        return self.grid or accumulate(self.optical, self.field, self.stripes)

    @cached_property
    def sound(self) -> SoundImage:
        """The nearest contact point of each cell that stands over what it hears."""
        return sound_image(self.ultrasonic, self.calibration.array, self.field, self.soundings)

    @cached_property
    def settled(self) -> SoundImage:
        """The same with whole waves chosen by the echoes' beginnings: of a narrow band, if there are pings."""
        if not (narrow(self.calibration.array) and self.pings):
            return self.sound
        points, triggers = by_onset(self.pings, self.calibration)
        return sound_image(points, self.calibration.array, self.field, triggers)
