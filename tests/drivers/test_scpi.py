"""A SCPI port on each of its wires, serial line and socket: exact, binary safe, and clear about what went wrong."""

from __future__ import annotations

import socket
import threading
import time
from types import SimpleNamespace

import pytest

from echolume_drivers.emulated.scpi_peer import block
from echolume_drivers.emulated.scpi_wires import PtyWire, TcpWire
from echolume_drivers.scpi import ScpiPort
from echolume_messages.errors import DeviceAbsentError, DeviceFaultError, DeviceSilentError, ProtocolError

TIMEOUT_S = 0.25
HOSTILE = bytes(range(256)) * 3 + b"\r\n#;\n\n#0"


@pytest.fixture(autouse=True)
def sockets_close_at_once(monkeypatch):
    """pyserial sleeps 0.3 s after closing a socket."""
    monkeypatch.setattr("serial.urlhandler.protocol_socket.time", SimpleNamespace(sleep=lambda _: None))


class Scripted:
    """Answers from a table and keeps what it was told."""

    def __init__(self, wire, answers):
        self.told = []
        self._answers = answers
        self._wire = wire("scripted", self._line)
        self.url = self._wire.url
        self.late = threading.Event()
        self._wire.start()

    def _line(self, line):
        self.told.append(line)
        answer = self._answers.get(line, b"")
        if line == b"LATE?":
            self.late.wait(5)
        if isinstance(answer, list):
            answer = answer.pop(0)
        if line.startswith(b"CUT"):
            self._wire.hang_up_after_reply()
        return answer

    def close(self):
        self.late.set()
        self._wire.close()


@pytest.fixture(params=[PtyWire, TcpWire], ids=["serial", "socket"])
def wire(request):
    return request.param


@pytest.fixture
def open_port(wire):
    opened = []

    def make(answers):
        peer = Scripted(wire, answers)
        port = ScpiPort(peer.url, 115200, "test instrument", timeout_s=TIMEOUT_S)
        opened.extend([port, peer])
        port.open()
        return port, peer

    yield make
    for item in opened:
        item.close()


def test_query_returns_the_line_without_its_end(open_port):
    port, peer = open_port({b"*IDN?": b"MAKER,MODEL\r\n", b"X?": b"\n"})
    assert port.query("*IDN?") == "MAKER,MODEL"
    assert port.query("X?") == ""
    assert peer.told == [b"*IDN?", b"X?"]


@pytest.mark.parametrize("data", [b"", b"x", b"\n", HOSTILE, bytes(160_000)], ids=["0", "1", "LF", "hostile", "160k"])
def test_blocks_arrive_as_they_are(open_port, data):
    port, _ = open_port({b"D?": block(data) + b"\n", b"*IDN?": b"still in step\n"})
    assert port.query_block("D?") == data
    assert port.query("*IDN?") == "still in step"


def test_blocks_may_end_in_cr_lf(open_port):
    port, _ = open_port({b"D?": b"#13abc\r\n"})
    assert port.query_block("D?", expected_bytes=3) == b"abc"


@pytest.mark.parametrize(
    ("answer", "seen"),
    [
        (b"#0abc\n", "indefinite-length"),
        (b"#14abcd\n", "announces b'4'"),
        (b"#2x3abc\n", "announces b'x3'"),
        (b"#99999999991\n", "announces b'999999999'"),
        (b"abc\n", "b'ab"),
        (b"#13abcd\n", "b'd'"),
        (b"#:3abc\n", "b'#:"),
    ],
)
def test_a_wrong_block_is_a_protocol_error_and_the_next_query_is_in_step(open_port, answer, seen):
    port, _ = open_port({b"D?": answer, b"*IDN?": b"in step\n"})
    with pytest.raises(ProtocolError, match=r"test instrument at .*'D\?', got ") as caught:
        port.query_block("D?", expected_bytes=3)
    assert seen in str(caught.value) or "end of line" in str(caught.value)
    assert port.query("*IDN?") == "in step"


