"""What is believed of a scene so far, the echoes that it predicts, and which pings look where."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_processing.hybrid.grid import cell_index
from echolume_processing.hybrid.model import cell_centres_mm
from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.scipy_typed import Mask, NearestPoints, depth_inside
from echolume_processing.hybrid.sounding import Sounding, Spectra
from echolume_processing.hybrid.surface import Surface, reshaped, without_echo

NOTICED_MM = 50.0
"""Pings of which foot and mirror point are further than this from a change hardly notice it."""


@dataclass(frozen=True)
class State:
    """The surface as it is believed so far, and the echoes that it predicts for all pings."""

    found: Sounding
    scene: Surface
    predicted: Spectra

    def residual(self) -> NDArray[np.float64]:
        """Residual energy of each ping over its measured energy."""
        return self.found.residual(self.predicted, np.arange(len(self.found.apertures)))

    def scene_with(self, mask: Mask, plane: Plane, near: Surface | None = None, *, hangs: bool = False) -> Surface:
        """The surface with a plane within a mask, on sides or hanging; `near` is one that is almost the same."""
        height_mm = np.where(mask, plane.image(self.scene.field), self.scene.height_mm)
        return reshaped(near or self.scene, height_mm, mask if hangs else None)

    def with_patch(self, mask: Mask, plane: Plane, *, hangs: bool = False) -> State:
        """The state with a plane within a mask; only the pings that can notice are predicted anew."""
        scene = self.scene_with(mask, plane, hangs=hangs)
        return self._predicted_anew(scene, pings_near(self.found, mask, scene.field, NOTICED_MM, plane))

    def with_heights(self, height_mm: NDArray[np.float64], changed: Mask) -> State:
        """The state with other heights in some cells."""
        scene = reshaped(self.scene, height_mm)
        return self._predicted_anew(scene, pings_near(self.found, changed, scene.field, NOTICED_MM))

    def without(self, mask: Mask) -> State:
        """The state with cells that sound does not reach."""
        scene = without_echo(self.scene, mask)
        return self._predicted_anew(scene, pings_near(self.found, mask, scene.field, NOTICED_MM))

    def _predicted_anew(self, scene: Surface, which: NDArray[np.int64]) -> State:
        predicted = self.predicted.copy()
        if which.size:
            predicted[which] = self.found.predict(scene, which)
        return State(self.found, scene, predicted)


def pings_near(
    found: Sounding, mask: Mask, field: MapField, distance_mm: float, plane: Plane | None = None
) -> NDArray[np.int64]:
    """Pings whose foot, or mirror point on a plane, is within a distance of a mask, sorted."""
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(field))
    known = NearestPoints(np.column_stack((x_mm[mask], y_mm[mask])))
    away, _ = known.nearest(found.foot_mm)
    if plane is not None:
        away = np.minimum(away, known.nearest(plane.mirror_points(centres_mm(found)))[0])
    return np.nonzero(away <= distance_mm)[0]


def centres_mm(found: Sounding) -> NDArray[np.float64]:
    """Where the emitter of each ping stood, (pings, 3)."""
    return np.array([a.elements_mm[0] for a in found.apertures])


def pings_inside(
    found: Sounding, mask: Mask, field: MapField, depth_mm: float, plane: Plane | None = None
) -> NDArray[np.int64]:
    """Pings whose foot, or else mirror point on a plane, is at least so deep inside a mask, sorted."""
    depth = depth_inside(mask) * field.cell_mm
    foot = found.foot_mm if plane is None else plane.mirror_points(centres_mm(found))
    cell = cell_index(field, foot[:, 0], foot[:, 1])
    return np.nonzero((cell >= 0) & (depth.ravel()[cell] > depth_mm))[0]


def cells_near(place_mm: NDArray[np.float64], field: MapField, distance_mm: float) -> Mask:
    """Cells near to some places (n, 2)."""
    x_mm, y_mm = np.meshgrid(*cell_centres_mm(field))
    away, _ = NearestPoints(place_mm).nearest(np.column_stack((x_mm.ravel(), y_mm.ravel())))
    return (away <= distance_mm).reshape(field.shape)


def residual_of(found: Sounding, predicted: Spectra, which: NDArray[np.int64]) -> float:
    """Residual energy of some pings over their measured energy, as one number."""
    energy = found.energy[which]
    return float((found.residual(predicted, which) * energy).sum() / energy.sum())
