"""Bad input: a clear error that names the file, the key or the device, the right exit code, and nothing lost."""

from __future__ import annotations

import io
import json
import os
import signal
import socket
import struct
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest
import zenoh

from daemon.fake_rig import FakeRecorder, free_endpoint, make_rig, wait_until
from echolume.main import main
from echolume_daemon import acquisition, array, cameras, conductor, guide, robot
from echolume_daemon.commands import scan as scan_command
from echolume_daemon.mcap_writer import ArchiveWriter
from echolume_drivers.emulated.rig import toml_text
from echolume_messages import calibration as calibration_file
from echolume_messages import codec, topics
from echolume_messages import plan as plans
from echolume_messages.bus import Bus, Message, connect
from echolume_messages.bus.router import open_router
from echolume_messages.bus.session import open_client
from echolume_messages.codec import json_array
from echolume_messages.errors import CalibrationError, EcholumeError
from echolume_messages.files import replace_bytes
from echolume_messages.header import Header, Source
from echolume_messages.rig import ArraySettings, CameraSettings, Rig
from echolume_processing import session
from messages.test_files import some_calibration

PLAN = """
name = "small"
[[pass]]
name = "light"
kind = "optical"
start_mm = -1.0
stop_mm = 1.0
pitch_mm = 1.0
[[pass]]
name = "sound"
kind = "ultrasonic"
poses = [[0, 0, 150, 0, 0, 0]]
"""
BEFORE_ANY_WORK_S = 5.0


class Shell:
    """The command line, in this process."""

    def __init__(self, folder: Path, capture: pytest.CaptureFixture[str]) -> None:
        self.folder = folder
        self._capture = capture

    def __call__(self, *arguments: str | Path) -> tuple[int, str]:
        """Exit code and what was said on stderr; never a traceback, because no exception passes."""
        try:
            code = main([str(a) for a in arguments])
        except SystemExit as stop:
            code = int(stop.code or 0)
        said = self._capture.readouterr().err
        assert "Traceback" not in said
        return code, said

    def file(self, name: str, text: str | bytes) -> Path:
        path = self.folder / name
        path.write_bytes(text.encode() if isinstance(text, str) else text)
        return path

    def rig(self, rig: Rig) -> Path:
        return self.file("rig.toml", toml_text(rig))


@pytest.fixture
def shell(tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> Shell:
    monkeypatch.delenv("ECHOLUME_RIG", raising=False)
    return Shell(tmp_path, capsys)


@pytest.fixture
def absent(tmp_path: Path) -> Rig:
    """A rig whose router and devices are not there."""
    return make_rig(free_endpoint(), tmp_path)


# -- rig file and plan


@pytest.mark.parametrize(
    ("wrong", "right", "named"),
    [
        ('[guide]\nport = "', '[guide]\nprot = "', "`$.guide`"),
        ("baud = 115200", 'baud = "fast"', "`$.guide.baud`"),
        ("baud = 115200", "baud = 0", "`$.guide.baud`"),
        ("min_mm = -150.0", "min_mm = 151.0", "not below max_mm 150.0 - at `$.guide`"),
        ("max_mm = 150.0", "max_mm = nan", "`$.guide.max_mm`"),
        ("nodes = [1,2,3,4,5,6]", "nodes = [1,2,3,4,5,5]", "the same node"),
        ("nodes = [1,2,3,4,5,6]", "nodes = [1,2,3]", "`$.robot.nodes`"),
        ('endpoint = "tcp/', 'endpoint = "', "`$.bus.endpoint`"),
        ('name = "bench"', 'name = "a/b"', "`$.name`"),
        ('name = "bench"', "", "missing required field `name`"),
        ('directory = "/', 'directory = "', "`$.recorder.directory`"),
        ("width_px = 8", "width_px = -8", "`$.cameras.left.width_px`"),
        ("samples = 1024", "samples = 0", "`$.array.samples`"),
        ("receivers_mm = [[-15.0,-15.0,0.0],", "receivers_mm = [", "`$.array.layout.receivers_mm`"),
    ],
)
def test_a_wrong_value_in_the_rig_file_is_named_by_file_and_path(
    wrong: str, right: str, named: str, shell: Shell, absent: Rig
) -> None:
    text = toml_text(absent)
    assert wrong in text
    code, said = shell("status", "--rig", shell.file("rig.toml", text.replace(wrong, right, 1)))
    assert code == 2
    assert "rig.toml: " in said
    assert named in said


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (b"", "missing required field `name`"),
        (b"{ not toml", "rig.toml: "),
        (b"\xff\xfe\x00", "byte 0 (0xff) is not UTF-8 text"),
        (None, "cannot read the rig file: No such file or directory"),
        ("folder", "cannot read the rig file: Is a directory"),
    ],
)
@pytest.mark.parametrize(
    "command",
    [("status",), ("serve", "guide"), ("process", "hybrid"), ("halt",), ("calibrate", "rig", "a", "--out", "b")],
)
def test_a_file_that_is_no_rig_file_is_refused_by_every_command(
    command: tuple[str, ...], content: bytes | str | None, named: str, shell: Shell
) -> None:
    path = shell.folder / "rig.toml"
    if content == "folder":
        path.mkdir()
    elif isinstance(content, bytes):
        path.write_bytes(content)
    code, said = shell(*command, "--rig", path)
    assert (code, named in said) == (2, True), said


