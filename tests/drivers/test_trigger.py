"""The trigger unit keeps its contract on the emulated generator, and its bytes are the BNC 575 dialect's."""

from __future__ import annotations

import time

import pytest

from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.scpi_wires import PtyWire
from echolume_drivers.emulated.stage import Stage
from echolume_drivers.emulated.trigger_peer import TriggerPeer
from echolume_drivers.trigger import TriggerUnit
from echolume_messages.errors import DeviceAbsentError, DeviceFaultError, DeviceSilentError, ProtocolError
from echolume_messages.rig import TriggerSettings

TIMEOUT_S = 0.25


class Camera:
    def __init__(self):
        self.exposures_s = []

    def fire(self, exposure_s):
        self.exposures_s.append(exposure_s)


@pytest.fixture
def stage():
    return Stage(seed=1, scene=plate())


@pytest.fixture
def cameras():
    return [Camera(), Camera()]


@pytest.fixture
def peer(stage, cameras):
    made = TriggerPeer(stage, cameras)
    made.start()
    yield made
    made.close()


@pytest.fixture
def unit(peer):
    made = TriggerUnit(TriggerSettings(port=peer.url), timeout_s=TIMEOUT_S)
    made.open()
    yield made
    made.close()


def flash(stage):
    stage.switch_laser(True)
    stage.switch_laser(False)


class TestContract:
    def test_fire_exposes_both_cameras_once(self, unit, cameras):
        unit.fire(0.004)
        assert [c.exposures_s for c in cameras] == [[0.004], [0.004]]
        assert unit.count() == 1

    def test_armed_it_exposes_at_each_rising_edge(self, unit, stage, cameras):
        unit.arm_external(0.002)
        assert unit.count() == 0
        flash(stage)
        flash(stage)
        assert [c.exposures_s for c in cameras] == [[0.002, 0.002]] * 2
        assert unit.count() == 2

    def test_disarmed_it_ignores_the_laser(self, unit, stage, cameras):
        unit.arm_external(0.002)
        unit.disarm()
        flash(stage)
        assert unit.count() == 0
        assert cameras[0].exposures_s == []

    def test_fire_after_arming_leaves_the_laser_without_effect(self, unit, stage, cameras):
        unit.arm_external(0.002)
        unit.fire(0.003)
        flash(stage)
        assert cameras[1].exposures_s == [0.003]

    def test_opening_disarms(self, peer, unit, stage):
        unit.arm_external(0.002)
        unit.close()
        unit.open()
        flash(stage)
        assert unit.count() == 0

    @pytest.mark.parametrize("exposure_s", [0.0, -1.0, 1e9, float("nan")])
    def test_absurd_exposures_are_refused_before_they_are_sent(self, unit, exposure_s):
        with pytest.raises(ValueError, match="exposure_s"):
            unit.fire(exposure_s)

    def test_it_can_be_closed_twice(self, unit):
        unit.close()
        unit.close()


@pytest.mark.parametrize(
    ("fault", "error", "said"),
    [
        ("silent", DeviceSilentError, "by the deadline"),
        ("garbage", ProtocolError, "expected a line of text"),
        ("refuse", DeviceFaultError, r"\?8.*unavailable"),
        ("disconnect", DeviceAbsentError, "connection broke"),
    ],
)
@pytest.mark.parametrize("do", ["fire", "count"])
def test_each_fault_is_its_error_within_the_deadline(peer, unit, fault, error, said, do):
    peer.inject(fault)
    started_s = time.monotonic()
    with pytest.raises(error, match=rf"trigger unit at {peer.url}: .*{said}"):
        unit.fire(0.001) if do == "fire" else unit.count()
    assert time.monotonic() - started_s < TIMEOUT_S + 1.0
    if fault != "disconnect":
        unit.fire(0.001)
        assert unit.count() == 1


