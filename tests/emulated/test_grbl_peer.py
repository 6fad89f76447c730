"""The emulated board at the level of bytes: what a terminal on its port would see."""

from __future__ import annotations

import os
import select
import threading
import time
import tty
from collections.abc import Iterator

import pytest

from echolume_drivers.emulated.grbl_peer import GrblPeer
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stage import Stage


class Terminal:
    """Raw bytes on the board's port."""

    def __init__(self, peer: GrblPeer, stage: Stage) -> None:
        self.peer, self.stage = peer, stage
        self.edges: list[tuple[float, bool]] = []
        self.edge = threading.Condition()
        stage.watch_laser(self._note)
        self.fd = os.open(peer.url, os.O_RDWR | os.O_NOCTTY)
        tty.setraw(self.fd)
        self.seen = b""

    def _note(self, on: bool) -> None:
        with self.edge:
            self.edges.append((time.monotonic(), on))
            self.edge.notify_all()

    def until(self, end: bytes, timeout_s: float = 5.0) -> bytes:
        deadline_s = time.monotonic() + timeout_s
        while end not in self.seen:
            left_s = deadline_s - time.monotonic()
            assert left_s > 0 and select.select([self.fd], [], [], left_s)[0], f"{end!r} did not come: {self.seen!r}"
            self.seen += os.read(self.fd, 4096)
        head, _, self.seen = self.seen.partition(end)
        return head + end

    def say(self, data: bytes, end: bytes = b"ok\r\n") -> bytes:
        os.write(self.fd, data)
        return self.until(end)

    def wait_laser(self, on: bool, timeout_s: float = 3.0) -> float:
        with self.edge:
            assert self.edge.wait_for(lambda: self.stage.laser_on is on, timeout_s), f"laser did not go {on}"
        return time.monotonic()

    def home(self) -> None:
        self.until(b"unlock]\r\n")
        self.say(b"$H\n")


def make(speed: float, **kwargs: object) -> Iterator[Terminal]:
    stage = Stage(seed=1, scene=plate(), speed=speed)
    peer = GrblPeer(stage, **kwargs)
    peer.start()
    terminal = Terminal(peer, stage)
    try:
        yield terminal
    finally:
        os.close(terminal.fd)
        peer.close()
        assert not stage.laser_on


@pytest.fixture
def fast() -> Iterator[Terminal]:
    yield from make(50.0)


@pytest.fixture
def slow() -> Iterator[Terminal]:
    """Speed 1, but homed already: safety deadlines are real time."""
    for terminal in make(1.0):
        terminal.peer.machine.settings[25] = 30000.0
        yield terminal


@pytest.fixture
def bare() -> Iterator[Terminal]:
    yield from make(50.0, bare=True)


def test_transcript_of_a_session(fast: Terminal) -> None:
    assert fast.until(b"unlock]\r\n") == b"\r\nGrbl 1.1h ['$' for help]\r\n[MSG:'$H'|'$X' to unlock]\r\n"
    assert fast.say(b"G0 X1\n", b"\r\n") == b"error:9\r\n"  # locked until homed
    assert fast.say(b"?", b"\r\n").startswith(b"<Alarm|MPos:0.000,")
    assert fast.say(b"$H\n") == b"ok\r\n"
    assert fast.say(b"?", b"\r\n").startswith(b"<Idle|MPos:150.000,")  # switch at 156, pull-off 6
    assert b"$32=1\r\n" in fast.say(b"$$\n")  # laser mode
    assert fast.say(b"$I\n").startswith(b"[VER:1.1h")
    assert fast.say(b"$#\n").startswith(b"[G54:0.000")
    assert fast.say(b"$G\n").startswith(b"[GC:G0 G54 G17 G21 G90 G94 M5")
    assert fast.say(b"$99=1\n", b"\r\n") == b"error:3\r\n"
    assert fast.say(b"bad\n", b"\r\n") == b"error:2\r\n"
    assert fast.say(b"G1 X1 F0\n", b"\r\n") == b"error:22\r\n"  # no feed yet
    assert fast.say(b"X" + b"0" * 90 + b"\n", b"\r\n") == b"error:11\r\n"
    for line in (b"G91 G21\n", b"G1 X-10 F6000\n", b"G4 P0.01\n"):
        assert fast.say(line) == b"ok\r\n"
    assert fast.stage.guide_x_mm() == pytest.approx(140.0)
    assert fast.say(b"$J=G90 X100 F6000\n") == b"ok\r\n"
    assert fast.say(b"$J=G90 X900 F6000\n", b"\r\n") == b"error:15\r\n"


def test_ok_means_queued_and_a_dwell_is_the_barrier(slow: Terminal) -> None:
    slow.home()
    begin_s = time.monotonic()
    slow.say(b"G90 G1 X130 F6000\n")
    assert time.monotonic() - begin_s < 0.1  # 20 mm at 100 mm/s take 0.225 s
    assert slow.stage.guide_x_mm() > 131
    slow.say(b"G4 P0.01\n")
    assert time.monotonic() - begin_s >= 0.225
    assert slow.stage.guide_x_mm() == 130


def test_laser_mode_m3_at_rest_needs_modal_g1(fast: Terminal) -> None:
    fast.home()
    fast.say(b"G0 X100\n")
    fast.say(b"M3 S500\n")
    assert not fast.stage.laser_on  # modal G0
    fast.say(b"G1 F6000\n")
    fast.wait_laser(True)
    fast.say(b"M5\n")
    assert not fast.stage.laser_on