@pytest.mark.parametrize(
    ("wrong", "right", "named"),
    [
        ("pitch_mm = 1.0", "pich_mm = 1.0", "`$.pass[0]`"),
        ("pitch_mm = 1.0", "", "`$.pass[0]`"),
        ("pitch_mm = 1.0", 'pitch_mm = "fine"', "`$.pass[0].pitch_mm`"),
        ("pitch_mm = 1.0", "pitch_mm = 0.0", "`$.pass[0].pitch_mm`"),
        ("pitch_mm = 1.0", "pitch_mm = nan", "`$.pass[0].pitch_mm`"),
        ("pitch_mm = 1.0", "pitch_mm = 1e-9", "at most 250000 are taken"),
        ("stop_mm = 1.0", "stop_mm = -2.0", "pass 'light': ends at -2.0 before it starts at -1.0"),
        ("stop_mm = 1.0", "stop_mm = inf", "`$.pass[0].stop_mm`"),
        ('name = "sound"', 'name = "light"', "pass names must differ: light"),
        ('name = "small"', 'name = "../small"', "`$.name`"),
        ("[[pass]]", "[map]\ncell_mm = 0.0\n[[pass]]", "`$.map.cell_mm`"),
        ("[[pass]]", "[map]\nx_mm = [5.0, -5.0]\n[[pass]]", "`$.map.x_mm`"),
        ("[[pass]]", "[map]\ncell_mm = 0.001\n[[pass]]", "`$.map`"),
        ("[[0, 0, 150, 0, 0, 0]]", "[[0, 0, 150]]", "`$.pass[1].poses[0]`"),
        (PLAN, "", "missing required field `name`"),
    ],
)
@pytest.mark.parametrize("command", ["scan", "demo"])
def test_a_wrong_plan_is_refused_by_file_and_path_before_anything_starts(
    command: str, wrong: str, right: str, named: str, shell: Shell, absent: Rig
) -> None:
    assert wrong in PLAN
    plan = shell.file("plan.toml", PLAN.replace(wrong, right, 1))
    out = shell.folder / "out"
    arguments = (plan, "--rig", shell.rig(absent)) if command == "scan" else ("--plan", plan)
    code, said = shell(command, *arguments, "--out", out)
    assert code == 2
    assert "plan.toml: " in said
    assert named in said
    assert not out.exists()


# -- what the demo and the emulated rig are asked for


@pytest.mark.parametrize("command", ["demo", "emulate"])
@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("--scene", "moon"), "moon"),
        (("--speed", "0"), "above 0"),
        (("--speed", "nan"), "above 0"),
        (("--seed", "-1"), "not be below 0"),
    ],
)
def test_what_cannot_be_emulated_is_refused_at_once_and_leaves_nothing(
    command: str, arguments: tuple[str, ...], named: str, shell: Shell
) -> None:
    began_s = time.monotonic()
    code, said = shell(command, "--out", shell.folder / "out", *arguments)
    assert (code, named in said) == (2, True), said
    assert time.monotonic() - began_s < BEFORE_ANY_WORK_S
    assert list(shell.folder.iterdir()) == []


@pytest.mark.parametrize("command", ["demo", "emulate"])
def test_a_folder_that_cannot_be_made_is_refused_at_once(command: str, shell: Shell) -> None:
    out = shell.file("file", "") / "below"
    code, said = shell(command, "--out", out)
    assert code == 2
    assert f"--out {out}: cannot make this folder: Not a directory" in said


