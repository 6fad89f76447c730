"""The recorder service: writes what is published into the scan's archive, and acknowledges what is on the disk."""

from __future__ import annotations

import shutil
import threading
import time
from dataclasses import dataclass, field
from pathlib import Path

from echolume_daemon.archive_index import ArchiveIndex
from echolume_daemon.body import Json, text
from echolume_daemon.mcap_writer import ArchiveWriter, Durable
from echolume_daemon.service import Loop, Service, run_service
from echolume_messages import archive, topics
from echolume_messages.bus import Bus, Message, Subscription
from echolume_messages.errors import ArchiveError, ConfigError, WrongStateError
from echolume_messages.rig import Rig

QUEUE_RECORDS = 96
"""Records that may wait for the disk; what comes on top stays in the journals until there is room."""
QUIET_S = 0.25
"""An archive is closed once nothing of its scan has come for this long."""
QUIET_LIMIT_S = 5.0
CLOSED_ARCHIVES = 8
LOOP_LIMIT_S = 15.0
COMMAND_LIMIT_S = 30.0


@dataclass
class Recording:
    """One scan being recorded."""

    scan: str
    writer: ArchiveWriter
    arrived_s: float = field(default_factory=time.monotonic)
    durable: dict[str, int] = field(default_factory=dict[str, int])
    count: int = 0
    reported: bool = False

    def acknowledge(self, made: list[Durable]) -> Json:
        """Body of the ``recorder/durable`` message for what has just become durable."""
        for record in made:
            self.durable[record.topic] = max(record.seq, self.durable.get(record.topic, -1))
        self.count += len(made)
        failure = self.writer.failure
        return {
            "scan": self.scan,
            "durable": dict(self.durable),
            "records": [list(record) for record in made],
            "count": self.count,
            "error": str(failure) if failure is not None else "",
        }

    def result(self) -> Json:
        """Where the archive is, and what it holds."""
        return {"path": str(self.writer.path), "bytes": self.writer.bytes, "records": dict(self.writer.records)}