def test_m4_is_dark_at_rest_although_the_status_says_500(fast: Terminal) -> None:
    fast.home()
    fast.say(b"G1 X100 F6000\n")
    fast.say(b"G4 P0.01\n")
    fast.say(b"M4 S500\n")
    assert b"FS:0,500" in fast.say(b"?", b"\r\n")
    assert not fast.stage.laser_on
    fast.say(b"X20\n")
    fast.say(b"G4 P0.01\n")
    assert [on for _, on in fast.edges] == [True, False]  # lit in motion only


def test_soft_limit_stops_with_alarm_2_and_keeps_the_position(fast: Terminal) -> None:
    fast.home()
    assert fast.say(b"G1 X200 F6000\n", b"continue]\r\n").startswith(b"ALARM:2")
    os.write(fast.fd, b"?")  # a board in this alarm answers nothing but a reset
    assert fast.say(b"\x18", b"unlock]\r\n").startswith(b"\r\nGrbl")
    assert b"Unlocked" in fast.say(b"$X\n")
    assert fast.stage.guide_x_mm() == pytest.approx(150.0)


def test_hard_limit_strikes_where_the_switch_is(fast: Terminal) -> None:
    fast.home()
    fast.say(b"$20=0\n")
    fast.say(b"G1 X-300 F30000\n")
    assert b"ALARM:1" in fast.until(b"continue]\r\n")
    assert fast.stage.guide_x_mm() == pytest.approx(-156)


def test_hold_switches_the_laser_off_and_resume_goes_on(slow: Terminal) -> None:
    slow.home()
    os.write(slow.fd, b"G1 F3000 X150\nM3 S500\nX140\nG4P0.01\nM5\n")
    slow.wait_laser(True)
    os.write(slow.fd, b"!")
    slow.wait_laser(False)
    deadline_s = time.monotonic() + 2
    while b"<Hold:0" not in slow.say(b"?", b">\r\n"):
        assert time.monotonic() < deadline_s
    os.write(slow.fd, b"~")
    slow.wait_laser(True)
    slow.wait_laser(False)
    assert slow.stage.guide_x_mm() == pytest.approx(140)


def test_reset_at_hold_keeps_the_position_and_in_motion_loses_it(slow: Terminal) -> None:
    slow.home()
    slow.say(b"G1 F3000 X100\n")
    assert b"ALARM:3" in slow.say(b"\x18", b"unlock]\r\n")
    slow.say(b"$H\n")
    slow.say(b"G1 F3000 X100\n")
    os.write(slow.fd, b"!")
    while b"<Hold:0" not in slow.say(b"?", b">\r\n"):
        assert slow.stage.guide_x_mm() > 100
    assert b"ALARM" not in slow.say(b"\x18", b"help]\r\n")
    assert slow.say(b"?", b"\r\n").startswith(b"<Idle")


def test_dead_man_opens_500_ms_after_the_last_byte_and_stays_open(fast: Terminal) -> None:
    fast.home()
    fast.say(b"G1 F6000\n")
    fast.say(b"M3 S500\n")
    lit_s = fast.wait_laser(True)
    assert 0.4 < fast.wait_laser(False) - lit_s < 0.75
    fast.say(b"?", b">\r\n")
    assert not fast.stage.laser_on  # the board still asks for light; the relay waits for it to let go
    fast.say(b"M5\n")
    fast.say(b"M3 S500\n")
    fast.wait_laser(True)


def test_without_the_relay_the_laser_burns_until_somebody_resets(bare: Terminal) -> None:
    bare.home()
    bare.say(b"G1 F6000\n")
    bare.say(b"M3 S500\n")
    bare.wait_laser(True)
    assert not select.select([bare.fd], [], [], 0.7)[0]
    assert bare.stage.laser_on
    bare.say(b"\x18", b"help]\r\n")
    bare.wait_laser(False)


def test_the_buffer_holds_127_bytes_and_loses_the_rest(slow: Terminal) -> None:
    slow.home()
    slow.say(b"G4 P0\n")
    os.write(slow.fd, b"G4 P0.2\n" + b"G4 P0.001\n" * 20)  # 8 bytes, 11 whole lines of 10, and 9 bytes of the next
    for _ in range(12):
        slow.until(b"ok\r\n")
    assert not select.select([slow.fd], [], [], 0.1)[0]


@pytest.mark.parametrize("code", [6, 9])
def test_homing_can_fail(fast: Terminal, code: int) -> None:
    fast.until(b"unlock]\r\n")
    fast.peer.inject("alarm", code=code)
    assert fast.say(b"$H\n", b"unlock]\r\n").startswith(b"ALARM:%d\r\n" % code)
    assert fast.say(b"G0 X1\n", b"\r\n") == b"error:9\r\n"


def test_settings_shift_the_machine_zero_as_on_a_stock_board() -> None:
    for terminal in make(50.0, x_home_mm=155.0):
        terminal.home()
        assert terminal.say(b"?", b"\r\n").startswith(b"<Idle|MPos:-5.000,")
        assert terminal.stage.guide_x_mm() == pytest.approx(150.0)
        assert terminal.say(b"G1 X1 F100\n", b"continue]\r\n").startswith(b"ALARM:2")  # machine range is -310..0
