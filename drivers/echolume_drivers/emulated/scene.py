"""The emulated scene: a heightfield of millimetre cells with a material each, in the rig frame."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray


class Material(IntEnum):
    """What a cell is made of."""

    MATTE = 0
    BLACK = 1
    GLASS = 2
    GLOSSY = 3


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


class SceneBuilder:
    """Puts boxes on a bench."""

    def __init__(self, name: str, half_mm: float = 120.0, cell_mm: float = 1.0) -> None:
        n = round(2 * half_mm / cell_mm)
        self._name = name
        self._origin_mm = -half_mm
        self._cell_mm = cell_mm
        self._front = np.zeros((n, n))
        self._optical = np.zeros((n, n))
        self._material = np.zeros((n, n), dtype=np.uint8)

    def box(
        self,
        x_mm: tuple[float, float],
        y_mm: tuple[float, float],
        z_mm: float,
        material: Material = Material.MATTE,
    ) -> SceneBuilder:
        """Put a box with its top at z_mm; through glass the laser goes on to what was there before."""
        i0, i1 = (round((x - self._origin_mm) / self._cell_mm) for x in x_mm)
        j0, j1 = (round((y - self._origin_mm) / self._cell_mm) for y in y_mm)
        cells = (slice(j0, j1), slice(i0, i1))
        self._front[cells] = z_mm
        if material is not Material.GLASS:
            self._optical[cells] = z_mm
        self._material[cells] = material
        return self

    def build(self) -> Scene:
        """The finished scene."""
        return Scene(
            self._name,
            self._origin_mm,
            self._origin_mm,
            self._cell_mm,
            self._front,
            self._optical,
            self._material,
        )


def demo() -> Scene:
    """A stair of 10/20/30/40 mm, bars 20 and 12 mm wide, a glass plate 30 mm above the base, a black block."""
    scene = SceneBuilder("demo")
    for k in range(4):
        scene.box((-90 + 20 * k, -70 + 20 * k), (30, 85), 10.0 * (k + 1))
    scene.box((25, 45), (30, 85), 20.0)
    scene.box((65, 77), (30, 85), 20.0)
    scene.box((-85, -15), (-75, -15), 30.0, Material.GLASS)
    scene.box((20, 70), (-75, -25), 20.0, Material.BLACK)
    return scene.build()


def plate(z_mm: float = 0.0) -> Scene:
    """A matte reference plate over the whole field."""
    return SceneBuilder("plate").box((-120, 120), (-120, 120), z_mm).build()


def block() -> Scene:
    """The calibration block that both senses see: 60 x 44 mm, 25 mm high, off the middle."""
    return SceneBuilder("block").box((-22, 38), (-16, 28), 25.0).build()


def matte() -> Scene:
    """The demo's shapes, all matte: nothing may be called transparent."""
    found = demo()
    return Scene(
        "matte", found.x0_mm, found.y0_mm, found.cell_mm, found.front_mm, found.front_mm,
        np.zeros_like(found.material),
    )  # fmt: skip


SCENES = {"demo": demo, "plate": plate, "block": block, "matte": matte}
