"""The scan as a rerun recording, for review; `recording_measured` and `recording_layout` are its other two parts."""

from __future__ import annotations

from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from echolume_messages.types import Label
from echolume_processing.evidence import Evidence
from echolume_processing.hybrid import recording_layout, recording_measured
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.model import HybridMap, cell_centres_mm
from echolume_processing.hybrid.ply import LABEL_RGB

APPLICATION = "echolume"
WHITE = 255
"""Gray of a label that is certainly right; black: unknown, or nobody said."""
LABELS = tuple(Label)

_GUIDE = """
## What is where

| entity | what |
|---|---|
| `rig/map/hybrid` | the map, coloured by label; each cell carries its sigma, provenance, counts, label's probability, \
first and last stripe and nearest ping (triggers, `scan_step`; 4294967295: none) |
| `map/probability` | how probable each label is; black: 0, white: 1 |
| `rig/map/st`, `at_left`, `at_right` | points of each stripe: stereo yellow, active left green, active right pink |
| `rig/map/us`, `us_normals` | contact points of each ping; blue: the echoes fit a plane, orange: a point |
| `rig/cam_left`, `rig/cam_right` | cameras; raw frames of a few triggers, and the peaks that were believed |
| `rig/laser_plane` | the laser's plane at each stripe |
| `rig/us_array` | the array at each ping; bright: receivers that the contact points rest on |
| `us/echoes`, `us/envelope` | raw counts; compressed echoes over the path, 1 is the reference plate |
| `us/level`, `us/path` | each receiver's level, and the path of its first echo |

Frames are as taken, with the lens' distortion; points and cameras in three dimensions are without.
"""


def write(evidence: Evidence, found: HybridMap, path: Path) -> None:
    """Write one recording: what was measured at each trigger, where, and the hybrid map that was made of it.

    Notes
    -----
    Timelines are the trigger's number (``scan_step``), the rig's monotonic clock (``rig_time``) and ``utc``; map and
    notes are static. The sink is a file only: a live viewer in the same process could block it.
    """
    recording = rr.RecordingStream(APPLICATION, recording_id=f"{evidence.scan or 'scan'}-{digest(found)}")
    recording.set_sinks(rr.FileSink(path), default_blueprint=recording_layout.blueprint())
    recording.send_recording_name(f"{evidence.scan} ({evidence.plan.name})")
    _log_properties(recording, evidence, found)
    recording.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    recording_measured.log(recording, evidence)
    _log_map(recording, found)
    _log_notes(recording, evidence, found)
    recording.flush(timeout_sec=30.0)
    recording.disconnect()


def _log_properties(recording: rr.RecordingStream, evidence: Evidence, found: HybridMap) -> None:
    """What determines the map, as properties of the recording."""
    ledger = evidence.review.ledger
    recording.send_property(
        "scan",
        rr.AnyValues(
            scan=evidence.scan,
            plan=evidence.plan.name,
            rig=evidence.calibration.rig,
            archive=Path(ledger.archive).name if ledger else "",
            outcome=ledger.outcome if ledger else "",
            calibration_digest=evidence.calibration.digest,
            map_digest=digest(found),
            speed_of_sound_mps=found.registration.speed_of_sound_mps,
            echolume_version=version("echolume"),
        ),
    )


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
            probability=cells["probability"],
            stripe_first=cells["stripe_first"],
            stripe_last=cells["stripe_last"],
            ping=cells["ping"],
        ),
        static=True,
    )
    behind = cells[np.isfinite(cells["behind_mm"])]
    below = np.column_stack((x_mm[behind["ix"]], y_mm[behind["iy"]], behind["behind_mm"]))
    recording.log("rig/map/behind", rr.Points3D(below, colors=[(160, 200, 235)], radii=[0.3]), static=True)
    recording.log("map/height", rr.DepthImage(_upright(found.image("front_mm")), meter=1000.0), static=True)
    recording.log("map/labels", rr.SegmentationImage(_upright(found.image("label"))), static=True)
    gray = np.round(WHITE * np.nan_to_num(found.image("probability"), nan=0.0)).astype(np.uint8)
    recording.log("map/probability", rr.Image(_upright(gray), color_model="L"), static=True)


def _upright(image: NDArray[Any]) -> NDArray[Any]:
    """Row 0 at the top is the largest y; unknown heights become 0, which rerun leaves out."""
    flipped = image[::-1]
    return np.ascontiguousarray(np.nan_to_num(flipped, nan=0.0) if flipped.dtype.kind == "f" else flipped)


def _log_notes(recording: rr.RecordingStream, evidence: Evidence, found: HybridMap) -> None:
    """What a reviewer must know, as a text beside the map."""
    registration, ledger = found.registration, evidence.review.ledger
    passes = ledger.passes if ledger else {}
    lines = [
        f"# Scan {evidence.scan}",
        f"- plan {evidence.plan.name}, calibration {evidence.calibration.digest}, echolume {version('echolume')}",
        f"- archive {Path(ledger.archive).name}, {ledger.outcome}" if ledger else "- no ledger: the archive is torn",
        f"- hybrid map: digest {digest(found)}, {found.cells.size} cells of {found.field.cell_mm} mm",
        f"- self-registration: {registration.dz_mm:+.3f} mm over {registration.pings} pings, "
        f"residual {registration.residual_db:.1f} dB, speed of sound {registration.speed_of_sound_mps:.2f} m/s",
        *(f"- {note}" for note in found.notes),
        "\n| pass | planned | fired | matched | missing |\n|---|---|---|---|---|" if passes else "",
        *(f"| {name} | {p.planned} | {p.fired} | {p.matched} | {p.missing} |" for name, p in passes.items()),
        _GUIDE,
    ]
    recording.log("notes", rr.TextDocument("\n".join(lines), media_type=rr.MediaType.MARKDOWN), static=True)
