"""The bytes that the guide puts on the wire, against a scripted port."""

from __future__ import annotations

import os
import threading
import tty
from collections.abc import Iterator

import pytest

from echolume_drivers.grbl import GrblGuide
from echolume_drivers.grbl_codes import ALARMS, ERRORS
from echolume_messages.errors import DeviceFaultError
from echolume_messages.rig import GuideSettings

SETTINGS = "$20=1\r\n$22=1\r\n$32=1\r\n$100=250.000\r\n$110=6000.000\r\n$120=500.000\r\nok\r\n"


class Script:
    """Answers chunks of bytes; a chunk is one write of the driver, or one real-time byte."""

    def __init__(self) -> None:
        self.master, slave = os.openpty()
        tty.setraw(slave)
        self.slave = slave
        self.port = os.ttyname(slave)
        self.written: list[bytes] = []
        self.answers: dict[bytes, str] = {
            b"$$\n": SETTINGS,
            b"$H\n": "ok\r\n",
            b"?": "<Idle|MPos:-5.000,0.000,0.000|FS:0,0>\r\n",
            b"\x18": "\r\nGrbl 1.1h ['$' for help]\r\n",
        }
        self._thread = threading.Thread(target=self._serve, daemon=True)
        self._thread.start()

    def _serve(self) -> None:
        while True:
            try:
                data = os.read(self.master, 4096)
            except OSError:
                return
            pieces = [bytes([byte]) for byte in data] if data[-1:] in b"?!\x18" else [data]
            for piece in pieces:  # real-time bytes may arrive glued together
                self.written.append(piece)
                answer = self.answers.get(piece, "ok\r\n" * piece.count(b"\n"))
                os.write(self.master, answer.encode())

    def close(self) -> None:
        os.close(self.slave)
        self._thread.join(5.0)
        os.close(self.master)


@pytest.fixture
def script(monkeypatch: pytest.MonkeyPatch) -> Iterator[Script]:
    monkeypatch.setattr("echolume_drivers.grbl.BANNER_S", 0.05)  # this board does not restart when opened
    made = Script()
    yield made
    made.close()


@pytest.fixture
def guide(script: Script) -> Iterator[GrblGuide]:
    made = GrblGuide(GuideSettings(port=script.port, x_home_mm=155.0))
    made.open()
    made.home()
    yield made
    made.close()


def test_opening_resets_a_board_that_did_not_restart(script: Script, guide: GrblGuide) -> None:
    assert script.written == [
        b"\x18",  # no banner came: reset, which switches the laser off
        b"$$\n",  # laser mode, soft limits, homing, steps, speed, acceleration
        b"$H\n",  # homing cycle
        b"?",  # where did it end
    ]


def test_an_exposure_is_one_write_with_its_own_laser_off(script: Script, guide: GrblGuide) -> None:
    script.written.clear()
    assert guide.expose(-20.5, 0.02) == -20.5
    program = (
        b"G53G1X-175.500F6000\n"  # machine coordinates: x_mm - x_home_mm; G1 becomes modal, so M3 lights at rest
        b"G4P0.01\n"  # barrier: its ok comes at standstill
        b"M3S500\n"  # laser on
        b"G4P0.0200\n"  # for 20 ms
        b"M5\n"  # laser off
    )
    assert script.written[0] == program
    assert len(program) <= 127


def test_a_move_begins_with_the_laser_off(script: Script, guide: GrblGuide) -> None:
    script.written.clear()
    guide.move(150.0)
    assert script.written == [b"M5\nG53G1X-5.000F6000\nG4P0.01\n", b"?"]


def test_closing_resets(script: Script, guide: GrblGuide) -> None:
    script.written.clear()
    guide.close()
    assert script.written == [b"\x18"]


MOVE_TO_0 = b"M5\nG53G1X-155.000F6000\nG4P0.01\n"


def test_each_error_code_is_told_in_words(script: Script, guide: GrblGuide) -> None:
    for code, words in ERRORS.items():
        script.answers[MOVE_TO_0] = f"error:{code}\r\nok\r\nok\r\n"
        script.written.clear()
        with pytest.raises(DeviceFaultError) as caught:
            guide.move(0.0)
        assert f"error:{code} ({words}) for 'M5'" in str(caught.value)
        assert script.written == [MOVE_TO_0, b"!", b"?", b"\x18"]  # brake, at rest?, reset


def test_each_alarm_is_told_in_words(script: Script, guide: GrblGuide) -> None:
    for code, words in ALARMS.items():
        script.answers[MOVE_TO_0] = f"ok\r\nALARM:{code}\r\n"
        with pytest.raises(DeviceFaultError) as caught:
            guide.move(0.0)
        assert f"ALARM:{code} ({words})" in str(caught.value)
        guide.home()


def test_work_positions_are_turned_into_machine_positions(script: Script, guide: GrblGuide) -> None:
    script.answers[b"?"] = "<Idle|WPos:-100.000,0.000,0.000|FS:0,0|WCO:-50.000,0.000,0.000>\r\n"
    assert guide.status().x_mm == pytest.approx(5.0)


def test_a_position_that_is_not_the_commanded_one_asks_for_homing(script: Script, guide: GrblGuide) -> None:
    script.answers[b"?"] = "<Idle|MPos:-154.000,0.000,0.000|FS:0,0>\r\n"
    guide._checked_s = 0.0
    with pytest.raises(DeviceFaultError, match=r"stands at x 1.000 mm instead of 0.000 mm; home again"):
        guide.expose(0.0, 0.02)
