"""A whole scan at once: from its archive, or from gathered evidence, to the map and its files."""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import TypedDict

import numpy as np
from numpy.typing import NDArray

from echolume_messages import archive as archives
from echolume_messages import topics
from echolume_messages.bus import Message
from echolume_messages.errors import ArchiveError, CalibrationError, CalibrationMissingError
from echolume_messages.files import make_folder
from echolume_processing import figures
from echolume_processing.evidence import Evidence, ScanStart, read_start
from echolume_processing.export import npz
from echolume_processing.hybrid import ply, recording
from echolume_processing.hybrid.baselines import Baselines, baselines
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.growing import GrowingMap
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.rules import registry
from echolume_processing.hybrid.rules.names import DEFAULT
from echolume_processing.hybrid.stored import StoredMap
from echolume_processing.optical.pipeline import OpticalPipeline
from echolume_processing.ping import ping_from_record
from echolume_processing.review import REPORTS
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline

log = logging.getLogger("echolume.session")
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is (0: unknown)."""


class Results(TypedDict):
    """What a scan came to."""

    scan: str
    rule: str
    """How light and sound were fused."""
    digest: str
    files: list[str]
    points: dict[str, int]
    cells: dict[str, int]
    registration: dict[str, object]
    notes: list[str]


def silent(what: str, done: int, total: int) -> None:
    """Progress for nobody."""


def reprocess(archive: Path, out: Path, progress: Progress = silent, rule: str = DEFAULT) -> Results:
    """Rebuild the hybrid map of a scan from its raw archive, with the subscribers' own functions.

    Parameters
    ----------
    archive
        ``raw.mcap`` of a scan with a calibration; a torn one gives what it holds.
    out
        Folder for the map and its pictures; made if needed.
    progress
        Told what is going on.
    rule
        How light and sound are fused: a name of `hybrid.rules`.

    Raises
    ------
    ConfigError
        If there is no such rule.
    ArchiveError
        If it is no archive, or holds no start of a scan.
    CalibrationMissingError
        If the scan was made without a calibration.
    """
    registry.named(rule)  # before the archive is read: that takes its time
    start = _start(archive)
    make_folder(out)
    return conclude(gather(archive, progress, start), out, progress, rule)[1]


def gather(archive: Path, progress: Progress = silent, start: ScanStart | None = None) -> Evidence:
    """Evidence of a scan from its raw archive."""
    start = start or _start(archive)
    if start.calibration is None:
        raise CalibrationMissingError(
            f"{archive}: scan {start.scan} was made without a calibration, so there is no map of it; calibrate the rig "
            "(`echolume calibrate rig`), name the file in the rig file, and scan again"
        )
    evidence = Evidence.of(start, start.calibration)
    try:
        optical, ultrasonic = OpticalPipeline(start.calibration), UltrasonicPipeline(start.calibration)
    except ValueError as error:
        raise CalibrationError(f"{archive}: the calibration of scan {start.scan} is unusable: {error}") from error
    kinds = {p.name: str(p.__struct_config__.tag) for p in start.plan.passes}
    halves: dict[tuple[int, int], Message] = {}
    wanted = (topics.CAMERA_LEFT, topics.CAMERA_RIGHT, topics.ECHOES, *REPORTS)
    for message in archives.read(archive, [t.name for t in wanted]):
        header = message.header
        if header.scan != start.scan:
            continue
        key = (header.trigger, header.attempt)
        if message.topic in REPORTS:
            evidence.review.add_report(message)
        elif message.topic == topics.ECHOES and kinds.get(header.pass_name) == "ultrasonic":
            try:
                ping = ping_from_record(header, np.asarray(message.payload, dtype=np.int16))
                points = ultrasonic.process(ping)
            except ValueError as error:
                log.warning("%s: trigger %d: the ping is skipped: %s", archive, header.trigger, error)
                continue
            evidence.add_ping(*key, ping)
            evidence.add_ultrasonic(*key, points)
            evidence.review.add_moment(header)
            progress("pings", len(evidence.pings), 0)
        elif message.topic != topics.ECHOES and kinds.get(header.pass_name) == "optical":
            evidence.review.add_frame(message)
            other = halves.pop(key, None)
            if other is None or other.topic == message.topic:
                halves[key] = message
                continue
            left, right = (message, other) if message.topic == topics.CAMERA_LEFT else (other, message)
            frames = np.asarray(left.payload, dtype=np.uint8), np.asarray(right.payload, dtype=np.uint8)
            try:
                evidence.add_optical(*key, optical.process(*frames, _guide_x_mm(left), left.header.source.sigma_mm))
            except ValueError as error:
                log.warning("%s: trigger %d: the stripe is skipped: %s", archive, header.trigger, error)
                continue
            evidence.review.add_moment(left.header)
            progress("stripes", len(evidence.optical), 0)
    return evidence


def conclude(
    evidence: Evidence,
    out: Path,
    progress: Progress = silent,
    rule: str = DEFAULT,
    grown: GrowingMap | None = None,
) -> tuple[HybridMap, Results]:
    """Fuse gathered evidence and write the map: ``hybrid.ply``, ``map.npz``, ``hybrid.rrd``, ``figures/*.png``.

    A map that grew with the same evidence is finished instead of fused by a rule: it is the default rule's.
    """
    out.mkdir(parents=True, exist_ok=True)
    progress("fusing", 0, 3)
    optical, ultrasonic = evidence.all_optical(), evidence.all_ultrasonic()
    field = evidence.plan.map
    if grown is not None:
        found = grown.finish()
    else:
        triggers = evidence.optical_triggers(), evidence.ultrasonic_triggers()
        pings = evidence.all_pings()
        found = registry.fuse_by(rule, optical, ultrasonic, pings, evidence.calibration, field, *triggers)
    others = baselines(optical, ultrasonic, field)
    progress("writing", 1, 3)
    calibration = evidence.calibration.digest
    ply.write(found, out / "hybrid.ply", evidence.scan, calibration)
    npz.write(StoredMap(found, evidence.scan, calibration, layers_of(others)), out / "map.npz")
    recording.write(evidence, found, out / "hybrid.rrd")
    progress("drawing", 2, 3)
    drawn = figures.draw(optical, ultrasonic, found, others, out / "figures")
    progress("done", 3, 3)
    labels = np.bincount(found.cells["label"], minlength=5)
    results = Results(
        scan=evidence.scan,
        rule=rule,
        digest=digest(found),
        files=["hybrid.rrd", "hybrid.ply", "map.npz", *(f"figures/{path.name}" for path in drawn)],
        points=evidence.counts(),
        cells={label.name.lower(): int(labels[label]) for label in recording.LABELS},
        registration=found.registration.report(),
        notes=list(found.notes),
    )
    return found, results


def layers_of(others: Baselines) -> dict[str, NDArray[np.float32]]:
    """The baselines' heights, as the map's file holds them beside its own."""
    return {
        "optical_mm": others.optical_mm.astype(np.float32),
        "ultrasonic_mm": others.ultrasonic_mm.astype(np.float32),
        "union_mm": others.union_mm.astype(np.float32),
    }


def _guide_x_mm(left: Message) -> float:
    x_mm = left.header.source.x_mm
    if x_mm is None:
        raise ValueError("the left frame carries no guide position")
    return x_mm


def _start(archive: Path) -> ScanStart:
    """The start of the scan that an archive holds."""
    for message in archives.read(archive, [topics.SCAN_START.name]):
        try:
            return read_start(message)
        except CalibrationMissingError as error:
            raise CalibrationMissingError(f"{archive}: {error}") from error
    if not archives.summary(archive).records:
        raise ArchiveError(f"{archive}: is empty, or cut before its first whole chunk: nothing can be read from it")
    raise ArchiveError(f"{archive}: holds no {topics.SCAN_START.name}; it is no archive of a scan")
