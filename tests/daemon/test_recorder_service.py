"""The recorder service on a real bus: what it acknowledges is in the archive, whatever happens to it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import msgspec
import numpy as np
import pytest

from daemon.fake_rig import free_endpoint, make_rig, wait_until
from echolume_daemon import recorder
from echolume_messages import archive, topics
from echolume_messages.bus import Bus, Publisher, connect
from echolume_messages.bus.router import open_router
from echolume_messages.errors import ArchiveError, ConfigError, WrongStateError
from echolume_messages.rig import Rig

Key = tuple[str, int, int, int]


@pytest.fixture(scope="module")
def endpoint() -> Iterator[str]:
    at = free_endpoint()
    with open_router(at):
        yield at


@dataclass
class Listener:
    """Collects the recorder's acknowledgements."""

    bus: Bus
    records: set[Key] = field(default_factory=set)
    seqs: dict[str, int] = field(default_factory=dict)
    errors: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self._sub = self.bus.subscribe([topics.DURABLE], depth=512)
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._sub.closed:
            message = self._sub.get(0.2)
            if message is not None:
                body = message.json()
                assert isinstance(body, dict)
                self.records |= {tuple(r) for r in body["records"]}
                self.seqs |= body["durable"]
                self.errors += [body["error"]] if body["error"] else []


@pytest.fixture
def rig(endpoint: str, tmp_path: Path, request: pytest.FixtureRequest) -> Rig:
    made = make_rig(endpoint, tmp_path / "archives")
    made.name = request.node.name
    return made


@pytest.fixture
def bus(rig: Rig) -> Iterator[Bus]:
    with connect(rig.bus.endpoint, rig.name) as made:
        yield made


@pytest.fixture
def running(rig: Rig, bus: Bus) -> Iterator[Listener]:
    stop = threading.Event()
    codes: list[int] = []
    with connect(rig.bus.endpoint, rig.name) as own:
        thread = threading.Thread(target=lambda: codes.append(recorder.main(own, rig, None, stop)), daemon=True)
        thread.start()
        wait_until(lambda: "recorder" in bus.alive(), "the recorder is alive")
        yield Listener(bus)
        stop.set()
        thread.join(10)
    assert codes == [0]


def publish(pub: Publisher, numbers: range, scan: str = "s1") -> None:
    for k in numbers:
        pub.put(np.full((8, 64), k % 1000, "<i2"), scan=scan, pass_name="p", trigger=k)


def triggers(path: Path) -> list[int]:
    return [message.header.trigger for message in archive.read(path, {"array/echoes"})]


def test_a_scan_is_recorded_acknowledged_and_closed(running: Listener, bus: Bus, rig: Rig) -> None:
    opened = bus.request("recorder", "open", {"scan": "s1", "name": "one"})
    path = Path(str(opened["path"]))
    assert path == Path(rig.recorder.directory) / "one.mcap"
    frame = np.arange(64, dtype="u1").reshape(8, 8)
    bus.publisher(topics.CAMERA_LEFT).put(frame, scan="s1", trigger=0)
    bus.publisher(topics.RUN_STATE).put_json({"state": "running"}, scan="s1")
    publish(bus.publisher(topics.ECHOES), range(50))
    wait_until(lambda: len(running.records) == 52, "everything is acknowledged")
    assert running.seqs == {"cameras/left": 0, "conductor/state": 0, "array/echoes": 49}
    closed = bus.request("recorder", "close", {"scan": "s1"}, timeout_s=15)
    assert closed == {
        "path": str(path),
        "bytes": path.stat().st_size,
        "records": {"cameras/left": 1, "conductor/state": 1, "array/echoes": 50},
    }
    assert not archive.summary(path).torn
    assert sorted(triggers(path)) == list(range(50))
    (image,) = archive.read(path, {"cameras/left"})
    np.testing.assert_array_equal(image.payload, frame)
    assert bus.request("recorder", "close", {"scan": "s1"}) == closed


def test_what_was_published_before_the_archive_opened_is_in_it(running: Listener, bus: Bus) -> None:
    bus.publisher(topics.SCAN_START).put_json({"scan": "s1"}, scan="s1")
    path = Path(str(bus.request("recorder", "open", {"scan": "s1", "name": "a"})["path"]))
    wait_until(lambda: ("conductor/start", -1, 0, 0) in running.records, "the start is durable")
    bus.request("recorder", "close", {"scan": "s1"}, timeout_s=15)
    assert archive.summary(path).records == {"conductor/start": 1}


def test_other_scans_are_left_out(running: Listener, bus: Bus) -> None:
    path = Path(str(bus.request("recorder", "open", {"scan": "s1", "name": "a"})["path"]))
    publish(bus.publisher(topics.ECHOES), range(5), scan="s0")
    publish(bus.publisher(topics.ECHOES), range(5, 10))
    wait_until(lambda: len(running.records) == 5, "the scan's own are durable")
    bus.request("recorder", "close", {"scan": "s1"}, timeout_s=15)
    assert triggers(path) == [5, 6, 7, 8, 9]