def test_the_demo_needs_both_senses(shell: Shell) -> None:
    plan = shell.file("plan.toml", PLAN[: PLAN.index('[[pass]]\nname = "sound"')])
    code, said = shell("demo", "--plan", plan, "--out", shell.folder / "out")
    assert code == 2
    assert "an optical and an ultrasonic pass" in said


def test_an_unknown_log_level_is_named(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("ECHOLUME_LOG", "loud")
    code, said = shell("status")
    assert (code, "$ECHOLUME_LOG is 'LOUD'; known levels: CRITICAL" in said) == (2, True)


# -- the bus


def test_without_a_router_commands_say_so(shell: Shell, absent: Rig, monkeypatch: pytest.MonkeyPatch) -> None:
    from echolume_daemon.commands import options

    monkeypatch.setattr(options, "connect", lambda *a, **k: connect(*a, **k, timeout_s=0.2))
    rig, plan = shell.rig(absent), shell.file("plan.toml", PLAN)
    for command in (("status",), ("halt",), ("scan", plan)):
        code, said = shell(*command, "--rig", rig)
        assert code == 3
        assert f"no router at {absent.bus.endpoint}" in said
        assert ".rs:" not in said


def test_a_router_whose_port_is_in_use_says_so(shell: Shell, absent: Rig) -> None:
    with open_router(absent.bus.endpoint):
        code, said = shell("serve", "router", "--rig", shell.rig(absent))
    assert code == 3
    assert "is another router running, or the port in use?" in said


def test_a_wrong_rig_name_is_named(shell: Shell, absent: Rig) -> None:
    with open_router(absent.bus.endpoint):
        code, said = shell("scan", shell.file("plan.toml", PLAN), "--rig", shell.rig(absent))
    assert code == 3
    assert "is `echolume serve conductor` running on rig 'bench'" in said


# -- devices that are absent or silent


def silent_devices(rig: Rig) -> Iterator[Rig]:
    """The same rig with devices that take a connection and say nothing."""
    guide_end, guide_port = os.openpty()
    trigger_end, trigger_port = os.openpty()
    doors = [socket.create_server(("127.0.0.1", 0)) for _ in range(4)]
    left, right, bus, digitiser = (door.getsockname()[1] for door in doors)
    yield msgspec.structs.replace(
        rig,
        guide=msgspec.structs.replace(rig.guide, port=os.ttyname(guide_port)),
        trigger=msgspec.structs.replace(rig.trigger, port=os.ttyname(trigger_port)),
        cameras=msgspec.structs.replace(
            rig.cameras,
            left=CameraSettings(address=f"127.0.0.1:{left}"),
            right=CameraSettings(address=f"127.0.0.1:{right}"),
        ),
        robot=msgspec.structs.replace(rig.robot, port=bus),
        array=ArraySettings(port=f"socket://127.0.0.1:{digitiser}"),
    )
    for handle in (guide_end, guide_port, trigger_end, trigger_port):
        os.close(handle)
    for door in doors:
        door.close()


@pytest.fixture(params=["absent", "silent"])
def deaf(request: pytest.FixtureRequest, absent: Rig) -> Iterator[Rig]:
    if request.param == "absent":
        yield absent
    else:
        yield from silent_devices(absent)


def test_services_stay_up_without_their_devices_and_a_scan_names_each(
    deaf: Rig, shell: Shell, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(acquisition, "READY_S", 0.5)
    mains: dict[str, Callable[..., int]] = {
        "guide": guide.main, "cameras": cameras.main, "robot": robot.main, "array": array.main,
        "conductor": conductor.main,
    }  # fmt: skip
    stop, codes = threading.Event(), dict[str, int]()
    named = ("guide (", "trigger unit at", "camera left (", "camera right (", "robot (", "array digitiser at")
    rig = shell.rig(deaf)
    with open_router(deaf.bus.endpoint), connect(deaf.bus.endpoint, deaf.name) as bus:
        recorder = FakeRecorder(bus)

        def run(name: str) -> None:
            codes[name] = mains[name](rig=deaf, stop=stop)

        threads = [threading.Thread(target=run, args=(name,)) for name in mains]
        for thread in threads:
            thread.start()
        wait_until(lambda: set(mains) <= bus.alive(), "services alive")

        def told() -> bool:
            assert main(["status", "--rig", str(rig)]) == 5
            text = capsys.readouterr().out
            return all(name in text for name in named)

        wait_until(told, "status names every device")
        code, said = shell("scan", shell.file("plan.toml", PLAN), "--rig", rig)
        assert code == 5
        assert all(name in said for name in named), said
        assert set(mains) <= bus.alive()
        stop.set()
        for thread in threads:
            thread.join(5.0)
        recorder.close()
    assert codes == dict.fromkeys(mains, 0)


# -- calibration files


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "No such file or directory; run `echolume calibrate`"),
        (b"\xff\xfe", "not a calibration"),
        (b"not json", "not a calibration"),
        (b"{}", "missing required field `rig`"),
        ("north", "is of rig 'north', this is 'bench'"),
        ("laser", "missing required field `laser`"),
    ],
)
def test_a_calibration_that_cannot_be_used_is_named(
    content: bytes | str | None, named: str, shell: Shell, absent: Rig
) -> None:
    path = shell.folder / "calibration.json"
    if content == "north":
        calibration_file.save(some_calibration("north"), path)
    elif content == "laser":
        raw = msgspec.to_builtins(some_calibration("bench"))
        path.write_text(json.dumps({k: v for k, v in raw.items() if k != "laser"}))
    elif isinstance(content, bytes):
        path.write_bytes(content)
    rig = shell.rig(msgspec.structs.replace(absent, calibration=str(path)))
    code, said = shell("scan", shell.file("plan.toml", PLAN), "--rig", rig)
    assert code == 6
    assert "calibration.json: " in said
    assert named in said


