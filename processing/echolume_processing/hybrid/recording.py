"""The scan as a rerun recording, for review; the only module that touches rerun."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from echolume_messages.types import Label, OpticalSource
from echolume_processing.evidence import Evidence
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm
from echolume_processing.hybrid.ply import LABEL_RGB

APPLICATION = "echolume"
LABELS = tuple(Label)
_SETS = {
    OpticalSource.STEREO: ("rig/map/st", (235, 200, 120)),
    OpticalSource.ACTIVE_LEFT: ("rig/map/at_left", (120, 200, 140)),
    OpticalSource.ACTIVE_RIGHT: ("rig/map/at_right", (200, 140, 190)),
}


def write(evidence: Evidence, found: HybridMap, path: Path) -> None:
    """Write one recording: points as they were acquired, the array's path, the hybrid map and its notes.

    Notes
    -----
    The timeline ``scan_step`` is the trigger's number; the map is static. The sink is a file only: a live viewer in
    the same process could block it.
    """
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{evidence.scan or 'scan'}-{digest(found)}")
    recording.set_sinks(rr.FileSink(path), default_blueprint=_blueprint())
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    _log_stripes(recording, evidence)
    _log_pings(recording, evidence)
    _log_map(recording, found)
    _log_notes(recording, evidence, found)
    recording.flush(timeout_sec=30.0)
    recording.disconnect()


def _log_stripes(recording: rr.RecordingStream, evidence: Evidence) -> None:
    """The three optical point sets, one step a stripe."""
    for trigger in sorted(evidence.optical):
        points = evidence.optical[trigger][1]
        recording.set_time("scan_step", sequence=trigger)
        for source, (entity, colour) in _SETS.items():
            own = points[points["source"] == source]
            xyz = np.column_stack((own["x_mm"], own["y_mm"], own["z_mm"]))
            recording.log(entity, rr.Points3D(xyz, colors=[colour], radii=[0.25]))


def _log_pings(recording: rr.RecordingStream, evidence: Evidence) -> None:
    """Contact points with their normals, and the raw echoes' level, one step a ping."""
    for trigger in sorted(evidence.ultrasonic):
        points = evidence.ultrasonic[trigger][1]
        xyz = np.column_stack((points["x_mm"], points["y_mm"], points["z_mm"]))
        normal = np.column_stack((points["nx"], points["ny"], points["nz"]))
        recording.set_time("scan_step", sequence=trigger)
        recording.log("rig/map/us", rr.Points3D(xyz, colors=[(90, 160, 235)], radii=[0.8]))
        recording.log("rig/map/us_normals", rr.Arrows3D(vectors=8.0 * normal, origins=xyz, colors=[(90, 160, 235)]))
    for trigger in sorted(evidence.pings):
        ping = evidence.pings[trigger][1]
        recording.set_time("scan_step", sequence=trigger)
        recording.log("us/echoes", rr.Tensor(ping.echoes, dim_names=("receiver", "sample")))
        recording.log("us/level", rr.Scalars(ping.echoes.astype(np.float64).std(axis=1)))


def _log_map(recording: rr.RecordingStream, found: HybridMap) -> None:
    """The hybrid map as a coloured cloud, a height image and a label image."""
    cells = found.cells[np.isfinite(found.cells["front_mm"])]
    x_mm, y_mm = cell_centres_mm(found.field)
    xyz = np.column_stack((x_mm[cells["ix"]], y_mm[cells["iy"]], cells["front_mm"]))
    context = [(int(k), k.name.lower(), tuple(int(v) for v in LABEL_RGB[k])) for k in LABELS]
    recording.log("/", rr.AnnotationContext(context), static=True)
    recording.log(
        "rig/map/hybrid",
        rr.Points3D(xyz, class_ids=cells["label"], radii=[0.5 * found.field.cell_mm]),
        rr.AnyValues(
            sigma_mm=cells["sigma_mm"],
            provenance=cells["provenance"],
            optical_n=cells["optical_n"],
            ultrasonic_n=cells["ultrasonic_n"],
        ),
        static=True,
    )
    behind = cells[np.isfinite(cells["behind_mm"])]
    below = np.column_stack((x_mm[behind["ix"]], y_mm[behind["iy"]], behind["behind_mm"]))
    recording.log("rig/map/behind", rr.Points3D(below, colors=[(160, 200, 235)], radii=[0.3]), static=True)
    recording.log("map/height", rr.DepthImage(_upright(found.image("front_mm")), meter=1000.0), static=True)
    recording.log("map/labels", rr.SegmentationImage(_upright(found.image("label"))), static=True)


def _upright(image: NDArray[Any]) -> NDArray[Any]:
    """Row 0 at the top is the largest y; unknown heights become 0, which rerun leaves out."""
    flipped = image[::-1]
    return np.ascontiguousarray(np.nan_to_num(flipped, nan=0.0) if flipped.dtype.kind == "f" else flipped)


def _log_notes(recording: rr.RecordingStream, evidence: Evidence, found: HybridMap) -> None:
    """What a reviewer must know, as a text beside the map."""
    registration = found.registration
    lines = [
        f"# Scan {evidence.scan}",
        f"- plan: {evidence.plan.name}",
        f"- calibration: {evidence.calibration.digest}",
        f"- hybrid map: digest {digest(found)}, {found.cells.size} cells of {found.field.cell_mm} mm",
        f"- self-registration: {registration.dz_mm:+.3f} mm over {registration.pings} pings, "
        f"residual {registration.residual_db:.1f} dB, speed of sound {registration.speed_of_sound_mps:.2f} m/s",
        *(f"- {note}" for note in found.notes),
    ]
    recording.log("notes", rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN), static=True)


def _blueprint() -> rrb.Blueprint:
    """The map in three dimensions, its labels and notes beside it, the echoes below."""
    return rrb.Blueprint(
        rrb.Horizontal(
            rrb.Vertical(
                rrb.Spatial3DView(origin="/", contents=["rig/map/**"], name="map"),
                rrb.TimeSeriesView(origin="/us/level", name="echo level"),
                row_shares=[3, 1],
            ),
            rrb.Vertical(
                rrb.Spatial2DView(origin="/map/labels", name="labels"),
                rrb.TextDocumentView(origin="/notes", name="notes"),
            ),
            column_shares=[2, 1],
        ),
        collapse_panels=True,
    )
