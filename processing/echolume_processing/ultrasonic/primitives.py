"""Path lengths over the primitives that surfaces are made of: plane, point, edge, corner, cylinder and sphere.

Emitter and receiver may be anywhere in front; every array of points is (n, 3), one row per path.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import Points3

Vector = NDArray[np.float64]
NEWTON_STEPS = 5


class SurfaceKind(IntEnum):
    """What reflects."""

    NONE = 0
    PLANE = 1
    POINT = 2
    EDGE = 3
    """A straight convex edge, or a thin wire: the sound takes the shortest way over it."""
    CORNER = 4
    """Two planes at a right angle, seen from inside: the sound meets both."""
    CYLINDER = 5
    SPHERE = 6


STRAIGHT = (SurfaceKind.EDGE, SurfaceKind.CORNER, SurfaceKind.CYLINDER)
ROUND = (SurfaceKind.CYLINDER, SurfaceKind.SPHERE)
WIDER = {
    SurfaceKind.PLANE: (SurfaceKind.CYLINDER, SurfaceKind.SPHERE),
    SurfaceKind.POINT: (SurfaceKind.SPHERE,),
    SurfaceKind.EDGE: (SurfaceKind.CYLINDER,),
}
"""Kinds of which a kind is the limit; that they fit as well is no contradiction."""
PARAMETERS = {
    SurfaceKind.PLANE: 3,
    SurfaceKind.POINT: 3,
    SurfaceKind.EDGE: 4,
    SurfaceKind.CORNER: 4,
    SurfaceKind.CYLINDER: 5,
    SurfaceKind.SPHERE: 4,
}
POSITIONS = {
    SurfaceKind.PLANE: 1,
    SurfaceKind.POINT: 3,
    SurfaceKind.EDGE: 2,
    SurfaceKind.CORNER: 2,
    SurfaceKind.CYLINDER: 2,
    SurfaceKind.SPHERE: 3,
}
"""How many of the parameters move its position."""


@dataclass(frozen=True)
class Primitive:
    """One primitive in space."""

    kind: SurfaceKind
    position_mm: Vector
    """A point of the plane or line, or the centre, (3,)."""
    direction: Vector
    """Normal of a plane towards the array, direction of a line, zeros for a point or sphere, (3,)."""
    radius_mm: float = 0.0
    """Below 0: of a hollow, its centre in front."""

    def paths_mm(self, emitter_mm: Points3, receiver_mm: Points3) -> NDArray[np.float64]:
        """Emitter, surface, receiver, (n,)."""
        a, b = emitter_mm - self.position_mm, receiver_mm - self.position_mm
        if self.kind == SurfaceKind.PLANE:
            return np.linalg.norm(a - 2 * (a @ self.direction)[:, None] * self.direction - b, axis=1)
        apart = np.zeros(len(a))
        if self.kind in STRAIGHT:
            apart = (a - b) @ self.direction
            a, b = (v - (v @ self.direction)[:, None] * self.direction for v in (a, b))
        if self.kind == SurfaceKind.CORNER:
            return np.hypot(np.linalg.norm(a + b, axis=1), apart)
        return np.hypot(over_circle(a, b, self.radius_mm), apart)

    def moved(self, axes: Vector, scale_mm: float, by: Vector) -> Primitive:
        """The primitive, changed by its free parameters in mm: see `chart`."""
        count = POSITIONS[self.kind]
        position = self.position_mm + by[:count] @ axes[:count]
        direction = self.direction
        if direction.any():
            across = axes[1:] if self.kind == SurfaceKind.PLANE else axes[:2]
            tilted = direction + by[count : count + 2] @ across / scale_mm
            direction = tilted / np.linalg.norm(tilted)
        radius = self.radius_mm + (float(by[-1]) if self.kind in ROUND else 0.0)
        return replace(self, position_mm=position, direction=direction, radius_mm=radius)

    def chart(self) -> Vector:
        """Axes (3, 3) of the free parameters. Plane: along the normal, then tilts towards the two axes across. Line:
        along both axes across, then tilts towards them. Point: along x, y, z. A radius comes last."""
        if not self.direction.any():
            return np.eye(3)
        across = np.linalg.svd(self.direction[None])[2][1:]
        if self.kind == SurfaceKind.PLANE:
            return np.vstack([self.direction, across])
        return np.vstack([across, self.direction])


def over_circle(a_mm: Points3, b_mm: Points3, radius_mm: float) -> NDArray[np.float64]:
    """Shortest way from a to b over a circle, or sphere, about the origin that both see from outside, (n,).

    Notes
    -----
    Alhazen's problem by Newton's method on the angle; of a radius of 0 it is the sum of both distances.
    """
    far_a, far_b = np.linalg.norm(a_mm, axis=1), np.linalg.norm(b_mm, axis=1)
    if radius_mm == 0:
        return far_a + far_b
    between = np.arctan2(np.linalg.norm(np.cross(a_mm, b_mm), axis=1), np.sum(a_mm * b_mm, axis=1))
    clear_a, clear_b = np.maximum(far_a - radius_mm, 1e-3), np.maximum(far_b - radius_mm, 1e-3)
    angle = between * clear_a / (clear_a + clear_b)
    way_a = way_b = np.zeros(len(a_mm))
    for _ in range(NEWTON_STEPS):
        other = between - angle
        way_a = np.sqrt(far_a**2 + radius_mm**2 - 2 * far_a * radius_mm * np.cos(angle))
        way_b = np.sqrt(far_b**2 + radius_mm**2 - 2 * far_b * radius_mm * np.cos(other))
        sine_a, sine_b = far_a * np.sin(angle) / way_a, far_b * np.sin(other) / way_b
        slope = far_a * np.cos(angle) / way_a - radius_mm * sine_a**2 / way_a
        slope += far_b * np.cos(other) / way_b - radius_mm * sine_b**2 / way_b
        angle = angle - (sine_a - sine_b) / np.maximum(slope, 1e-9)
    return way_a + way_b
