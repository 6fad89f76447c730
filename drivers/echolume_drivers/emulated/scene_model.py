"""What a scene of the emulated rig is: heights of two layers, slopes, materials, air, room, and what must be said.

Heights lie on millimetre cells in the rig frame; a cell is a small plane, so a tilted plate is flat and not a stair.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from functools import cached_property
from typing import Annotated, Literal

import msgspec
import numpy as np
from numpy.typing import NDArray

Finite = Annotated[float, msgspec.Meta(ge=-1e4, le=1e4)]
Positive = Annotated[float, msgspec.Meta(gt=0.0, le=1e4)]
NotNegative = Annotated[float, msgspec.Meta(ge=0.0, le=1e4)]
Share = Annotated[float, msgspec.Meta(ge=0.0, le=1.0)]
LabelName = Literal["unknown", "matte", "transparent", "absorbing", "occluded"]
RoomName = Literal["dark", "bright"]

ELSEWHERE = "elsewhere"
"""The region of all cells that belong to no named one."""
SOLID = -np.inf
"""Underside of what goes down to whatever it stands on."""


class Material(IntEnum):
    """What a cell is made of."""

    MATTE = 0
    BLACK = 1
    GLASS = 2
    GLOSSY = 3
    MIRROR = 4


class Air(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """The air of a scene: its temperature and how it drifts, and smoke in it.

    Attributes
    ----------
    temperature_c
        When the scene is placed; None: as the rig has it.
    drift_k_per_min, thermometer_lag_s
        Change of temperature, and the time constant with which the array's thermometer follows.
    smoke_per_m
        Extinction of light: a way L leaves exp(-smoke_per_m L) of it. No light is lost otherwise.
    backscatter
        How much more smoke scatters towards the cameras than evenly into all directions; 1: evenly.
    sound_db_per_m
        What smoke takes from sound.
    """

    temperature_c: Annotated[float, msgspec.Meta(ge=-40.0, le=80.0)] | None = None
    drift_k_per_min: Annotated[float, msgspec.Meta(ge=-60.0, le=60.0)] = 0.0
    thermometer_lag_s: NotNegative = 120.0
    smoke_per_m: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.0
    backscatter: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 1.0
    sound_db_per_m: Annotated[float, msgspec.Meta(ge=0.0, le=100.0)] = 0.0


CLEAR_AIR = Air()


class Expectation(msgspec.Struct, forbid_unknown_fields=True, kw_only=True, frozen=True):
    """What a map must say of a region of the scene.

    Attributes
    ----------
    region
        Name of a piece, ``NAME.holes`` for the holes in it, or ``elsewhere``.
    may, at_least
        Labels that cells may carry, and the share of the cells that must carry one of them.
    must
        Share of the cells that must carry a label.
    height
        What the front of a cell that claims one must be: the ``top`` of what stands there, what lies ``behind`` it,
        ``either``, or ``any``.
    within_mm
        How close it must be, for the share `at_least` of the cells that claim a height.
    margin_mm
        Cells nearer than this to the region's edge do not count.
    """

    region: Annotated[str, msgspec.Meta(min_length=1)]
    may: Annotated[list[LabelName], msgspec.Meta(min_length=1)]
    at_least: Share = 0.95
    must: dict[LabelName, Share] = msgspec.field(default_factory=dict[LabelName, Share])
    height: Literal["top", "behind", "either", "any"] = "top"
    within_mm: Positive = 2.0
    margin_mm: NotNegative = 2.0


@dataclass(frozen=True)
class Scene:
    """Heights as sound sees them and as light sees them.

    ``front_mm[iy, ix]`` is the top of whatever stands there; ``optical_mm`` is what the laser reaches (below
    glass: what lies behind it). The centre of cell (ix, iy) is (x0_mm + (ix + 0.5) cell_mm, ...). The bench
    (z = 0) goes on beyond the field.
    """

    name: str
    x0_mm: float
    y0_mm: float
    cell_mm: float
    front_mm: NDArray[np.float64]
    optical_mm: NDArray[np.float64]
    material: NDArray[np.uint8]
    optical_material: NDArray[np.uint8] | None = None
    """Of what light meets; None: `material`, where glass lies over matte things."""
    front_slope: NDArray[np.float64] | None = None
    """dz/dx and dz/dy within each cell of the front, shape (rows, columns, 2); None: all level."""
    optical_slope: NDArray[np.float64] | None = None
    underside_mm: NDArray[np.float64] | None = None
    """Where the topmost piece ends below, at the cell's centre; `SOLID`: it stands on what is below. None: all do."""
    panes: NDArray[np.uint8] | None = None
    """Glass bodies above each other; None: one wherever the material is glass."""
    glass_mm: NDArray[np.float64] | None = None
    """Thickness, along the normal, of the glass that bends light; None: it is taken as thin."""
    region: NDArray[np.uint8] | None = None
    """Which of `regions` each cell belongs to; None: all to the first."""
    regions: tuple[str, ...] = (ELSEWHERE,)
    expect: tuple[Expectation, ...] = ()
    air: Air = CLEAR_AIR
    room: RoomName | None = None
    """The light around; None: as the rig has it."""

    @cached_property
    def light_ground(self) -> NDArray[np.float64]:
        """What light meets, shape (rows, columns, 4): height, dz/dx, dz/dy, underside."""
        bottom = np.full(self.optical_mm.shape, SOLID)
        if self.underside_mm is not None:
            opaque = self.optical_mm == self.front_mm
            bottom[opaque] = self.underside_mm[opaque]
        return np.concatenate([_planes(self.optical_mm, self.optical_slope), bottom[..., None]], axis=2)

    @cached_property
    def glass(self) -> NDArray[np.float64]:
        """The front with its glass, shape (rows, columns, 6): height, dz/dx, dz/dy, underside, panes, thickness."""
        shape = self.front_mm.shape
        bottom = np.full(shape, SOLID) if self.underside_mm is None else self.underside_mm
        panes = self.material == Material.GLASS if self.panes is None else self.panes
        thick = np.zeros(shape) if self.glass_mm is None else self.glass_mm
        return np.concatenate(
            [_planes(self.front_mm, self.front_slope), np.stack([bottom, panes.astype(np.float64), thick], axis=2)],
            axis=2,
        )

    @cached_property
    def bends_light(self) -> bool:
        """Whether any glass is thick enough to be told from a thin one."""
        return self.glass_mm is not None and bool(np.any(self.glass_mm > 0))

    @property
    def lit_material(self) -> NDArray[np.uint8]:
        """Material of what light meets, as the renderer has it: `Material.GLASS` is matte behind glass."""
        return self.material if self.optical_material is None else self.optical_material

    @property
    def region_image(self) -> NDArray[np.uint8]:
        """Index into `regions` of each cell."""
        return np.zeros(self.front_mm.shape, dtype=np.uint8) if self.region is None else self.region


def _planes(height_mm: NDArray[np.float64], slope: NDArray[np.float64] | None) -> NDArray[np.float64]:
    if slope is None:
        slope = np.zeros((*height_mm.shape, 2))
    return np.concatenate([height_mm[..., None], slope], axis=2)