def test_a_full_disk_leaves_the_calibration_that_was_there(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "calibration.json"
    calibration_file.save(some_calibration("before"), path)

    def full(_handle: int) -> None:
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(CalibrationError, match="No space left on device"):
        calibration_file.save(some_calibration("after"), path)
    assert calibration_file.load(path).rig == "before"
    assert list(tmp_path.iterdir()) == [path]


def test_a_file_is_replaced_as_a_whole(tmp_path: Path) -> None:
    replace_bytes(tmp_path / "f", b"one")
    replace_bytes(tmp_path / "f", b"two")
    assert (tmp_path / "f").read_bytes() == b"two"
    assert len(list(tmp_path.iterdir())) == 1


# -- archives


def record(
    topic: topics.Topic, payload: np.ndarray, seq: int, pass_name: str = "", source: Source | None = None
) -> Message:
    header = Header(
        stream=topic.name, seq=seq, t_ns=seq, t_wall_ns=seq, boot="b", scan="s", trigger=seq, pass_name=pass_name,
        source=source or Source(),
    )  # fmt: skip
    return Message(header, topic, payload)


def start(calibrated: bool) -> Message:
    held = msgspec.to_builtins(some_calibration()) if calibrated else None
    body = {"scan": "s", "plan": msgspec.to_builtins(plans.parse(PLAN)), "calibration": held, "rig": "demo"}
    return record(topics.SCAN_START, json_array(body), 0)


def written(path: Path, records: list[Message]) -> Path:
    writer = ArchiveWriter(path)
    for one in records:
        writer.write(one)
        writer.sync()  # a chunk each, so that cuts fall between and into records
    writer.close()
    return path


def frames() -> list[Message]:
    pixels = np.zeros((4, 5), dtype=np.uint8)
    pairs = [(t, k) for k in (1, 2) for t in (topics.CAMERA_LEFT, topics.CAMERA_RIGHT)]
    return [record(topic, pixels + k, k, "light", Source(x_mm=0.0)) for topic, k in pairs]


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "No such file or directory"),
        (b"name = 'a text'", "not an archive: starts with"),
        (b"", "is empty, or cut before its first whole chunk"),
        (b"\x89MCAP0\r\n", "is empty, or cut before its first whole chunk"),
        ("folder", "Is a directory"),
    ],
)
@pytest.mark.parametrize("command", [("reprocess",), ("calibrate", "laser")])
def test_what_is_no_archive_is_refused(
    command: tuple[str, ...], content: bytes | str | None, named: str, shell: Shell
) -> None:
    path = shell.folder / "raw.mcap"
    if content == "folder":
        path.mkdir()
    elif isinstance(content, bytes):
        path.write_bytes(content)
    code, said = shell(*command, path)
    if command[0] == "calibrate" and "is empty" in named:
        assert (code, "is this the archive of a calibration scan?" in said) == (6, True)
        return
    if command[0] == "calibrate" and content == "folder":
        assert (code, "needs the guide's position at each image" in said) == (2, True), said
        return
    assert (code, named in said) == (7, True), said
    assert not (shell.folder / "reprocessed").exists()