class Recorder:
    """Loop and commands of the recorder.

    It listens only while an archive is open: a recorder that comes back in the middle of a scan then gets from the
    journals what was published while it was away, instead of having thrown it away before the archive is opened again.
    """

    def __init__(self, service: Service) -> None:
        self._service = service
        self._settings = service.rig.recorder
        self._directory = Path(self._settings.directory)
        self._sync_s = self._settings.sync_ms * 1e-3
        self._publisher = service.bus.publisher(topics.DURABLE)
        self._recorded = [topic for topic in topics.TOPICS if topic.recorded]
        self._recordings: dict[str, Recording] = {}
        self._closed: dict[str, Json] = {}
        self._ignored = 0
        self._index = ArchiveIndex()
        self._lock = threading.Lock()
        self._listening = threading.Event()
        self._subscription: Subscription | None = None
        service.bus.serve_archive(self._recorded, self._index)
        service.thread("record", self._step, LOOP_LIMIT_S)
        service.serve({"open": self._open, "close": self._close}, COMMAND_LIMIT_S)
        service.serve({"status": self._status}, COMMAND_LIMIT_S)

    def health(self) -> Json:
        """Open archives, the queue, room on the disk."""
        with self._lock:
            open_archives: Json = {scan: recording.result() for scan, recording in self._recordings.items()}
            subscription = self._subscription
            failures = [str(r.writer.failure) for r in self._recordings.values() if r.writer.failure is not None]
        return {
            "devices": {},
            "archives": open_archives,
            "failures": failures,
            "ignored": self._ignored,
            "queues": {"bus": subscription.stats if subscription is not None else {}},
            "free_bytes": _free_bytes(self._directory),
        }

    def close(self) -> None:
        """Bring everything that has come to the disk and close the archives."""
        subscription = self._subscription
        while subscription is not None and (message := subscription.get(0.0)) is not None:
            with self._lock:
                self._take(message)
        with self._lock:
            for scan in list(self._recordings):
                self._finish(scan)
        self._stop_listening()

    # -- the loop

    def _step(self, _loop: Loop) -> None:
        """Take one record, or sync what has waited long enough."""
        subscription = self._subscription
        if subscription is None:
            self._listening.wait(0.1)
            return
        message = subscription.get(self._patience_s())
        with self._lock:
            if message is not None:
                self._take(message)
            for recording in self._recordings.values():
                since_s = recording.writer.unsynced_since_s
                if since_s is not None and time.monotonic() - since_s >= self._sync_s:
                    self._sync(recording)

    def _patience_s(self) -> float:
        """How long the loop may wait for a record before something has to be synced."""
        with self._lock:
            waiting = [r.writer.unsynced_since_s for r in self._recordings.values()]
        oldest_s = min((s for s in waiting if s is not None), default=None)
        return 0.1 if oldest_s is None else max(0.0, min(0.1, oldest_s + self._sync_s - time.monotonic()))

    def _take(self, message: Message) -> None:
        recording = self._recordings.get(message.header.scan)
        if recording is None:
            self._ignored += 1
            return
        recording.arrived_s = time.monotonic()
        if recording.writer.failure is not None:
            return
        try:
            recording.writer.write(message)
        except ArchiveError as error:
            self._report(recording, error)

    def _sync(self, recording: Recording) -> None:
        if recording.writer.failure is not None:
            return
        try:
            made = recording.writer.sync()
        except ArchiveError as error:
            self._report(recording, error)
            return
        self._index.add(recording.writer.path, recording.writer.places())
        if made:
            self._publisher.put_json(recording.acknowledge(made), scan=recording.scan)

    def _report(self, recording: Recording, error: ArchiveError) -> None:
        """Tell everybody, once, that this archive takes nothing any more."""
        if not recording.reported:
            recording.reported = True
            self._service.log.error("scan %s: %s", recording.scan, error)
            self._publisher.put_json(recording.acknowledge([]), scan=recording.scan)

    # -- commands

    def _open(self, body: Json) -> Json:
        scan = text(body, "scan")
        path = self._path(text(body, "name"), text(body, "directory", ""))
        with self._lock:
            found = self._recordings.get(scan)
            if found is not None:
                if found.writer.path != path:
                    raise WrongStateError(f"recorder: scan {scan} is being recorded in {found.writer.path}")
                return {"path": str(path)}
            resume = path.exists() and _left_by(path, scan)
            recording = Recording(scan, ArchiveWriter(path, resume))
            self._recordings[scan] = recording
            self._closed.pop(scan, None)
            self._index.keep_only(r.writer.path for r in self._recordings.values())
            if resume:
                self._sync(recording)
            if self._subscription is None:
                self._subscription = self._service.bus.subscribe(self._recorded, depth=QUEUE_RECORDS, archive=False)
                self._listening.set()
        self._service.log.info("scan %s: %s in %s", scan, "goes on" if resume else "recording", path)
        return {"path": str(path)}

    def _path(self, name: str, directory: str) -> Path:
        if not name or "/" in name or name in (".", ".."):
            raise ConfigError(f"$.name: {name!r} is no file name")
        folder = Path(directory) if directory else self._directory
        if not folder.is_absolute():
            raise ConfigError(f"$.directory: {directory!r} is not absolute")
        return folder / f"{name}.mcap"

    def _close(self, body: Json) -> Json:
        scan = text(body, "scan")
        if scan in self._closed:
            return self._closed[scan]
        if scan not in self._recordings:
            raise WrongStateError(f"recorder: scan {scan} is not being recorded; open: {', '.join(self._recordings)}")
        self._await_quiet(self._recordings[scan])
        with self._lock:
            failure = self._finish(scan)
            idle = not self._recordings
        if idle:
            self._stop_listening()
        if failure is not None:
            raise failure
        return self._closed[scan]

    def _await_quiet(self, recording: Recording) -> None:
        """Wait until what is still on its way has come."""
        subscription = self._subscription
        deadline_s = time.monotonic() + QUIET_LIMIT_S
        while time.monotonic() < deadline_s:
            idle_s = time.monotonic() - recording.arrived_s
            if idle_s >= QUIET_S and (subscription is None or subscription.stats["depth"] == 0):
                return
            if self._service.stop.wait(max(0.01, min(QUIET_S - idle_s, 0.05))):
                return

    def _finish(self, scan: str) -> ArchiveError | None:
        """Close a scan's archive; the error, if the disk did not take it."""
        recording = self._recordings.pop(scan)
        failure: ArchiveError | None = None
        try:
            made = recording.writer.close()
            self._index.add(recording.writer.path, recording.writer.places())
            self._publisher.put_json(recording.acknowledge(made), scan=scan)
        except ArchiveError as error:
            failure = error
            self._report(recording, error)
        self._closed[scan] = recording.result()
        while len(self._closed) > CLOSED_ARCHIVES:
            del self._closed[next(iter(self._closed))]
        self._service.log.info("scan %s: closed, %d records", scan, sum(recording.writer.records.values()))
        return failure

    def _stop_listening(self) -> None:
        with self._lock:
            subscription, self._subscription = self._subscription, None
            self._listening.clear()
        if subscription is not None:
            subscription.close()

    def _status(self, _body: Json) -> Json:
        return self.health()


def _left_by(path: Path, scan: str) -> bool:
    """Whether this scan left the archive behind (or nobody wrote a record into it), so that it may be gone on with."""
    try:
        first = next(iter(archive.read(path)), None)
    except ArchiveError:
        return False  # to open it then says what it is
    return first is None or first.header.scan == scan


def _free_bytes(directory: Path) -> int | None:
    """Room on the archive's disk; None while its directory is not there."""
    existing = next((d for d in (directory, *directory.parents) if d.exists()), None)
    return None if existing is None else shutil.disk_usage(existing).free


def main(
    bus: Bus | None = None,
    rig: Rig | None = None,
    device: None = None,
    stop: threading.Event | None = None,
) -> int:
    """Run the recorder until it is told to stop; returns the exit code."""
    return run_service("recorder", Recorder, bus, rig, stop)