def test_wrong_commands_are_refused_with_their_reason(running: Listener, bus: Bus, tmp_path: Path) -> None:
    with pytest.raises(WrongStateError, match="scan nine is not being recorded"):
        bus.request("recorder", "close", {"scan": "nine"})
    with pytest.raises(ConfigError, match=r"\$\.name: '\.\./x' is no file name"):
        bus.request("recorder", "open", {"scan": "s", "name": "../x"})
    with pytest.raises(ConfigError, match=r"\$\.scan"):
        bus.request("recorder", "open", {"name": "x"})
    (tmp_path / "taken.mcap").write_bytes(b"something of somebody")
    with pytest.raises(ArchiveError, match="exists already"):
        bus.request("recorder", "open", {"scan": "s", "name": "taken", "directory": str(tmp_path)})
    assert bus.request("recorder", "status")["archives"] == {}


def test_a_failing_disk_is_told_and_nothing_more_acknowledged(
    running: Listener, bus: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = Path(str(bus.request("recorder", "open", {"scan": "s1", "name": "a"})["path"]))
    pub = bus.publisher(topics.ECHOES)
    publish(pub, range(5))
    wait_until(lambda: len(running.records) == 5, "the first are durable")

    def fail(_: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fdatasync", fail)
    publish(pub, range(5, 10))
    wait_until(lambda: bool(running.errors), "the failure is told")
    assert "a.mcap: No space left on device" in running.errors[0]
    monkeypatch.undo()
    with pytest.raises(ArchiveError, match="No space left"):
        bus.request("recorder", "close", {"scan": "s1"}, timeout_s=15)
    assert len(running.records) == 5
    assert triggers(path)[:5] == [0, 1, 2, 3, 4]


def test_the_archive_answers_for_what_left_the_live_journal(running: Listener, bus: Bus, rig: Rig) -> None:
    frame = np.zeros((512, 512), dtype="u1")
    bus.request("recorder", "open", {"scan": "s1", "name": "a"})
    with (
        connect(rig.bus.endpoint, rig.name, journal_mib=1) as camera,
        connect(rig.bus.endpoint, rig.name) as lab,
        lab.subscribe([topics.CAMERA_LEFT], depth=2) as slow,
    ):
        pub = camera.publisher(topics.CAMERA_LEFT)
        for k in range(12):
            pub.put(frame + k, scan="s1", trigger=k)
            wait_until(lambda k=k: ("cameras/left", k, 0, k) in running.records, f"frame {k} is durable")
        found = []
        while len(found) < 12 and (message := slow.get(10.0)) is not None:
            assert message.payload[0, 0] == message.header.trigger
            found.append(message.header.trigger)
        assert found == list(range(12))
        assert slow.stats["lost"] == 0


def recorder_process(rig: Rig, directory: Path) -> subprocess.Popen[bytes]:
    settings = directory / "rig.json"
    settings.write_bytes(msgspec.json.encode(rig))
    program = (
        "import sys, msgspec, pathlib; from echolume_messages.rig import Rig; from echolume_daemon import recorder; "
        "sys.exit(recorder.main(None, msgspec.json.decode(pathlib.Path(sys.argv[1]).read_bytes(), type=Rig)))"
    )
    return subprocess.Popen([sys.executable, "-c", program, str(settings)])


def test_a_killed_recorder_loses_no_acknowledged_record_and_goes_on(rig: Rig, bus: Bus, tmp_path: Path) -> None:
    listener = Listener(bus)
    pub = bus.publisher(topics.ECHOES)
    processes = [recorder_process(rig, tmp_path)]
    try:
        wait_until(lambda: "recorder" in bus.alive(), "the recorder is alive")
        path = Path(str(bus.request("recorder", "open", {"scan": "s1", "name": "a"})["path"]))
        publish(pub, range(40))
        wait_until(lambda: len(listener.records) >= 10, "some are acknowledged")
        publish(pub, range(40, 80))
        processes[0].kill()
        processes[0].wait(10)
        acknowledged = {trigger for _, trigger, _, _ in listener.records}
        assert acknowledged <= set(triggers(path))
        publish(pub, range(80, 100))
        wait_until(lambda: "recorder" not in bus.alive(), "its end is seen")
        processes.append(recorder_process(rig, tmp_path))
        wait_until(lambda: "recorder" in bus.alive(), "the next one is alive")
        assert bus.request("recorder", "open", {"scan": "s1", "name": "a"}) == {"path": str(path)}
        wait_until(lambda: len(listener.records) == 100, "everything is acknowledged")
        start_s = time.monotonic()
        processes[1].send_signal(signal.SIGTERM)
        assert processes[1].wait(10) == 0
        assert time.monotonic() - start_s < 5
        assert sorted(triggers(path)) == list(range(100))
        assert not archive.summary(path).torn
    finally:
        for process in processes:
            process.kill()
            process.wait(10)
