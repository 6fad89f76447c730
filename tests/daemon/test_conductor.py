"""The conductor, with the real services around fake devices, on a real bus on loopback."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.fake_rig import Bench, free_endpoint, wait_until
from echolume_daemon.client import ScanClient
from echolume_messages.bus.router import open_router
from echolume_messages.errors import (
    CalibrationMissingError,
    ConfigError,
    DeviceAbsentError,
    LeaseHeldError,
    NoReplyError,
    WrongStateError,
)

LIGHT = """
[[pass]]
name = "light"
kind = "optical"
start_mm = -3.0
stop_mm = 4.0
pitch_mm = 1.0
"""
SOUND = """
[[pass]]
name = "sound"
kind = "ultrasonic"
x_mm = [-10.0, 10.0]
y_mm = [0.0, 10.0]
pitch_mm = 10.0
height_mm = 150.0
"""
PLAN = f'name = "small"\n{LIGHT}{SOUND}'


@pytest.fixture(scope="module")
def router() -> Iterator[str]:
    endpoint = free_endpoint()
    with open_router(endpoint):
        yield endpoint


@pytest.fixture
def bench(tmp_path: Path, router: str) -> Iterator[Bench]:
    with Bench(tmp_path, router) as made:
        yield made


def test_a_scan_matches_every_trigger(bench: Bench) -> None:
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    states: list[dict] = []
    scan = client.start(PLAN, archive="/archive/raw.mcap")
    ledger = client.wait(states.append)
    assert (ledger["scan"], ledger["outcome"], ledger["final"]) == (scan, "complete", True)
    assert ledger["acknowledged"] == 8 * 2 + 6
    for name, count in (("light", 8), ("sound", 6)):
        entry = ledger["passes"][name]
        assert (entry["planned"], entry["fired"], entry["matched"]) == (count, count, count)
        assert (entry["missing"], entry["duplicate"], entry["extra"]) == (0, 0, 0)
    assert ledger["triggers"] == {"light": list(range(8)), "sound": list(range(8, 14))}
    assert bench.guide.exposed == [float(x) for x in range(-3, 5)]
    assert not bench.guide.laser
    assert bench.frames_are_where_they_were_taken()
    assert bench.recorder.opened == [{"scan": scan, "name": "raw", "directory": "/archive"}]
    assert bench.recorder.closed == [scan]
    assert bench.recorder.kept[0][0] == "conductor/start"
    assert {s["pass"] for s in states} >= {"light", "sound"}


def test_a_dropped_frame_is_named_and_acquired_again(bench: Bench) -> None:
    bench.left.drop = {3}
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "small"\n{LIGHT}')
    ledger = client.wait()
    entry = ledger["passes"]["light"]
    assert ledger["outcome"] == "complete"
    assert (entry["planned"], entry["fired"], entry["matched"], entry["missing"]) == (8, 9, 8, 0)
    assert entry["records"]["missing"] == 1
    assert ledger["attempts"] == {"2": 1}
    assert bench.frames_are_where_they_were_taken()
    assert bench.recorder.frames["cameras/left", 3, 0][0, 0] == 4
    assert bench.recorder.frames["cameras/right", 3, 0][0, 0] == 4


def test_what_stays_missing_is_named(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echolume_daemon.acquisition.DRAIN_S", 0.5)
    bench.recorder.deaf = {("array/echoes", 2, attempt) for attempt in range(3)}
    bench.start("robot", "array", "conductor")
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "small"\nmax_attempts = 1\n{SOUND}')
    ledger = client.wait()
    assert ledger["outcome"] == "incomplete"
    assert ledger["passes"]["sound"]["missing_triggers"] == [2]


def test_a_doubled_frame_is_counted_and_not_published(bench: Bench) -> None:
    bench.right.twice = {2}
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "small"\n{LIGHT}')
    ledger = client.wait()
    entry = ledger["passes"]["light"]
    assert (ledger["outcome"], entry["fired"], entry["duplicate"], entry["extra"]) == ("complete", 8, 1, 0)


def test_prompts_pause_the_scan_until_resumed(bench: Bench) -> None:
    bench.start("cameras", "conductor")
    client = ScanClient(bench.bus, "ann@lab")
    text = "".join(
        f'[[pass]]\nname = "{n}"\nkind = "snap"\nprompt = "place {n}"\nframes = 2\n' for n in ("board-00", "board-01")
    )
    client.start(f'name = "boards"\n{text}')
    seen: list[tuple[str, int]] = []
    ledger = client.wait(on_prompt=lambda prompt: seen.append((prompt, bench.trigger.pulses)))
    assert seen == [("place board-00", 0), ("place board-01", 2)]
    assert ledger["outcome"] == "complete"


def test_pause_holds_at_a_trigger_boundary_and_resume_goes_on(bench: Bench) -> None:
    reached, go_on = threading.Event(), threading.Event()

    def hold(x_mm: float) -> None:
        if x_mm == 0.0:
            reached.set()
            go_on.wait(10.0)

    bench.guide.on_expose = hold
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "small"\n{LIGHT}')
    assert reached.wait(10.0)
    assert client.command("pause")["state"] == "paused"
    go_on.set()
    wait_until(lambda: bench.guide.exposed[-1:] == [0.0], "the exposure under way ends")
    with pytest.raises(WrongStateError, match="cannot pause while paused"):
        client.command("pause")
    assert bench.guide.exposed[-1] == 0.0
    client.command("resume")
    assert client.wait()["outcome"] == "complete"


def test_abort_ends_in_good_order(bench: Bench) -> None:
    reached = threading.Event()
    bench.guide.on_expose = lambda x_mm: reached.set() if x_mm >= 0 else None
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "long"\n{LIGHT.replace("4.0", "400.0")}')
    assert reached.wait(10.0)
    client.command("abort")
    ledger = client.wait()
    assert ledger["outcome"] == "aborted"
    assert 0 < ledger["passes"]["light"]["matched"] < 400
    assert bench.recorder.closed == [ledger["scan"]]
    assert client.status()["state"] == "idle"


def test_halt_needs_no_lease_and_stops_everything(bench: Bench) -> None:
    reached = threading.Event()
    bench.guide.on_expose = lambda x_mm: reached.set() if x_mm >= 0 else None
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "long"\n{LIGHT.replace("4.0", "400.0")}{SOUND}')
    assert reached.wait(10.0)
    stranger = ScanClient(bench.bus, "bob@lab")
    with pytest.raises(LeaseHeldError, match="ann@lab"):
        stranger.command("abort")
    stranger.command("halt")
    assert bench.trigger.armed_s is None
    assert bench.robot.stopped == 1
    assert client.wait()["outcome"] == "aborted"
    assert not bench.guide.laser


def test_a_device_that_dies_in_mid_scan_names_itself(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echolume_daemon.acquisition.READY_S", 0.5)

    def die(x_mm: float) -> None:
        if x_mm == 0.0:
            bench.guide.gone = True
            bench.guide._here()

    bench.guide.on_expose = die
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "small"\n{LIGHT}')
    ledger = client.wait()
    assert ledger["outcome"] == "failed"
    assert "guide at /dev/none" in client.status()["error"]
    assert ledger["passes"]["light"]["missing_triggers"] == [3, 4, 5, 6, 7]


def test_a_device_that_comes_back_loses_only_its_trigger(bench: Bench) -> None:
    stumbled = threading.Event()

    def stumble(x_mm: float) -> None:
        if x_mm == 0.0 and not stumbled.is_set():
            stumbled.set()
            raise DeviceAbsentError("guide at /dev/none: cable pulled")

    bench.guide.on_expose = stumble
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "small"\n{LIGHT}')
    ledger = client.wait()
    assert ledger["outcome"] == "complete"
    assert ledger["attempts"] == {"3": 1}


def test_a_scan_is_refused_with_the_reason(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echolume_daemon.acquisition.READY_S", 0.3)
    bench.array.gone = True
    bench.start("robot", "array", "conductor")
    client = ScanClient(bench.bus, "ann@lab")
    with pytest.raises(ConfigError, match=r"pitch_mn.*\$\.pass\[0\]"):
        client.start(f'name = "small"\n{SOUND.replace("pitch_mm", "pitch_mn")}')
    with pytest.raises(NoReplyError, match="not running: cameras, guide;"):
        client.start(PLAN)
    with pytest.raises(DeviceAbsentError, match=r"array at socket://127\.0\.0\.1:1: connection refused"):
        client.start(f'name = "small"\n{SOUND}')
    with pytest.raises(CalibrationMissingError, match="calibration"):
        client.start(f'name = "small"\n{SOUND}', calibration={"rig": "another"})
    assert client.status()["state"] == "idle"
    bench.array.gone = False
    wait_until(lambda: bench.bus.request("array", "status")["devices"]["array"]["state"] == "ok", "array back")
    client.start(f'name = "small"\n{SOUND}')
    with pytest.raises(WrongStateError, match="cannot start while"):
        client.start(f'name = "small"\n{SOUND}')
    assert client.wait()["outcome"] == "complete"


def test_stopping_the_services_in_mid_scan_ends_them_all_with_code_0(bench: Bench) -> None:
    reached = threading.Event()
    bench.guide.on_expose = lambda x_mm: reached.set() if x_mm >= 0 else None
    bench.start()
    ScanClient(bench.bus, "ann@lab").start(f'name = "long"\n{LIGHT.replace("4.0", "400.0")}')
    assert reached.wait(10.0)
    bench.stop()
    assert bench.codes == dict.fromkeys(("guide", "cameras", "robot", "array", "conductor"), 0)
    assert not bench.guide.laser


def test_a_camera_that_delivers_nothing_any_more_ends_the_scan(bench: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echolume_daemon.cameras.FRAME_TIMEOUT_S", 0.1)
    bench.left.drop = set(range(4, 1000))
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "long"\n{LIGHT.replace("4.0", "400.0")}')
    ledger = client.wait()
    assert ledger["outcome"] == "failed"
    assert "cameras/left: nothing came for the last" in client.status()["error"]
    assert len(bench.guide.exposed) < 100
    assert ledger["passes"]["light"]["matched"] == 3


def test_a_failing_disk_ends_the_scan_with_the_recorders_words(bench: Bench) -> None:
    reached = threading.Event()
    bench.guide.on_expose = lambda x_mm: reached.set() if x_mm >= 0 else None
    bench.start()
    client = ScanClient(bench.bus, "ann@lab")
    scan = client.start(f'name = "long"\n{LIGHT.replace("4.0", "400.0")}')
    assert reached.wait(10.0)
    bench.recorder.tell({"scan": scan, "durable": {}, "records": [], "count": 0, "error": "raw.mcap: disk full"})
    assert client.wait()["outcome"] == "failed"
    assert client.status()["error"] == "recorder: raw.mcap: disk full"


def test_what_a_restarted_recorder_says_again_is_no_duplicate(bench: Bench) -> None:
    bench.start("robot", "array", "conductor")
    bench.recorder.echo = True
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "small"\n{SOUND}')
    ledger = client.wait()
    assert ledger["passes"]["sound"]["duplicate"] == 0
    assert ledger["acknowledged"] == 6


def arm(bench: Bench, trigger: int, x_mm: float) -> None:
    """Arm as the conductor does."""
    body = {"trigger": trigger, "pass": "light", "attempt": 0, "exposure_s": 0.004, "external": True}
    bench.bus.request("cameras", "arm", body | {"x_mm": x_mm, "sigma_mm": 0.01, "laser_on": True})


def test_a_trigger_that_was_armed_and_never_fired_shifts_nobody(bench: Bench) -> None:
    bench.start("guide", "cameras")
    wait_until(lambda: bench.guide.homed or not bench.bus.request("guide", "home"), "guide homed")
    bench.bus.request("cameras", "begin", {"scan": "s", "calibration": ""})
    for trigger in range(12):
        arm(bench, trigger, float(trigger))
        if trigger not in (3, 7, 8):
            bench.bus.request("guide", "expose", {"x_mm": float(trigger), "exposure_s": 0.004})
    wait_until(lambda: len(bench.recorder.frames) == 18, "all frames recorded")
    assert bench.frames_are_where_they_were_taken()
    missing = bench.bus.request("cameras", "status")["missing"]
    assert {trigger for _, trigger, _ in missing} == {3, 7, 8}


def test_a_pulse_that_nobody_asked_for_puts_its_neighbour_in_doubt(bench: Bench) -> None:
    bench.start("guide", "cameras")
    wait_until(lambda: bench.guide.homed or not bench.bus.request("guide", "home"), "guide homed")
    bench.bus.request("cameras", "begin", {"scan": "s", "calibration": ""})
    for trigger in range(6):
        arm(bench, trigger, float(trigger))
        if trigger == 2:
            bench.trigger.pulse(0.004)
        bench.bus.request("guide", "expose", {"x_mm": float(trigger), "exposure_s": 0.004})
    wait_until(lambda: ("cameras/right", 5, 0) in bench.recorder.frames, "the last frame recorded")
    status = bench.bus.request("cameras", "status")
    assert {(topic, trigger) for topic, trigger, _ in status["revoked"]} == {("cameras/left", 2), ("cameras/right", 2)}
    assert bench.trigger.fired_at[int(bench.recorder.frames["cameras/left", 5, 0][0, 0])] == 5.0


def test_a_scan_that_begins_while_frames_of_the_one_before_are_awaited_gets_only_its_own(bench: Bench) -> None:
    bench.start()
    wait_until(lambda: bench.guide.homed or not bench.bus.request("guide", "home"), "guide homed")
    bench.bus.request("cameras", "begin", {"scan": "before", "calibration": ""})
    arm(bench, 0, 77.0)
    client = ScanClient(bench.bus, "ann@lab")
    client.start(f'name = "small"\n{LIGHT}')
    entry = client.wait()["passes"]["light"]
    assert (entry["fired"], entry["matched"], entry["extra"], entry["duplicate"]) == (8, 8, 0, 0)
    assert bench.frames_are_where_they_were_taken()
