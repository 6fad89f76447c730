"""The services as such: absent devices, signals, watchdog, the guard over the laser, what they import."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path

import msgspec
import pytest

from daemon.fake_rig import Bench, free_endpoint, make_rig, wait_until
from echolume_daemon import guide
from echolume_daemon.body import flag, number, pose6, text, whole
from echolume_daemon.notify import notify, watchdog_period_s
from echolume_daemon.service import Loop, Service, run_service
from echolume_messages.bus import connect
from echolume_messages.bus.router import open_router
from echolume_messages.errors import ConfigError, DeviceAbsentError
from echolume_messages.topics import SERVICES, health


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    endpoint = free_endpoint()
    with open_router(endpoint):
        yield endpoint


@pytest.fixture
def bench(tmp_path: Path, router: str) -> Iterator[Bench]:
    with Bench(tmp_path, router) as made:
        yield made


@pytest.fixture
def manager(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[socket.socket]:
    """What systemd listens on."""
    path = tmp_path / "notify"
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listener:
        listener.bind(str(path))
        listener.settimeout(5.0)
        monkeypatch.setenv("NOTIFY_SOCKET", str(path))
        yield listener


def to_toml(rig: object) -> str:
    from echolume_drivers.emulated.rig import toml_text

    return toml_text(rig)


def test_absent_devices_are_a_state_and_named(tmp_path: Path, router: str) -> None:
    with Bench(tmp_path, router) as bench:
        bench.guide = bench.robot = bench.array = None  # the real drivers, with nothing on their ports
        bench.start("guide", "robot", "array")
        for name, port in (("guide", "no-guide"), ("robot", "127.0.0.1:1"), ("array", "127.0.0.1:1")):
            wait_until(
                lambda name=name, port=port: port in str(bench.bus.request(name, "status")["devices"][name]["error"]),
                f"{name} names its port",
            )
            assert bench.bus.request(name, "status")["devices"][name]["state"] == "absent"
        with pytest.raises(DeviceAbsentError, match="no-guide"):
            bench.bus.request("guide", "expose", {"x_mm": 0.0, "exposure_s": 0.004})
        with bench.bus.subscribe([health("guide")], depth=4) as inbox:
            message = inbox.get(5.0)
        assert message is not None
        assert message.json()["devices"]["guide"]["state"] == "absent"
        bench.stop()
        assert set(bench.codes.values()) == {0}


def test_the_laser_goes_off_at_start_and_when_the_one_in_charge_vanishes(bench: Bench) -> None:
    assert bench.guide.laser
    bench.start("guide")
    wait_until(lambda: not bench.guide.laser, "laser off at start")
    wait_until(lambda: bench.bus.request("guide", "status")["in_charge"] == ["recorder"], "recorder in charge")
    bench.guide.laser = True
    bench.recorder_bus.close()
    wait_until(lambda: not bench.guide.laser, "laser off when the recorder is gone", 2.0)


def test_the_laser_goes_off_when_the_router_dies(tmp_path: Path) -> None:
    with Bench(tmp_path) as bench:
        bench.start("guide")
        wait_until(lambda: bench.bus.request("guide", "status")["in_charge"] == ["recorder"], "recorder in charge")
        bench.guide.laser = True
        bench.kill_router()
        wait_until(lambda: not bench.guide.laser, "laser off when the router is gone", 5.0)


def test_the_laser_goes_off_at_the_end(bench: Bench) -> None:
    bench.start("guide")
    wait_until(lambda: bench.bus.request("guide", "status")["devices"]["guide"]["state"] == "ok", "guide there")
    bench.guide.laser = True
    bench.stop()
    assert not bench.guide.laser
    assert bench.codes == {"guide": 0}


def test_a_service_waits_for_the_router_and_ends_when_told(tmp_path: Path) -> None:
    rig = make_rig("tcp/127.0.0.1:1", tmp_path)
    stop = threading.Event()
    codes: list[int] = []
    thread = threading.Thread(target=lambda: codes.append(guide.main(rig=rig, stop=stop)))
    thread.start()
    stop.set()
    thread.join(10.0)
    assert codes == [0]


def test_signals_end_services_with_code_0(bench: Bench, tmp_path: Path) -> None:
    path = tmp_path / "rig.toml"
    path.write_text(to_toml(bench.rig), encoding="utf-8")
    command = [sys.executable, "-m", "echolume", "serve"]
    names = ("guide", "cameras", "conductor")
    children = {n: subprocess.Popen([*command, n, "--rig", str(path)], stderr=subprocess.PIPE) for n in names}
    try:
        wait_until(lambda: set(names) <= bench.bus.alive(), "services alive")
        for child, number in zip(children.values(), (signal.SIGTERM, signal.SIGINT, signal.SIGTERM), strict=True):
            child.send_signal(number)
        ends = {name: child.communicate(timeout=5.0)[1].decode() for name, child in children.items()}
    finally:
        for child in children.values():
            if child.poll() is None:
                child.kill()
                child.wait()
    assert {name: child.returncode for name, child in children.items()} == dict.fromkeys(names, 0), ends
    assert "Traceback" not in "".join(ends.values())


def test_a_router_serves_until_told_to_stop(tmp_path: Path) -> None:
    path = tmp_path / "other.toml"
    rig = make_rig(free_endpoint(), tmp_path)
    path.write_text(to_toml(rig), encoding="utf-8")
    child = subprocess.Popen([sys.executable, "-m", "echolume", "serve", "router", "--rig", str(path)])
    try:
        with connect(rig.bus.endpoint, rig.name, timeout_s=10.0) as bus:
            wait_until(lambda: "router" in bus.alive(), "router's token")
            child.terminate()
            assert child.wait(5.0) == 0
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()


def test_a_loop_owes_an_answer_only_while_it_works() -> None:
    now = [0.0]
    loop = Loop("read", 1.0, lambda: now[0])
    assert loop.late_s == 0
    with loop.working():
        now[0] = 3.0
        assert loop.late_s == 2.0
        loop.answer(5.0)
        assert loop.late_s == 0
    now[0] = 100.0
    assert loop.late_s == 0


class HangingPart:
    """A part whose loop hangs when the test says so."""

    def __init__(self, service: Service, hang: threading.Event, free: threading.Event) -> None:
        self.service, self.hang, self.free = service, hang, free
        service.thread("work", self.work, 0.05)

    def work(self, _loop: Loop) -> None:
        if self.hang.is_set():
            self.free.wait(10.0)
        self.service.stop.wait(0.01)

    def health(self) -> dict[str, object]:
        return {}

    def close(self) -> None:
        self.free.set()


def test_the_watchdog_is_stroked_only_while_every_loop_answers(
    bench: Bench, manager: socket.socket, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "100000")
    hang, free, stop = threading.Event(), threading.Event(), threading.Event()
    codes: list[int] = []
    thread = threading.Thread(
        target=lambda: codes.append(
            run_service("guide", lambda s: HangingPart(s, hang, free), bench.bus, bench.rig, stop)
        )
    )
    thread.start()
    assert b"READY=1" in manager.recv(200)
    assert manager.recv(200) == b"WATCHDOG=1"
    assert manager.recv(200) == b"WATCHDOG=1"
    hang.set()
    manager.settimeout(0.5)
    with pytest.raises(TimeoutError):
        for _ in range(20):
            assert manager.recv(200) == b"WATCHDOG=1"
    hang.clear()
    free.set()
    manager.settimeout(5.0)
    assert manager.recv(200) == b"WATCHDOG=1"
    stop.set()
    thread.join(5.0)
    assert codes == [0]


def test_a_loop_that_dies_ends_the_service_with_code_1(bench: Bench, caplog: pytest.LogCaptureFixture) -> None:
    class Broken(HangingPart):
        def work(self, _loop: Loop) -> None:
            raise RuntimeError("loop died")

    never = threading.Event()
    assert run_service("guide", lambda s: Broken(s, never, never), bench.bus, bench.rig, threading.Event()) == 1
    assert "loop died" in caplog.text


def test_nobody_is_notified_without_a_manager(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("NOTIFY_SOCKET", raising=False)
    assert not notify("READY=1")


def test_the_watchdog_of_another_process_is_not_ours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("WATCHDOG_USEC", "2000000")
    monkeypatch.setenv("WATCHDOG_PID", str(os.getpid()))
    assert watchdog_period_s() == 1.0
    monkeypatch.setenv("WATCHDOG_PID", "1")
    assert watchdog_period_s() is None


def test_services_import_no_heavy_library() -> None:
    drivers = "import echolume_drivers.grbl, echolume_drivers.trigger, echolume_drivers.array, echolume_drivers.robot"
    services = ", ".join(f"echolume_daemon.{name}" for name in SERVICES)
    code = f"import {services}; {drivers}; from echolume_drivers.cameras import emulated"
    found = subprocess.run(
        [sys.executable, "-X", "importtime", "-c", code], capture_output=True, text=True, timeout=60, check=True
    )
    modules = {line.rsplit("|", 1)[-1].strip().split(".")[0] for line in found.stderr.splitlines()}
    assert not modules & {"scipy", "numba", "cv2", "rerun", "matplotlib"}


@pytest.mark.parametrize(
    ("read", "value", "message"),
    [
        (number, "3", r"\$\.k: expected a finite number, got '3'"),
        (number, float("nan"), "finite"),
        (number, True, "finite"),
        (whole, 1.5, r"\$\.k: expected an integer, got 1\.5"),
        (text, 7, r"\$\.k: expected a string, got 7"),
        (flag, 1, r"\$\.k: expected true or false, got 1"),
        (pose6, [0, 0, 0], "expected six numbers"),
        (pose6, [0, 0, "a", 0, 0, 0], r"\$\.k\[2\]"),
    ],
)
def test_a_wrong_field_of_a_command_is_named(read: object, value: object, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        read({"k": value}, "k")


def test_a_wrong_command_body_comes_back_as_config_error(bench: Bench) -> None:
    bench.start("guide")
    with pytest.raises(ConfigError, match=r"\$\.x_mm"):
        bench.bus.request("guide", "move", {"x_mm": "far"})


def test_a_rig_file_can_be_written_and_read_back(tmp_path: Path) -> None:
    rig = make_rig("tcp/127.0.0.1:7447", tmp_path)
    assert msgspec.toml.decode(to_toml(rig), type=type(rig)) == rig
