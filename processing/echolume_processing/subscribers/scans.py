"""What a subscriber knows of the running scans, and the records that wait for a scan's start to become known."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Generic, TypeVar

import msgspec

from echolume_messages.bus import Message, Subscription
from echolume_messages.calibration import Calibration
from echolume_messages.errors import CalibrationMissingError

PATIENCE_S = 15.0
"""How long the start of an unknown scan may take to be refilled before its records are given up."""
MAX_SCANS = 8

PipelineT = TypeVar("PipelineT")
RecordT = TypeVar("RecordT")


@dataclass(frozen=True)
class ScanSetup(Generic[PipelineT]):
    """What the start of a scan says; without a calibration there is no pipeline, and its records are skipped."""

    pipeline: PipelineT | None
    digest: str = ""
    kinds: dict[str, str] = field(default_factory=dict[str, str])
    """Kind of each pass."""


class _PassEntry(msgspec.Struct):
    name: str
    kind: str = ""


class _PlanEntry(msgspec.Struct):
    passes: list[_PassEntry] = msgspec.field(name="pass", default_factory=list[_PassEntry])


class _Start(msgspec.Struct):
    scan: str
    plan: _PlanEntry = msgspec.field(default_factory=_PlanEntry)
    calibration: msgspec.Raw = msgspec.Raw(b"null")


def read_start(
    message: Message, rig: str, make: Callable[[Calibration], PipelineT]
) -> tuple[str, ScanSetup[PipelineT]]:
    """Scan id and set-up from a ``conductor/start`` record.

    Raises
    ------
    CalibrationMissingError
        If its calibration cannot be read, is of another rig, or is one that `make` cannot use.
    """
    try:
        start = msgspec.json.decode(message.payload.tobytes(), type=_Start)
        raw = bytes(start.calibration)
        calibration = None if raw == b"null" else msgspec.json.decode(raw, type=Calibration)
    except msgspec.DecodeError as error:
        raise CalibrationMissingError(f"conductor/start seq {message.header.seq}: {error}") from error
    kinds = {entry.name: entry.kind for entry in start.plan.passes}
    if calibration is None:
        return start.scan, ScanSetup(None, "", kinds)
    if calibration.rig != rig:
        raise CalibrationMissingError(
            f"scan {start.scan}: its calibration is of rig {calibration.rig!r}, this is {rig!r}"
        )
    try:
        pipeline = make(calibration)
    except ValueError as error:
        raise CalibrationMissingError(f"scan {start.scan}: its calibration is unusable: {error}") from error
    return start.scan, ScanSetup(pipeline, calibration.digest, kinds)


class Scans(Generic[PipelineT, RecordT]):
    """The set-up of each scan by its id.

    Parameters
    ----------
    starts
        Subscription to ``conductor/start``; closed by whoever made it.
    rig
        Calibrations of other rigs are refused.
    make
        Builds the pipeline of a calibration.
    most_held
        Records that may wait here; with more, the subscriber leaves them in its queue and the journals.
    log
        Where a scan that cannot be processed is reported.
    """

    def __init__(
        self,
        starts: Subscription,
        rig: str,
        make: Callable[[Calibration], PipelineT],
        most_held: int,
        log: logging.Logger,
    ) -> None:
        self._starts = starts
        self._rig = rig
        self._make = make
        self._most_held = most_held
        self._log = log
        self._known: dict[str, ScanSetup[PipelineT]] = {}
        self._held: dict[str, list[RecordT]] = {}
        self._waiting_since_s: dict[str, float] = {}
        self.given_up = 0
        """Records of scans whose start never came."""

    @property
    def full(self) -> bool:
        """Whether no more records may be held."""
        return sum(len(records) for records in self._held.values()) >= self._most_held

    def setup(self, scan: str, record: RecordT) -> ScanSetup[PipelineT] | None:
        """Set-up of a record's scan; None if it is not known yet: then the record is held."""
        found = self._known.get(scan)
        if found is None:
            self._waiting_since_s.setdefault(scan, time.monotonic())
            self._held.setdefault(scan, []).append(record)
        return found

    def next_start(self, timeout_s: float) -> list[RecordT] | None:
        """Wait for a scan's start; the records that were held for it, or None if no start came."""
        message = self._starts.get(timeout_s)
        if message is None:
            return None
        try:
            scan, setup = read_start(message, self._rig, self._make)
        except CalibrationMissingError as error:
            self._log.error("scan not processed: %s", error)
            scan, setup = message.header.scan, ScanSetup[PipelineT](None)
        self._remember(scan, setup)
        return self._held.pop(scan, [])

    def give_up(self) -> None:
        """Let go of the records of scans whose start cannot be got any more."""
        now_s = time.monotonic()
        for scan, since_s in list(self._waiting_since_s.items()):
            if now_s - since_s > PATIENCE_S:
                self._log.warning(
                    "scan %s: its start was not received in %.0f s, its records are skipped", scan, PATIENCE_S
                )
                self.given_up += len(self._held.pop(scan, []))
                self._remember(scan, ScanSetup[PipelineT](None))

    def _remember(self, scan: str, setup: ScanSetup[PipelineT]) -> None:
        self._known[scan] = setup
        self._waiting_since_s.pop(scan, None)
        if len(self._known) > MAX_SCANS:
            del self._known[next(iter(self._known))]
