"""Shapes on the cells of a scene: heights and slopes of boxes, plates, stairs, wedges, cylinders and spheres."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.scene_model import ELSEWHERE, SOLID, Material, Scene

Image: TypeAlias = NDArray[np.float64]
Mask: TypeAlias = NDArray[np.bool_]
Heights: TypeAlias = Callable[[Image, Image], Image]
"""Height over x and y, both images in mm."""


@dataclass(frozen=True)
class Body:
    """One piece on the bench: where it stands, how high, and of what.

    Attributes
    ----------
    where
        Cells that it covers.
    top
        Its height over x and y.
    material
        What it is made of.
    thickness_mm
        Along its normal; 0: it goes down to what it stands on.
    level
        Cells are taken as level, whatever `top` does within them.
    """

    where: Mask
    top: Heights
    material: Material = Material.MATTE
    thickness_mm: float = 0.0
    level: bool = False


@dataclass
class SceneBuilder:
    """Puts bodies on a bench, one after the other; each replaces what it covers, and glass lets light through to it."""

    name: str
    half_mm: float = 120.0
    cell_mm: float = 1.0
    regions: list[str] = field(default_factory=lambda: [ELSEWHERE])

    def __post_init__(self) -> None:
        n = round(2 * self.half_mm / self.cell_mm)
        self._front, self._optical = np.zeros((n, n)), np.zeros((n, n))
        self._front_slope, self._optical_slope = np.zeros((n, n, 2)), np.zeros((n, n, 2))
        self._underside = np.full((n, n), SOLID)
        self._glass = np.zeros((n, n))
        self._material, self._lit, self._panes, self._region = (np.zeros((n, n), dtype=np.uint8) for _ in range(4))
        at_mm = np.asarray(-self.half_mm + (np.arange(n) + 0.5) * self.cell_mm, dtype=np.float64)
        self.x_mm: Image = np.tile(at_mm, (n, 1))
        """Centres of the cells, as `y_mm`."""
        self.y_mm: Image = np.ascontiguousarray(self.x_mm.T)

    def rectangle(self, x_mm: tuple[float, float], y_mm: tuple[float, float]) -> Mask:
        """Cells of a rectangle; its sides go to the nearest cells' edges."""
        n = len(self._front)
        (i0, i1), (j0, j1) = (
            (min(max(round((v + self.half_mm) / self.cell_mm), 0), n) for v in ends) for ends in (x_mm, y_mm)
        )
        where = np.zeros(self._front.shape, dtype=np.bool_)
        where[j0:j1, i0:i1] = True
        return where

    def disc(self, x_mm: float, y_mm: float, radius_mm: float) -> Mask:
        """Cells whose centres lie in a circle."""
        return np.hypot(self.x_mm - x_mm, self.y_mm - y_mm) < radius_mm

    def box(
        self,
        x_mm: tuple[float, float],
        y_mm: tuple[float, float],
        z_mm: float,
        material: Material = Material.MATTE,
    ) -> SceneBuilder:
        """Put a box with its top at z_mm; through glass the laser goes on to what was there before."""
        return self.put(Body(self.rectangle(x_mm, y_mm), level_at(z_mm), material))

    def sunk_mm(self, body: Body) -> float:
        """How far the body's top lies below what stands there already, at the worst place; 0: nowhere."""
        top = body.top(self.x_mm[body.where], self.y_mm[body.where])
        return max(0.0, float(np.max(self._front[body.where] - top, initial=0.0)))

    def put(self, body: Body) -> SceneBuilder:
        """Put a body where it belongs."""
        where, half_mm = body.where, 0.5 * self.cell_mm
        x, y = self.x_mm[where], self.y_mm[where]
        top = body.top(x, y)
        slope = np.zeros((len(top), 2))
        if not body.level:
            slope[:, 0] = (body.top(x + half_mm, y) - body.top(x - half_mm, y)) / self.cell_mm
            slope[:, 1] = (body.top(x, y + half_mm) - body.top(x, y - half_mm)) / self.cell_mm
        upright_mm = body.thickness_mm * np.sqrt(1 + np.sum(slope**2, axis=1))
        underside = top - upright_mm if body.thickness_mm > 0 else np.full(len(top), SOLID)
        if body.material is Material.GLASS:
            over = (self._panes[where] > 0) & (self._front[where] <= underside)
            self._panes[where] = np.where(over, self._panes[where] + 1, 1)
            self._glass[where] = np.where(over, self._glass[where], 0.0) + body.thickness_mm
            self._lit[where & (self._lit == Material.MATTE)] = Material.GLASS
        else:
            self._optical[where], self._optical_slope[where] = top, slope
            self._panes[where], self._glass[where] = 0, 0.0
            self._lit[where] = body.material
        self._front[where], self._front_slope[where] = top, slope
        self._underside[where], self._material[where] = underside, body.material
        return self

    def call(self, where: Mask, region: str) -> SceneBuilder:
        """Give cells a region's name."""
        if region not in self.regions:
            self.regions.append(region)
        self._region[where] = self.regions.index(region)
        return self

    def build(self) -> Scene:
        """The finished scene."""
        return Scene(
            self.name,
            -self.half_mm,
            -self.half_mm,
            self.cell_mm,
            self._front,
            self._optical,
            self._material,
            optical_material=self._lit if np.any(self._lit != self._material) else None,
            front_slope=self._front_slope if np.any(self._front_slope) else None,
            optical_slope=self._optical_slope if np.any(self._optical_slope) else None,
            underside_mm=self._underside if np.any(np.isfinite(self._underside)) else None,
            panes=self._panes if np.any(self._panes > 1) else None,
            glass_mm=self._glass if np.any(self._glass) else None,
            region=self._region if np.any(self._region) else None,
            regions=tuple(self.regions),
        )