def test_a_truncated_block_is_silence_within_the_deadline(open_port):
    port, _ = open_port({b"D?": b"#3500" + bytes(200)})
    started_s = time.monotonic()
    with pytest.raises(DeviceSilentError, match="got 200 bytes by the deadline"):
        port.query_block("D?")
    assert TIMEOUT_S <= time.monotonic() - started_s < TIMEOUT_S + 1.0


def test_no_answer_is_silence_within_the_deadline(open_port):
    port, _ = open_port({})
    started_s = time.monotonic()
    with pytest.raises(DeviceSilentError, match=r"test instrument at .*expected a line of text in answer to 'X\?'"):
        port.query("X?")
    assert TIMEOUT_S <= time.monotonic() - started_s < TIMEOUT_S + 1.0


def test_a_late_answer_is_not_taken_for_the_next_one(open_port):
    port, peer = open_port({b"LATE?": b"late\n", b"*IDN?": b"mine\n"})
    with pytest.raises(DeviceSilentError):
        port.query("LATE?")
    peer.late.set()
    assert port.query("*IDN?") == "mine"


@pytest.mark.parametrize("answer", [b"\xff\xfe\n", b"x" * 6000], ids=["binary", "endless"])
def test_a_line_that_is_no_text_is_a_protocol_error(open_port, answer):
    port, _ = open_port({b"X?": answer})
    with pytest.raises(ProtocolError, match=r"expected a line of text in answer to 'X\?'"):
        port.query("X?")


def test_a_cut_wire_is_an_absent_device_and_opens_again(open_port, wire):
    port, _ = open_port({b"CUT?": b"#3500" + bytes(100), b"X?": b"back\n"})
    with pytest.raises(DeviceAbsentError, match=r"connection broke .* bytes received"):
        port.query_block("CUT?")
    assert not port.is_open
    with pytest.raises(DeviceAbsentError, match="not open"):
        port.query("X?")
    if wire is TcpWire:
        port.open()
        assert port.query("X?") == "back"


def test_the_port_is_held_exclusively(open_port):
    port, peer = open_port({b"X?": b"mine\n"})
    rival = ScpiPort(peer.url, 115200, "rival", timeout_s=TIMEOUT_S)
    with pytest.raises(DeviceAbsentError, match="no other program holds"):
        rival.open()
        rival.query("X?")
    rival.close()
    assert port.query("X?") == "mine"


def test_a_port_that_is_not_there_is_absent(tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as server:
        free = server.getsockname()[1]
    for url in (str(tmp_path / "nothing"), f"socket://127.0.0.1:{free}", "bogus://x"):
        with pytest.raises(DeviceAbsentError, match=r"thing at .*cannot open the port"):
            ScpiPort(url, 115200, "thing", timeout_s=TIMEOUT_S).open()


def test_errors_empty_the_queue(open_port):
    port, peer = open_port({b"SYST:ERR?": [b'-113,"Undefined header"\n', b'301,"Over, range"\n', b'+0,"No error"\n']})
    assert port.errors() == [(-113, "Undefined header"), (301, "Over, range")]
    assert peer.told == [b"SYST:ERR?"] * 3


def test_check_errors_names_what_was_done(open_port):
    answers = [b'-222,"Data out of range"\n'] * 9 + [b'-350,"Queue overflow"\n', b'0,""\n', b'0,""\n']
    port, _ = open_port({b"SYST:ERR?": answers})
    with pytest.raises(DeviceFaultError, match=r"configuring: .*-222.*7 more.*-350"):
        port.check_errors("configuring")
    port.check_errors("configuring")


@pytest.mark.parametrize("answer", [b"junk\n", b'-1,"for ever"\n'], ids=["junk", "endless"])
def test_an_error_queue_that_makes_no_sense_is_a_protocol_error(open_port, answer):
    port, _ = open_port({b"SYST:ERR?": answer})
    with pytest.raises(ProtocolError, match="SYST:ERR"):
        port.errors()
