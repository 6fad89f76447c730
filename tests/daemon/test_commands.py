"""The operator's commands, against the real services around fake devices."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from daemon.fake_rig import Bench, wait_until
from echolume_drivers.emulated.rig import toml_text

SNAPS = """
name = "boards"
[[pass]]
name = "board-00"
kind = "snap"
prompt = "place board 0"
"""
ENDLESS = """
name = "endless"
[[pass]]
name = "light"
kind = "optical"
start_mm = -100.0
stop_mm = 100.0
pitch_mm = 0.02
"""


class Desk:
    """A terminal of the operator."""

    def __init__(self, folder: Path, bench: Bench) -> None:
        self.folder = folder
        self.rig = folder / "rig.toml"
        self.rig.write_text(toml_text(bench.rig), encoding="utf-8")

    def plan(self, text: str) -> str:
        path = self.folder / "plan.toml"
        path.write_text(text, encoding="utf-8")
        return str(path)

    def open(self, *arguments: str) -> subprocess.Popen[str]:
        pipe = subprocess.PIPE
        command = [sys.executable, "-m", "echolume", *arguments, "--rig", str(self.rig)]
        return subprocess.Popen(command, stdin=pipe, stdout=pipe, stderr=pipe, text=True)

    def run(self, *arguments: str, typed: str = "") -> tuple[int, str, str]:
        child = self.open(*arguments)
        try:
            out, err = child.communicate(typed, timeout=30)
        finally:
            if child.poll() is None:
                child.kill()
                child.wait()
        return child.returncode, out, err


@pytest.fixture(scope="module")
def bench(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bench]:
    with Bench(tmp_path_factory.mktemp("bench")) as made:
        made.start()
        yield made


@pytest.fixture
def desk(tmp_path: Path, bench: Bench) -> Desk:
    return Desk(tmp_path, bench)


def idle(bench: Bench) -> bool:
    return bench.bus.request("conductor", "scan.status")["state"] == "idle"


def test_enter_answers_a_prompt(desk: Desk) -> None:
    code, out, err = desk.run("scan", desk.plan(SNAPS), "--json", typed="\n")
    assert code == 0, err
    assert "place board 0" in err
    assert json.loads(out)["passes"]["board-00"]["matched"] == 1


def test_a_prompt_that_nobody_can_answer_aborts(desk: Desk) -> None:
    code, out, err = desk.run("scan", desk.plan(SNAPS), typed="")
    assert code == 8
    assert "nobody is there to answer" in err
    assert "outcome: aborted" in out


def test_ctrl_c_aborts_in_good_order_and_others_can_pause_and_resume(desk: Desk, bench: Bench) -> None:
    child = desk.open("scan", desk.plan(ENDLESS))
    try:
        wait_until(lambda: bench.bus.request("conductor", "scan.status")["matched"] > 3, "the scan runs")
        assert desk.run("pause")[:2] == (0, "paused\n")
        assert desk.run("resume")[:2] == (0, "running\n")
        code, _, err = desk.run("pause", "--holder", "bob@lab")
        assert code == 4
        assert "commands the rig" in err
        child.send_signal(signal.SIGINT)
        out, err = child.communicate(timeout=20)
    finally:
        if child.poll() is None:
            child.kill()
            child.wait()
    assert child.returncode == 8, err
    assert "outcome: aborted" in out
    assert "missing triggers" in err
    assert idle(bench)


def test_halt_is_taken_at_any_time(desk: Desk, bench: Bench) -> None:
    before = bench.robot.stopped
    assert desk.run("halt", "--holder", "bob@lab")[:2] == (0, "idle\n")
    assert bench.robot.stopped == before + 1


def test_orders_that_do_not_fit_say_what_does(desk: Desk) -> None:
    code, _, err = desk.run("abort")
    assert code == 4
    assert "cannot abort while idle; commands taken now: start" in err


def test_status_lists_what_is_not_running(desk: Desk) -> None:
    code, out, _ = desk.run("status")
    assert code == 5
    assert "router     not running" in out
    found = json.loads(desk.run("status", "--json")[1])
    assert found["services"]["guide"]["devices"]["guide"]["state"] == "ok"


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (("scan", "/no/such/plan.toml"), 2, "cannot read the plan"),
        (("serve", "toaster"), 2, "invalid choice: 'toaster'"),
    ],
)
def test_wrong_arguments_are_named(desk: Desk, arguments: tuple[str, ...], code: int, words: str) -> None:
    found, _, err = desk.run(*arguments)
    assert found == code
    assert words in err