def level_at(z_mm: float) -> Heights:
    """A level top."""
    return lambda x, y: np.full(x.shape, z_mm)


def plane_through(x_mm: float, y_mm: float, z_mm: float, tilt_rad: tuple[float, float]) -> Heights:
    """A plane through a point that rises by the two angles towards +x and towards +y."""
    rise_x, rise_y = np.tan(tilt_rad[0]), np.tan(tilt_rad[1])
    return lambda x, y: z_mm + rise_x * (x - x_mm) + rise_y * (y - y_mm)


def stair_along(ends_mm: tuple[float, float], steps_mm: list[float], along: str) -> Heights:
    """Steps of equal depth from the first to the second end."""
    heights = np.array(steps_mm)
    depth_mm = (ends_mm[1] - ends_mm[0]) / len(steps_mm)

    def top(x: Image, y: Image) -> Image:
        at = np.floor(((x if along == "x" else y) - ends_mm[0]) / depth_mm + 1e-9).astype(np.int64)
        return heights[np.clip(at, 0, len(heights) - 1)]

    return top


def wedge_along(ends_mm: tuple[float, float], z_mm: tuple[float, float], along: str) -> Heights:
    """A ramp from the first height at the first end to the second at the second."""
    rise = (z_mm[1] - z_mm[0]) / (ends_mm[1] - ends_mm[0])
    return lambda x, y: z_mm[0] + rise * ((x if along == "x" else y) - ends_mm[0])


def cylinder_along(middle_mm: float, z_mm: float, radius_mm: float, along: str) -> Heights:
    """The upper side of a cylinder whose axis lies along x or y at height z_mm."""

    def top(x: Image, y: Image) -> Image:
        off = (y if along == "x" else x) - middle_mm
        return z_mm + np.sqrt(np.maximum(radius_mm**2 - off**2, 0.0))

    return top


def sphere_about(x_mm: float, y_mm: float, z_mm: float, radius_mm: float) -> Heights:
    """The upper half of a sphere."""
    return lambda x, y: z_mm + np.sqrt(np.maximum(radius_mm**2 - (x - x_mm) ** 2 - (y - y_mm) ** 2, 0.0))


def sampled(height_mm: Image, corner_mm: tuple[float, float], cell_mm: float) -> Heights:
    """A raster of heights, bilinear between the centres of its cells."""

    def top(x: Image, y: Image) -> Image:
        rows, columns = height_mm.shape
        u = np.clip((x - corner_mm[0]) / cell_mm - 0.5, 0, columns - 1)
        v = np.clip((y - corner_mm[1]) / cell_mm - 0.5, 0, rows - 1)
        i, j = np.minimum(u.astype(np.int64), max(columns - 2, 0)), np.minimum(v.astype(np.int64), max(rows - 2, 0))
        i1, j1 = np.minimum(i + 1, columns - 1), np.minimum(j + 1, rows - 1)
        a, b = u - i, v - j
        low = height_mm[j, i] * (1 - a) + height_mm[j, i1] * a
        return low * (1 - b) + (height_mm[j1, i] * (1 - a) + height_mm[j1, i1] * a) * b

    return top
