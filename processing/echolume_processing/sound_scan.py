"""The ultrasonic half of a scan, from its archive: pings, and the contact points that they give."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from echolume_messages import archive as archives
from echolume_messages import topics
from echolume_messages.bus.message import Message
from echolume_messages.errors import ArchiveError, CalibrationError, CalibrationMissingError
from echolume_messages.types import ULTRASONIC_POINT, Structured
from echolume_processing.evidence import ScanStart, read_start
from echolume_processing.ping import Ping, ping_from_record
from echolume_processing.ultrasonic.delay_and_sum import silent
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline

log = logging.getLogger("echolume.imaging")
Progress = Callable[[str, int, int], None]
"""Called with what is being done, how much of it is done, and how much there is (0: unknown)."""


@dataclass(frozen=True)
class SoundScan:
    """The ultrasonic half of a scan."""

    start: ScanStart
    pipeline: UltrasonicPipeline
    pings: list[Ping]
    points: Structured


def read_sound(archive: Path, progress: Progress = silent) -> SoundScan:
    """Pings and contact points of a scan's ultrasonic passes, by trigger; of each trigger the last attempt.

    Raises
    ------
    ArchiveError
        If it is no archive of a scan, or holds no pings.
    CalibrationMissingError
        If the scan was made without a calibration.
    """
    start: ScanStart | None = None
    latest: dict[int, Message] = {}
    for message in archives.read(archive, [topics.SCAN_START.name, topics.ECHOES.name]):
        if message.topic == topics.SCAN_START:
            start = start or read_start(message)
            continue
        before = latest.get(message.header.trigger)
        if before is None or before.header.attempt <= message.header.attempt:
            latest[message.header.trigger] = message
            progress("reading pings", len(latest), 0)
    if start is None:
        raise ArchiveError(f"{archive}: holds no {topics.SCAN_START.name}; it is no archive of a scan")
    if start.calibration is None:
        raise CalibrationMissingError(
            f"{archive}: scan {start.scan} was made without a calibration, so echoes have no place; calibrate the rig "
            "(`echolume calibrate rig`), name the file in the rig file, and scan again"
        )
    try:
        pipeline = UltrasonicPipeline(start.calibration)
    except ValueError as error:
        raise CalibrationError(f"{archive}: the calibration of scan {start.scan} is unusable: {error}") from error
    passes = {p.name for p in start.plan.passes if str(p.__struct_config__.tag) == "ultrasonic"}
    pings: list[Ping] = []
    points: list[Structured] = []
    for trigger in sorted(latest):
        header = latest[trigger].header
        if header.scan != start.scan or header.pass_name not in passes:
            continue
        try:
            ping = ping_from_record(header, np.asarray(latest[trigger].payload, dtype=np.int16))
            found = pipeline.process(ping)
        except ValueError as error:
            log.warning("%s: trigger %d: the ping is skipped: %s", archive, trigger, error)
            continue
        pings.append(ping)
        points.append(found)
        progress("contact points", len(pings), len(latest))
    if not pings:
        raise ArchiveError(
            f"{archive}: scan {start.scan} holds no pings of an ultrasonic pass; scan with a plan that has one"
        )
    return SoundScan(start, pipeline, pings, np.concatenate([np.zeros(0, ULTRASONIC_POINT), *points]))
