"""The conductor: takes the operator's commands, runs scans, and tells the state."""

from __future__ import annotations

import contextlib
import secrets
import threading
import time
from pathlib import Path
from typing import cast

import msgspec

from echolume_daemon.acquisition import SERVICES_OF, Acquisition, Interrupted, make_safe
from echolume_daemon.body import Json, text
from echolume_daemon.lease import Lease
from echolume_daemon.ledger import Ledger
from echolume_daemon.run import ScanRun
from echolume_daemon.service import Loop, Service, run_service
from echolume_daemon.states import Event, RunState, follow
from echolume_messages import archive
from echolume_messages import calibration as calibration_file
from echolume_messages import plan as plan_file
from echolume_messages.bus import Bus
from echolume_messages.errors import ArchiveError, ConfigError, EcholumeError, WrongStateError
from echolume_messages.rig import Rig
from echolume_messages.topics import DURABLE, RUN_STATE

_STATE_PERIOD_S = 0.5
_COMMAND_LIMIT_S = 60.0
_CLOSE_S = 6.0


class Conductor:
    """Run state, lease, and the scan under way."""

    def __init__(self, service: Service) -> None:
        self._service = service
        self._lease = Lease()
        self._changed = threading.Condition()
        self._state = RunState.IDLE
        self._revision = 0
        self._error = self._prompt = self._pass = self._kind = self._plan = ""
        self._run: ScanRun | None = None
        self._worker: threading.Thread | None = None
        self._ledger: Json | None = None
        self._publisher = service.bus.publisher(RUN_STATE)
        self._durable = service.bus.subscribe([DURABLE], depth=256)
        service.thread("durable", self._listen, 10.0)
        service.thread("state", self._tell, 10.0)
        service.serve(
            {"scan.start": self._start, "scan.pause": self._pause, "scan.resume": self._resume}, _COMMAND_LIMIT_S
        )
        service.serve({"scan.status": self._status, "scan.abort": self._abort, "scan.halt": self._halt}, 30.0)

    def health(self) -> Json:
        """Run state and who commands."""
        return {"state": self._state.value, "holder": self._lease.holder}

    def close(self) -> None:
        """End a scan under way in good order."""
        worker = self._worker
        if worker is not None:
            worker.join(_CLOSE_S)
            if worker.is_alive():
                self._service.log.error("the scan did not end within %.0f s; its archive stays open-ended", _CLOSE_S)

    # -- the stage on which a run plays

    def happen(self, event: Event, *, error: str = "", prompt: str = "") -> None:
        """Follow the state table, and tell."""
        with self._changed:
            before = self._state
            self._state = follow(before, event)
            self._revision += 1
            self._prompt = prompt
            self._error = error or self._error
            self._changed.notify_all()
            self._publish()
        why = f": {error or prompt}" if error or prompt else ""
        self._service.log.info("%s -> %s (%s)%s", before, self._state, event, why)

    def advance(self, event: Event, *, prompt: str = "") -> None:
        """Pass the gate, then follow the state table, with nobody in between."""
        with self._changed:
            self.gate()
            self.happen(event, prompt=prompt)

    def gate(self) -> None:
        """Wait while paused; raise `Interrupted` when the scan is to end."""
        with self._changed:
            while self._state is RunState.PAUSED and not self._service.stop.is_set():
                self._changed.wait(0.2)
            if self._service.stop.is_set() and self._state in (RunState.ARMING, RunState.RUNNING, RunState.PAUSED):
                self.happen(Event.ABORT)
            if self._state in (RunState.ABORTING, RunState.HALTING):
                raise Interrupted

    @property
    def hurried(self) -> bool:
        """Whether the service is about to stop."""
        return self._service.stop.is_set()

    def enter(self, pass_name: str, kind: str) -> None:
        """A pass begins."""
        with self._changed:
            self._pass, self._kind = pass_name, kind
            self._publish()

    # -- commands

    def _start(self, body: Json) -> Json:
        holder = text(body, "holder")
        plan = plan_file.parse(text(body, "plan"))
        found, digest = self._calibration(body.get("calibration"))
        self._lease.take(holder)
        with self._changed:
            self._error = ""
            self.happen(Event.START)
            self._plan, self._pass, self._kind = plan.name, "", ""
        try:
            run = self._arm(plan, text(body, "archive", ""), found, digest)
        except EcholumeError as error:
            self._refuse(str(error))
            raise
        except Interrupted:
            self._refuse("")
            raise WrongStateError("conductor: the scan was ended while it was arming") from None
        except Exception as error:
            self._refuse(f"internal error: {error!r}")
            raise
        self._worker = threading.Thread(target=run.run, name="conductor.scan", daemon=True)
        self._worker.start()
        return {"scan": run.scan, "archive": run.archive}

    def _refuse(self, why: str) -> None:
        """Arming failed: back to idle, unless the operator ended it meanwhile."""
        with self._changed:
            self._run = None
            self.happen(Event.REFUSED if self._state is RunState.ARMING else Event.CLOSED, error=why)

    def _arm(self, plan: plan_file.Plan, path: str, calibration: Json | None, digest: str) -> ScanRun:
        bus, rig = self._service.bus, self._service.rig
        if path and not Path(path).is_absolute():
            raise ConfigError(f"$.archive: expected an absolute path, got {path!r}")
        scan, ledger = self._ledger_of(plan, path, calibration)
        acquisition = Acquisition(bus, rig, scan, digest, ledger, self.gate)
        run = ScanRun(bus, rig, scan, plan, path, calibration, acquisition, self, self._keep_ledger)
        acquisition.check(run.kinds)
        with self._changed:
            self._run = run
        run.open_archive()
        return run

    def _ledger_of(self, plan: plan_file.Plan, path: str, calibration: Json | None) -> tuple[str, Ledger]:
        """A new scan, or the one that an unfinished archive of the same plan and calibration was left behind by."""
        if path and Path(path).exists() and archive.summary(Path(path)).torn:
            ledger, start = Ledger.from_archive(Path(path))
            if start.plan != plan or start.calibration != calibration:
                raise ArchiveError(f"{path}: is of another plan or calibration; choose another file for this scan")
            _, _, matched = ledger.count()
            self._service.log.info("scan %s goes on in %s: %d matched so far", start.scan, path, matched)
            return start.scan, ledger
        scan = f"{plan.name}-{time.strftime('%Y%m%dT%H%M%S', time.gmtime())}-{secrets.token_hex(2)}"
        return scan, Ledger(plan_file.expand(plan))

    def _calibration(self, given: object) -> tuple[Json | None, str]:
        """The scan's calibration, checked to be of this rig, and its digest."""
        if given is None:
            return None, ""
        found = calibration_file.parse(msgspec.json.encode(given), "scan.start: $.calibration", self._service.rig.name)
        return cast(Json, msgspec.to_builtins(found)), found.digest

    def _command(self, body: Json, event: Event) -> Json:
        self._lease.take(text(body, "holder"))
        self.happen(event)
        return self._snapshot()

    def _pause(self, body: Json) -> Json:
        return self._command(body, Event.PAUSE)

    def _resume(self, body: Json) -> Json:
        return self._command(body, Event.RESUME)

    def _abort(self, body: Json) -> Json:
        return self._command(body, Event.ABORT)

    def _halt(self, body: Json) -> Json:
        """Stop now. Anybody may: an emergency asks for no lease."""
        with contextlib.suppress(WrongStateError):  # idle, or halting already: the devices are stopped all the same
            self.happen(Event.HALT)
        make_safe(self._service.bus, SERVICES_OF, at_once=True)
        self._service.log.warning("halted by %s", text(body, "holder", "somebody"))
        return self._snapshot()

    def _status(self, body: Json) -> Json:
        self._lease.renew(text(body, "holder", ""))
        out = self._snapshot() | {"holder": self._lease.holder}
        if self._ledger is not None:
            out["ledger"] = self._ledger
        return out

    # -- loops

    def _listen(self, _loop: Loop) -> None:
        message = self._durable.get(0.2)
        run = self._run
        if message is None or run is None:
            return
        try:
            run.acquisition.durable(cast(Json, message.json()))
        except (TypeError, ValueError) as error:  # a stranger's: it must not end the scan
            self._service.log.warning("a %s of another make is left out: %s", message.topic.name, error)

    def _tell(self, _loop: Loop) -> None:
        """Tell the state twice a second, so that who comes late knows it soon."""
        with self._changed:
            self._publish()
        self._service.stop.wait(_STATE_PERIOD_S)

    def _publish(self) -> None:
        run = self._run
        self._publisher.put_json(self._snapshot(), scan=run.scan if run is not None else "")

    def _snapshot(self) -> Json:
        with self._changed:
            run = self._run
            planned = fired = matched = 0
            if run is not None:
                with run.acquisition.changed:
                    planned, fired, matched = run.acquisition.ledger.count()
            return {
                "state": self._state.value,
                "revision": self._revision,
                "scan": run.scan if run is not None else "",
                "plan": self._plan,
                "pass": self._pass,
                "kind": self._kind,
                "planned": planned,
                "fired": fired,
                "matched": matched,
                "prompt": self._prompt,
                "error": self._error,
            }

    def _keep_ledger(self, report: Json) -> None:
        self._ledger = report


def main(
    bus: Bus | None = None,
    rig: Rig | None = None,
    device: None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run the conductor until it is told to stop; returns the exit code."""
    return run_service("conductor", Conductor, bus, rig, stop)
