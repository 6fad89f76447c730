"""Flatness on the truth's flats and probing error on its spheres, in the manner of VDI/VDE 2634 part 2."""

from __future__ import annotations

from typing import Literal, TypedDict

import numpy as np

from echolume.evaluation.fits import fit_plane, fit_sphere, without_worst
from echolume.evaluation.images import NOT_ASKED, Claimed, Reference
from echolume.evaluation.regions import Region, points_of
from echolume.evaluation.sensors import Sense, sense_of
from echolume_messages.plan import MapField
from echolume_messages.types import Label

LEFT_OUT = 0.003
"""Share of the points that may be left out: the guideline's three in a thousand."""
EDGE_MM = 2.0
"""Next to the outline of a piece nothing is used: cells there may hold some of both sides."""
FEWEST = 100
"""Measured cells below which no figure is given."""


class Flatness(TypedDict):
    """A flat of the truth, as measured."""

    x_mm: float
    y_mm: float
    shape: Literal["level", "tilted"]
    label: str | None
    sense: Sense
    cells: int
    measured: float
    """Share of its cells that have a height."""
    flatness_mm: float
    """Range of the signed distances from the least-squares plane, without the points left out."""
    range_mm: float
    """The same with every point."""
    rms_mm: float
    tilt_error_mrad: float
    """Angle between the measured and the true plane."""


class Probing(TypedDict):
    """A sphere of the truth, as measured."""

    x_mm: float
    y_mm: float
    radius_mm: float
    cells: int
    form_mm: float
    """Range of the radial distances from the least-squares sphere, without the points left out."""
    size_mm: float
    """Measured diameter less the true one."""
    sense: Sense


def flatness(map_: Claimed, truth: Reference, found: list[Region], field: MapField) -> list[Flatness]:
    """Flatness of every flat of the truth that is large enough, largest first."""
    rows: list[Flatness] = []
    for region in found:
        inside = region.cells & (region.inside_mm > EDGE_MM)
        used = inside & np.isfinite(map_.front_mm)
        if region.shape == "sphere" or int(used.sum()) < FEWEST:
            continue
        points_mm = points_of(used, map_.front_mm, field)
        every = fit_plane(points_mm)
        plane = fit_plane(points_mm[without_worst(every.off_mm, LEFT_OUT)])
        true = fit_plane(points_of(used, truth.front_mm, field))
        code = int(truth.label[used][0])
        rows.append(
            Flatness(
                x_mm=float(points_mm[:, 0].mean()),
                y_mm=float(points_mm[:, 1].mean()),
                shape=region.shape,
                label=None if code == NOT_ASKED else Label(code).name.lower(),
                sense=sense_of(map_, used),
                cells=int(used.sum()),
                measured=int(used.sum()) / int(inside.sum()),
                flatness_mm=float(np.ptp(plane.off_mm)),
                range_mm=float(np.ptp(every.off_mm)),
                rms_mm=float(np.sqrt(np.mean(every.off_mm**2))),
                tilt_error_mrad=1e3 * float(np.hypot(plane.slope_x - true.slope_x, plane.slope_y - true.slope_y)),
            )
        )
    return rows


def probing(map_: Claimed, truth: Reference, found: list[Region], field: MapField) -> list[Probing]:
    """Probing error on every sphere of the truth that is large enough."""
    rows: list[Probing] = []
    for region in found:
        used = region.cells & (region.inside_mm > EDGE_MM) & np.isfinite(map_.front_mm)
        if region.shape != "sphere" or int(used.sum()) < FEWEST:
            continue
        points_mm = points_of(used, map_.front_mm, field)
        true, every = fit_sphere(points_of(used, truth.front_mm, field)), fit_sphere(points_mm)
        if true is None or every is None:
            continue
        sphere = fit_sphere(points_mm[without_worst(every.off_mm, LEFT_OUT)]) or every
        rows.append(
            Probing(
                x_mm=float(true.centre_mm[0]),
                y_mm=float(true.centre_mm[1]),
                radius_mm=true.radius_mm,
                cells=int(used.sum()),
                form_mm=float(np.ptp(sphere.off_mm)),
                size_mm=2 * (sphere.radius_mm - true.radius_mm),
                sense=sense_of(map_, used),
            )
        )
    return rows
