"""Everything that can be said of a map against the truth."""

from __future__ import annotations

from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from echolume import scoring
from echolume.evaluation import consistency, form, images, labels, reliability, sensors, steps
from echolume.evaluation.images import Claimed, Reference
from echolume.evaluation.regions import regions
from echolume_messages.errors import ConfigError
from echolume_messages.plan import MapField
from echolume_messages.types import Label
from echolume_processing.export import formats
from echolume_processing.hybrid.digest import digest


class Sources(TypedDict):
    """What was compared."""

    map: str
    layer: str | None
    digest: str
    scan: str
    calibration: str
    truth: str
    truth_kind: str
    cell_mm: float


class Cells(TypedDict):
    """How many cells."""

    scored: int
    """Cells whose height the truth knows."""
    non_edge: int
    """Those none of whose neighbours is higher or lower by more than 1 mm."""
    claimed: int
    """Those to which the map gives a height."""


class ConsistencyRows(TypedDict):
    """Errors over stated sigmas."""

    all: consistency.Consistency
    non_edge: consistency.Consistency
    sensors: dict[str, consistency.Consistency] | None
    """Non-edge cells that rest, among others, on this sensor."""


class Metrology(TypedDict):
    """Figures on the flats, steps and spheres of the truth; empty where it has none."""

    steps: list[steps.Step]
    steps_by_sense: dict[str, steps.StepSummary]
    flats: list[form.Flatness]
    flatness_mm: float | None
    """Of the largest flat."""
    flatness_left_out: float
    spheres: list[form.Probing]
    probing_form_mm: float | None
    """Worst of the spheres; None where the truth has none."""
    probing_size_mm: float | None


class Evaluation(TypedDict):
    """A map's scores. A figure that nothing supports is None."""

    sources: Sources
    cells: Cells
    all: scoring.Scores
    non_edge: scoring.Scores
    labels: dict[str, labels.LabelScore] | None
    confusion: dict[str, dict[str, int]] | None
    reliability: reliability.Reliability | None
    glass: labels.Glass | None
    consistency: ConsistencyRows
    metrology: Metrology
    provenance: dict[str, float] | None


def load(map_path: Path, truth_path: Path, layer: str | None = None) -> tuple[Claimed, Reference, MapField, Sources]:
    """Read both files.

    Parameters
    ----------
    map_path
        A map in any format of ``echolume export``.
    truth_path
        ``truth.npz`` of the emulated rig, or another map on the same cells.
    layer
        A further image of a ``.npz`` whose heights are scored instead, e.g. ``optical_mm``.

    Raises
    ------
    ConfigError
        One of them cannot be used; the message says why.
    """
    stored = formats.read(map_path)
    claimed = images.claimed(stored, layer, map_path)
    truth = images.reference(truth_path, stored.found.field)
    if not np.isfinite(truth.front_mm).any():
        raise ConfigError(f"{truth_path}: knows no height on the field of {map_path}; there is nothing to score")
    sources = Sources(
        map=str(map_path),
        layer=layer,
        digest=digest(stored.found),
        scan=stored.scan,
        calibration=stored.calibration,
        truth=str(truth_path),
        truth_kind=truth.kind,
        cell_mm=stored.found.field.cell_mm,
    )
    return claimed, truth, stored.found.field, sources


def evaluate(map_: Claimed, truth: Reference, field: MapField, sources: Sources) -> Evaluation:
    """Score a map's images against the truth's on the same cells."""
    scored = np.isfinite(truth.front_mm)
    smooth = scored & scoring.away_from_edges(truth.front_mm)
    there = scoring.Truth(front_mm=truth.front_mm, glass=truth.label == Label.TRANSPARENT)
    return Evaluation(
        sources=sources,
        cells=Cells(
            scored=int(scored.sum()),
            non_edge=int(smooth.sum()),
            claimed=int((scored & np.isfinite(map_.front_mm)).sum()),
        ),
        all=scoring.score(map_.front_mm, map_.label, there, scored),
        non_edge=scoring.score(map_.front_mm, map_.label, there, smooth),
        labels=None if map_.label is None else labels.label_scores(map_.label, truth.label),
        confusion=None if map_.label is None else labels.confusion(map_.label, truth.label),
        reliability=reliability.reliability(map_, truth),
        glass=labels.glass(map_, truth, field),
        consistency=_consistency(map_, truth, scored, smooth),
        metrology=metrology(map_, truth, field),
        provenance=sensors.shares(map_),
    )


def _consistency(
    map_: Claimed, truth: Reference, scored: NDArray[np.bool_], smooth: NDArray[np.bool_]
) -> ConsistencyRows:
    return ConsistencyRows(
        all=consistency.consistency(map_, truth, scored),
        non_edge=consistency.consistency(map_, truth, smooth),
        sensors=consistency.by_sensor(map_, truth, smooth),
    )


def metrology(map_: Claimed, truth: Reference, field: MapField) -> Metrology:
    """Steps, flats and spheres of the truth, as the map has them."""
    found = regions(truth, field)
    made = steps.steps(map_, truth, found, field)
    flats = form.flatness(map_, truth, found, field)
    spheres = form.probing(map_, truth, found, field)
    return Metrology(
        steps=made,
        steps_by_sense=steps.summary(made),
        flats=flats,
        flatness_mm=flats[0]["flatness_mm"] if flats else None,
        flatness_left_out=form.LEFT_OUT,
        spheres=spheres,
        probing_form_mm=max((row["form_mm"] for row in spheres), default=None),
        probing_size_mm=max((row["size_mm"] for row in spheres), key=abs, default=None),
    )