def test_an_archive_cut_anywhere_gives_what_is_there_or_says_that_nothing_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    data = written(tmp_path / "raw.mcap", [start(calibrated=False), *frames()]).read_bytes()
    monkeypatch.setattr(session, "OpticalPipeline", lambda _c: None)
    cut, seen = tmp_path / "cut.mcap", list[str]()
    for length in sorted({*range(0, len(data), 97), len(data) - 1, *range(12)}):
        cut.write_bytes(data[:length])
        with pytest.raises(EcholumeError) as refused:
            session.reprocess(cut, tmp_path / "out")
        seen.append(f"{refused.value.exit_code} {'without a calibration' in str(refused.value)}")
    assert list(dict.fromkeys(seen)) == ["7 False", "6 True"]  # first nothing, then the start of the scan


def test_an_archive_without_a_calibration_says_what_to_do(shell: Shell) -> None:
    code, said = shell("reprocess", written(shell.folder / "raw.mcap", [start(calibrated=False)]))
    assert code == 6
    assert "was made without a calibration" in said
    assert "scan again" in said


def test_records_that_cannot_be_processed_are_skipped_by_name(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, monkeypatch: pytest.MonkeyPatch
) -> None:
    class Wrong:
        def __init__(self, _calibration: object) -> None: ...

        def process(self, *_frames: object) -> None:
            raise ValueError("left frame: expected another shape")

    monkeypatch.setattr(session, "OpticalPipeline", Wrong)
    monkeypatch.setattr(session, "UltrasonicPipeline", Wrong)
    ping = record(topics.ECHOES, np.zeros((8, 16), dtype=np.int16), 3, "sound")
    path = written(tmp_path / "raw.mcap", [start(calibrated=True), *frames(), ping])
    evidence = session.gather(path)
    assert evidence.optical == {}
    assert evidence.pings == {}
    assert "trigger 1: the stripe is skipped" in caplog.text
    assert "trigger 3: the ping is skipped" in caplog.text


def test_a_folder_that_cannot_be_written_is_refused_before_the_work(shell: Shell) -> None:
    path = written(shell.folder / "raw.mcap", [start(calibrated=True)])
    code, said = shell("reprocess", path, "--out", path / "below")
    assert (code, "cannot make this folder" in said) == (2, True)


# -- strangers on the bus


def npy(array: np.ndarray, promised: tuple[int, ...]) -> bytes:
    """An NPY payload whose header promises another shape."""
    text = f"{{'descr': {array.dtype.str!r}, 'fortran_order': False, 'shape': {promised!r}, }}\n".encode()
    return codec.MAGIC + struct.pack("<H", len(text)) + text + array.tobytes()


HEADER = Header(stream="array/echoes", seq=0, t_ns=1, t_wall_ns=1, boot="stranger")
BLOCK = np.zeros((8, 4), dtype=np.int16)
LIES: dict[str, tuple[bytes, bytes | None]] = {
    "promises more than there is": (npy(BLOCK, (8, 4000)), codec.encode_header(HEADER)),
    "promises more than any memory": (npy(BLOCK, (8, 1 << 60)), codec.encode_header(HEADER)),
    "holds more than it promises": (npy(BLOCK, (8, 2)), codec.encode_header(HEADER)),
    "another number of channels": (npy(BLOCK, (4, 8)), codec.encode_header(HEADER)),
    "another type": (codec.encode(BLOCK.astype(np.float64)), codec.encode_header(HEADER)),
    "oversized": (bytes(topics.ECHOES.limit_bytes + 10_000), codec.encode_header(HEADER)),
    "no NPY": (b"hello", codec.encode_header(HEADER)),
    "empty": (b"", codec.encode_header(HEADER)),
    "header no JSON": (codec.encode(BLOCK), b"hello"),
    "header no text": (codec.encode(BLOCK), b"\xff\xfe"),
    "header of another stream": (
        codec.encode(BLOCK),
        codec.encode_header(msgspec.structs.replace(HEADER, stream="x/y")),
    ),
    "no header": (codec.encode(BLOCK), None),
}


