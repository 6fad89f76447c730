"""The whole system on the emulated rig, as a user starts it; and what it leaves behind when it is stopped."""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import psutil
import pytest

from echolume_messages.types import Label


@dataclass(frozen=True)
class Run:
    """A finished demo."""

    out: Path
    code: int
    stdout: str
    stderr: str


def command(out: Path) -> list[str]:
    return [sys.executable, "-m", "echolume", "demo", "--out", str(out), "--seed", "3"]


def of_demo(out: Path) -> list[psutil.Process]:
    found: list[psutil.Process] = []
    for process in psutil.process_iter(["cmdline"]):
        if str(out) in " ".join(process.info["cmdline"] or []) and process.pid != os.getpid():
            found.append(process)
    return found


def shared_memory() -> set[str]:
    return {path.name for path in Path("/dev/shm").iterdir()}


@pytest.fixture(scope="module")
def finished(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Run]:
    out = tmp_path_factory.mktemp("demo")
    before = shared_memory()
    done = subprocess.run(command(out), capture_output=True, text=True, timeout=420, check=False)
    assert shared_memory() <= before
    yield Run(out, done.returncode, done.stdout, done.stderr)
    (out / "raw.mcap").unlink(missing_ok=True)
    (out / "calibration.mcap").unlink(missing_ok=True)


@pytest.mark.timeout(450)  # the first demo of a clone compiles all kernels
def test_the_demo_succeeds_and_shows_a_table(finished: Run) -> None:
    assert finished.code == 0, finished.stderr
    assert re.search(r"^  hybrid ", finished.stdout, re.MULTILINE)


def test_it_leaves_every_promised_file(finished: Run) -> None:
    names = ("raw.mcap", "hybrid.rrd", "hybrid.ply", "calibration.json", "report.json")
    assert all((finished.out / name).stat().st_size > 0 for name in names)
    assert len(list((finished.out / "figures").glob("*.png"))) >= 4


def test_the_ledger_closes_and_the_archive_is_whole(finished: Run) -> None:
    report = json.loads((finished.out / "report.json").read_text(encoding="utf-8"))
    for row, planned in (("optical", 210), ("ultrasonic", 441)):
        assert report["ledger"][row] == {
            "planned": planned, "fired": planned, "matched": planned, "missing": 0, "duplicate": 0, "extra": 0,
        }  # fmt: skip
    assert report["archive"]["found"] >= report["archive"]["acknowledged"] >= 2 * 210 + 441


def test_the_hybrid_map_finds_the_glass_and_beats_each_sense(finished: Run) -> None:
    maps = json.loads((finished.out / "report.json").read_text(encoding="utf-8"))["maps"]
    for other in ("optical", "ultrasonic", "union"):
        assert maps["hybrid"]["f1_at_1mm"] > maps[other]["f1_at_1mm"]
    assert maps["hybrid"]["f1_at_1mm"] >= 0.90
    assert maps["hybrid"]["glass_precision"] >= 0.75
    assert maps["hybrid"]["glass_recall"] >= 0.5


@pytest.mark.timeout(200)
def test_reprocessing_the_archive_gives_the_same_digest(finished: Run, tmp_path: Path) -> None:
    report = json.loads((finished.out / "report.json").read_text(encoding="utf-8"))
    done = subprocess.run(
        [sys.executable, "-m", "echolume", "reprocess", str(finished.out / "raw.mcap"), "--out", str(tmp_path),
         "--json"],
        capture_output=True, text=True, timeout=180, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert json.loads(done.stdout)["digest"]["hybrid"] == report["digest"]["hybrid"]


def test_every_cell_that_is_claimed_names_its_source(finished: Run) -> None:
    with np.load(finished.out / "map.npz") as maps:
        claimed = np.isfinite(maps["front_mm"])
        assert (maps["provenance"][claimed] != 0).all()
        assert (maps["label"][~claimed] == Label.UNKNOWN).all()


def test_nothing_stays_behind(finished: Run) -> None:
    assert of_demo(finished.out) == []
    assert not (finished.out / "rig" / "rig.toml").exists()


@pytest.mark.timeout(150)
@pytest.mark.parametrize(("number", "code"), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_a_demo_that_is_stopped_leaves_nothing_behind(number: signal.Signals, code: int, tmp_path: Path) -> None:
    before = shared_memory()
    with subprocess.Popen(command(tmp_path), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True) as demo:
        assert demo.stderr is not None
        for line in demo.stderr:
            if "laser-" in line or "board-" in line:
                break
        endpoint = re.search(r"tcp/127\.0\.0\.1:(\d+)", (tmp_path / "rig" / "rig.toml").read_text(encoding="utf-8"))
        children = of_demo(tmp_path)
        assert len(children) >= 8
        demo.send_signal(number)
        demo.communicate(timeout=60)
    assert demo.returncode == code
    assert endpoint is not None
    deadline = time.monotonic() + 5
    while of_demo(tmp_path) and time.monotonic() < deadline:
        psutil.wait_procs(of_demo(tmp_path), timeout=0.5)
    assert of_demo(tmp_path) == []
    assert shared_memory() <= before
    with socket.socket() as port:
        port.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        port.bind(("127.0.0.1", int(endpoint[1])))
    assert "left the laser off" in (tmp_path / "logs" / "emulated-rig.log").read_text(encoding="utf-8")
