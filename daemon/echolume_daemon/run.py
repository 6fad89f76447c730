"""One scan from arming to the final ledger: the conductor's worker."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol

import msgspec

from echolume_daemon.acquisition import Acquisition, Interrupted, make_safe
from echolume_daemon.body import Json
from echolume_daemon.ledger import Outcome
from echolume_daemon.states import Event
from echolume_messages.bus import Bus, Publisher
from echolume_messages.errors import EcholumeError
from echolume_messages.plan import Plan
from echolume_messages.rig import Rig
from echolume_messages.topics import LEDGER, SCAN_START

DURABLE_S = 5.0
"""How long the end of a scan waits for the recorder to catch up;"""
HURRIED_S = 0.5
"""and when the conductor itself is told to stop."""
_log = logging.getLogger("echolume.run")


class Stage(Protocol):
    """What the worker needs of the conductor."""

    def happen(self, event: Event, *, error: str = "", prompt: str = "") -> None:
        """Follow the state table."""
        ...

    def advance(self, event: Event, *, prompt: str = "") -> None:
        """Wait while paused, raise `Interrupted` when the scan is to end, else follow the state table."""
        ...

    @property
    def hurried(self) -> bool:
        """Whether the conductor is about to stop."""
        ...

    def enter(self, pass_name: str, kind: str) -> None:
        """A pass begins."""
        ...


@dataclass
class ScanRun:
    """A scan under way."""

    bus: Bus
    rig: Rig
    scan: str
    plan: Plan
    archive: str
    calibration: Json | None
    acquisition: Acquisition
    stage: Stage
    on_ledger: Callable[[Json], None]

    def __post_init__(self) -> None:
        self.acquisition.reopen = self.open_archive
        self._ledgers: Publisher = self.bus.publisher(LEDGER)
        self._starts: Publisher = self.bus.publisher(SCAN_START)
        self.kinds = list(dict.fromkeys(step.kind for step in self.acquisition.ledger.steps))

    def open_archive(self) -> None:
        """Have the recorder open the archive of this scan.

        Raises
        ------
        EcholumeError
            The recorder cannot: the disk is full, the directory is missing, or it is not running.
        """
        body: Json = {"scan": self.scan, "name": self.scan}
        if self.archive:
            path = Path(self.archive)
            body |= {"name": path.name.removesuffix(".mcap"), "directory": str(path.parent)}
        self.archive = str(self.bus.request("recorder", "open", body, 10.0).get("path", self.archive))

    def run(self) -> None:
        """Acquire the plan, then close the ledger and the archive, whatever happened."""
        outcome: Outcome = "failed"
        try:
            self._acquire()
            self.stage.advance(Event.DONE)
            outcome = "complete" if self.acquisition.ledger.complete() else "incomplete"
        except Interrupted:
            outcome = "aborted"
        except EcholumeError as error:
            self._fail(str(error))
        except Exception as error:  # noqa: BLE001  the operator is told, the ledger still closes
            _log.exception("scan %s", self.scan)
            self._fail(f"internal error: {error!r}")
        finally:
            self._finish(outcome)

    def _acquire(self) -> None:
        self._starts.put_json(
            {
                "scan": self.scan,
                "plan": msgspec.to_builtins(self.plan),
                "calibration": self.calibration,
                "rig": self.rig.name,
                "array": {k: v for k, v in msgspec.to_builtins(self.rig.array).items() if k != "port"},
            },
            scan=self.scan,
            calibration=self.acquisition.calibration,
        )
        for kind in self.kinds:
            self.acquisition.prepare(kind, begin=True)
        self.stage.advance(Event.ARMED)
        for item in self.plan.passes:
            self._pass(item.name)

    def _pass(self, name: str) -> None:
        """One pass, and again what is missing of it, as often as the plan allows."""
        acquisition = self.acquisition
        missing = acquisition.ledger.missing(name)
        if not missing:
            return
        self.stage.enter(name, missing[0].kind)
        prompt = next((s.prompt for s in acquisition.ledger.steps if s.pass_name == name and s.prompt), "")
        if prompt:
            self.stage.advance(Event.PROMPT, prompt=prompt)
        for _ in range(max(1, self.plan.max_attempts)):
            acquisition.run(missing)
            missing = acquisition.drain(name)
            if not missing:
                break
            _log.warning("pass %s: missing triggers %s", name, [s.trigger for s in missing])
        self._publish("incomplete", final=False)

    def _fail(self, text: str) -> None:
        _log.error("scan %s: %s", self.scan, text)
        self.stage.happen(Event.FAIL, error=text)

    def _publish(self, outcome: Outcome, *, final: bool) -> int:
        with self.acquisition.changed:
            report = self.acquisition.ledger.report(self.scan, outcome, final=final)
        report["archive"] = self.archive
        self.on_ledger(report)
        return self._ledgers.put_json(report, scan=self.scan)

    def _finish(self, outcome: Outcome) -> None:
        make_safe(self.bus, self.kinds, at_once=False)
        patience_s = HURRIED_S if self.stage.hurried else DURABLE_S
        self.acquisition.settle(patience_s)
        seq = self._publish(outcome, final=True)
        self._await_ledger(seq, patience_s)
        try:
            self.bus.request("recorder", "close", {"scan": self.scan}, 15.0)
        except EcholumeError as error:
            _log.error("closing the archive of %s: %s", self.scan, error)
        self.stage.happen(Event.CLOSED)

    def _await_ledger(self, seq: int, patience_s: float) -> None:
        """Wait until the ledger itself is on the disk."""
        acquisition = self.acquisition
        with acquisition.changed:
            if not acquisition.changed.wait_for(
                lambda: acquisition.durable_seq.get(LEDGER.name, -1) >= seq, patience_s
            ):
                _log.warning("scan %s: the recorder has not acknowledged the ledger", self.scan)