@pytest.fixture(scope="module")
def bus_and_stranger() -> Iterator[tuple[Bus, zenoh.Session]]:
    endpoint = free_endpoint()
    with open_router(endpoint), connect(endpoint, "demo") as bus:
        stranger = open_client(endpoint, 5.0, shared_memory=False)
        yield bus, stranger
        stranger.close()


@pytest.mark.parametrize("lie", sorted(LIES))
def test_a_strangers_record_is_counted_as_rejected_and_the_next_one_is_received(
    lie: str, bus_and_stranger: tuple[Bus, zenoh.Session]
) -> None:
    bus, stranger = bus_and_stranger
    payload, header = LIES[lie]
    with bus.subscribe([topics.ECHOES], refill=False) as echoes:
        key = topics.key("demo", "data", topics.ECHOES, 0)
        stranger.put(key, payload, encoding=codec.ENCODING, attachment=header)
        wait_until(lambda: echoes.stats["rejected"] == 1, "the lie is rejected")
        assert echoes.last_error
        bus.publisher(topics.ECHOES).put(BLOCK, trigger=0)
        message = echoes.get(5.0)
    assert message is not None
    assert message.header.boot != "stranger"


@pytest.mark.parametrize("text", [b"[1, 2]", b"7", b"nonsense", b""])
def test_a_json_topic_takes_objects_only(text: bytes, bus_and_stranger: tuple[Bus, zenoh.Session]) -> None:
    bus, stranger = bus_and_stranger
    header = codec.encode_header(msgspec.structs.replace(HEADER, stream=topics.LEDGER.name))
    with bus.subscribe([topics.LEDGER], refill=False) as ledgers:
        payload = codec.encode(np.frombuffer(text, dtype=np.uint8))
        stranger.put(topics.key("demo", "data", topics.LEDGER), payload, encoding=codec.ENCODING, attachment=header)
        wait_until(lambda: ledgers.stats["rejected"] == 1, "it is rejected")


# -- calibrating and localising from the wrong things


@pytest.mark.parametrize(
    ("sizes", "pattern", "code", "named"),
    [
        ({}, "9x6", 2, "no images named leftNN"),
        ({"left00": (60, 80)}, "9x6", 2, "right00.png: missing; left00.png has no partner"),
        ({"left00": None, "right00": None}, "9x6", 2, "left00.png: not an image that can be read"),
        ({"left00": (60, 80), "right00": (60, 90)}, "9x6", 6, "images of different sizes"),
        ({"left00": (60, 80), "right00": (60, 80)}, "9x6", 6, "no 9x6 corners in the left and right image"),
        ({"left00": (60, 80), "right00": (60, 80)}, "9by6", 2, "--pattern 9by6"),
        ({"left00": (60, 80), "right00": (60, 80)}, "1x1", 2, "at least 3x3 inner corners"),
    ],
)
def test_what_is_no_set_of_board_images_is_refused(
    sizes: dict[str, tuple[int, int] | None], pattern: str, code: int, named: str, shell: Shell
) -> None:
    folder = shell.folder / "boards"
    folder.mkdir()
    for name, size in sizes.items():
        if size is None:
            (folder / f"{name}.png").write_text("text")
        else:
            cv2.imwrite(str(folder / f"{name}.png"), np.zeros(size, dtype=np.uint8))
    found, said = shell("calibrate", "cameras", folder, "--pattern", pattern)
    assert (found, named in said) == (code, True), said


@pytest.mark.parametrize(
    ("kind", "named"),
    [("rig", "passes `board-NN`"), ("laser", "passes `board-NN`"), ("array", "no pings of a pass 'plate'")],
)
def test_another_scans_archive_calibrates_nothing_and_changes_nothing(
    kind: str, named: str, shell: Shell, absent: Rig
) -> None:
    archive = written(shell.folder / "raw.mcap", [start(calibrated=False), *frames()])
    target = shell.folder / "calibration.json"
    calibration_file.save(some_calibration("bench"), target)
    before = target.read_bytes()
    option = "--out" if kind == "rig" else "--into"
    rig = () if kind == "laser" else ("--rig", shell.rig(absent))
    code, said = shell("calibrate", kind, archive, option, target, *rig)
    assert (code, named in said) == (6, True), said
    assert target.read_bytes() == before