def test_a_swallowed_trigger_shows_in_the_count(peer, unit, stage, cameras):
    unit.arm_external(0.002)
    peer.inject("no_fire")
    flash(stage)
    assert unit.count() == 0
    flash(stage)
    assert unit.count() == 1
    assert len(cameras[0].exposures_s) == 1


def test_unknown_faults_are_refused(peer):
    with pytest.raises(ValueError, match="unknown fault 'fire'"):
        peer.inject("fire")


def test_absent_port_names_the_unit(tmp_path):
    with pytest.raises(DeviceAbsentError, match="trigger unit at"):
        TriggerUnit(TriggerSettings(port=str(tmp_path / "tty"))).open()


def test_another_instrument_is_not_taken_for_a_pulse_generator():
    wire = PtyWire("stranger", lambda line: b"Grbl 1.1h\r\n")
    wire.start()
    unit = TriggerUnit(TriggerSettings(port=wire.url), timeout_s=TIMEOUT_S)
    with pytest.raises(ProtocolError, match="expected maker, model"):
        unit.open()
    wire.close()


def test_bytes_of_arming_and_firing():
    told = []

    def answer(line):
        told.append(line)
        return {b"*IDN?": b"BNC,575-4,31309,2.4.1\r\n", b":PULSE0:COUN:COUN?": b"7\r\n"}.get(line, b"ok\r\n")

    wire = PtyWire("scripted", answer)
    wire.start()
    unit = TriggerUnit(TriggerSettings(port=wire.url), timeout_s=TIMEOUT_S)
    unit.open()
    unit.arm_external(0.004)
    unit.fire(0.0005)
    assert unit.count() == 7
    unit.disarm()
    unit.close()
    wire.close()
    assert told == [
        b"*IDN?",
        b":PULSE0:STATE OFF",  # safe after opening
        b":PULSE0:STATE OFF",  # no edge may fire with half of the settings
        b":PULSE1:WIDTH 0.004000000",
        b":PULSE0:EXT:MODE TRIG",
        b":PULSE0:STATE ON",
        b":PULSE0:STATE OFF",
        b":PULSE1:WIDTH 0.000500000",
        b":PULSE0:EXT:MODE DIS",
        b":PULSE0:STATE ON",
        b"*TRG",
        b":PULSE0:COUN:COUN?",
        b":PULSE0:STATE OFF",
    ]


PEER_TRANSCRIPT = [
    (b"*IDN?", b"ECHOLUME,PULSE 575,0001,1.0\r\n"),
    (b":PULSE0:STATE?", b"0\r\n"),
    (b"*TRG", b"?8\r\n"),  # not armed
    (b":PULSE0:STATE ON", b"ok\r\n"),
    (b"*TRG", b"ok\r\n"),
    (b":PULS0:COUN:COUN?", b"1\r\n"),
    (b":PULSE1:WIDTH 0.01", b"ok\r\n"),
    (b":PULSE1:WIDTH?", b"0.010000000\r\n"),
    (b":PULSE1:WIDTH", b"?4\r\n"),
    (b":PULSE1:WIDTH long", b"?5\r\n"),
    (b":PULSE1:WIDTH -1", b"?5\r\n"),
    (b":PULSE0:EXT:MODE MAYBE", b"?5\r\n"),
    (b":PULSE0:EXT:MODE TRIG", b"ok\r\n"),
    (b":PULSE0:EXT:MODE?", b"TRIG\r\n"),
    (b"*TRG", b"?8\r\n"),  # waits for the wire
    (b":NOSUCH", b"?3\r\n"),
    (b"PULSE0:STATE ON", b"?1\r\n"),  # no colon
    (b"*RST", b"ok\r\n"),
    (b":PULSE0:STATE?", b"0\r\n"),
    (b"", b""),
]


def test_peer_transcript(stage):
    peer = TriggerPeer(stage, [])
    for k, (said, answered) in enumerate(PEER_TRANSCRIPT):
        assert peer._line(said) == answered, f"line {k}: {said!r}"
    peer.close()