def test_a_place_that_cannot_take_the_calibration_is_refused_before_the_work(shell: Shell, absent: Rig) -> None:
    code, said = shell(
        "calibrate", "rig", "raw.mcap", "--rig", shell.rig(absent), "--out", shell.folder / "no" / "c.json"
    )
    assert (code, "there is no folder" in said) == (2, True)


def npz(**arrays: np.ndarray) -> bytes:
    sink = io.BytesIO()
    np.savez(sink, **arrays)
    return sink.getvalue()


GOOD = {"frames": np.ones((4, 4, 40)), "background": np.ones((4, 4, 40)), "target_mm": np.ones((4, 3))}


@pytest.mark.parametrize(
    ("content", "named"),
    [
        (None, "cannot read the recordings: No such file"),
        (b"", "not an .npz of plain arrays"),
        (b"a text", "not an .npz of plain arrays"),
        (npz(**GOOD)[:900], "not an .npz of plain arrays"),
        (npz(frames=GOOD["frames"]), "background is not a file in the archive"),
        (npz(**{**GOOD, "frames": np.array([{}], dtype=object)}), "not an .npz of plain arrays"),
        (npz(**{**GOOD, "frames": np.ones((4, 3, 40))}), "expected frames and background (n, 4, samples)"),
        (npz(**{k: v[:1] for k, v in GOOD.items()}), "of 2 recordings or more"),
        (npz(**{**GOOD, "frames": np.full((4, 4, 40), np.nan)}), "expected finite numbers"),
        (npz(**{**GOOD, "frames": np.full((4, 4, 40), "x")}), "expected finite numbers"),
    ],
    ids=["none", "empty", "text", "cut", "keys", "objects", "channels", "one", "nan", "strings"],
)
def test_what_is_no_set_of_recordings_is_refused(content: bytes | None, named: str, shell: Shell) -> None:
    path = shell.folder / "echoes.npz"
    if content is not None:
        path.write_bytes(content)
    code, said = shell("localise", path)
    assert (code, named in said) == (2, True), said
    assert "pickle" not in said


# -- ends from outside


def program(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "echolume", *arguments],
        stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True,
    )  # fmt: skip


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM], ids=lambda n: n.name)
def test_a_service_that_waits_for_its_router_ends_at_once(number: signal.Signals, shell: Shell, absent: Rig) -> None:
    child = program("serve", "guide", "--rig", str(shell.rig(absent)))
    try:
        assert child.stderr is not None
        assert "waiting for the router" in child.stderr.readline()
        child.send_signal(number)
        _, said = child.communicate(timeout=5)
    finally:
        if child.poll() is None:
            child.kill()
            child.communicate()
    assert (child.returncode, "Traceback" in said) == (0, False)


@pytest.mark.parametrize("arguments", [("--help",), ("--version",)])
def test_an_output_that_nobody_reads_gives_no_traceback(arguments: tuple[str, ...]) -> None:
    read, write = os.pipe()
    os.close(read)
    done = subprocess.run(
        [sys.executable, "-m", "echolume", *arguments], stdout=write, stderr=subprocess.PIPE, text=True, check=False
    )
    os.close(write)
    assert (done.returncode, done.stderr) == (141, "")


def test_an_output_that_is_full_is_named() -> None:
    with Path("/dev/full").open("w") as full:
        done = subprocess.run(
            [sys.executable, "-m", "echolume", "--help"], stdout=full, stderr=subprocess.PIPE, text=True, check=False
        )
    assert (done.returncode, done.stderr) == (1, "echolume: the output: No space left on device\n")


def test_a_failed_scan_is_told_with_its_reason_and_its_missing_triggers_in_short() -> None:
    progress = scan_command.Progress()
    state = {"state": "fault", "pass": "light", "matched": 3, "planned": 9}
    progress.show(state | {"error": "recorder: /a/raw.mcap: No space left on device"})
    progress.show(state | {"error": ""})
    assert progress.error == "recorder: /a/raw.mcap: No space left on device"
    ledger = {"passes": {"light": {"missing_triggers": [3, 5, 6, 7]}, "sound": {"missing_triggers": []}}}
    assert scan_command.missing(ledger) == "missing triggers: light: [3, 5-7]"
