"""The array digitiser keeps its contract on the emulated one; each fault becomes its error, and is over after it."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace

import msgspec
import numpy as np
import pytest

from echolume_drivers.array import ArrayDigitiser
from echolume_drivers.emulated.array_peer import ArrayPeer
from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.scene import block, plate
from echolume_drivers.emulated.scpi_peer import block as scpi_block
from echolume_drivers.emulated.scpi_wires import TcpWire
from echolume_drivers.emulated.stage import Stage
from echolume_messages.errors import DeviceAbsentError, DeviceFaultError, DeviceSilentError, ProtocolError
from echolume_messages.rig import ArraySettings

TIMEOUT_S = 0.8
SETTINGS = ArraySettings(port="none")
TRUTH = array_truth(1, SETTINGS)


@pytest.fixture(autouse=True)
def sockets_close_at_once(monkeypatch):
    """pyserial sleeps 0.3 s after closing a socket."""
    monkeypatch.setattr("serial.urlhandler.protocol_socket.time", SimpleNamespace(sleep=lambda _: None))


class Robot:
    def __init__(self):
        self.pose = np.array([0, 0, 150.0, 0, 0, 0])


@pytest.fixture
def robot():
    return Robot()


@pytest.fixture
def stage(robot):
    return Stage(seed=1, scene=plate(), robot_pose=lambda: robot.pose)


@pytest.fixture
def peer(stage):
    made = ArrayPeer(stage, SETTINGS, TRUTH)
    made.start()
    yield made
    made.close()


@pytest.fixture
def digitiser(peer):
    made = ArrayDigitiser(msgspec.structs.replace(SETTINGS, port=peer.url), timeout_s=TIMEOUT_S)
    made.open()
    made.configure()
    yield made
    made.close()


class TestContract:
    def test_a_ping_is_what_was_configured(self, digitiser):
        ping = digitiser.ping()
        assert ping.block.dtype == np.int16
        assert ping.block.shape == (8, 1024)
        assert ping.block.flags.writeable
        assert ping.sample_rate_hz == 250e3
        assert ping.start_s == 0.0
        assert ping.volts_per_count == pytest.approx(10 / 32768)
        assert ping.air_temperature_c == pytest.approx(22, abs=0.5)

    def test_device_time_advances_with_real_time(self, digitiser):
        started_ns = time.monotonic_ns()
        first, second = digitiser.ping(), digitiser.ping()
        assert 0 < second.device_t_ns - first.device_t_ns < time.monotonic_ns() - started_ns

    def test_configuration_reaches_the_device(self, peer):
        other = msgspec.structs.replace(SETTINGS, port=peer.url, samples=512, sample_rate_hz=500e3, pulse="paper")
        digitiser = ArrayDigitiser(other, timeout_s=TIMEOUT_S)
        digitiser.open()
        assert digitiser.ping().block.shape == (8, 512)
        assert (peer._settings.sample_rate_hz, peer._settings.pulse) == (500e3, "paper")
        digitiser.close()

    @pytest.mark.parametrize("wrong", [{"sample_rate_hz": 1.0}, {"samples": 1 << 20}, {"start_s": 9.0}])
    def test_a_refused_setting_is_a_fault(self, peer, wrong):
        digitiser = ArrayDigitiser(msgspec.structs.replace(SETTINGS, port=peer.url, **wrong), timeout_s=TIMEOUT_S)
        digitiser.open()
        with pytest.raises(DeviceFaultError, match=r"array digitiser at socket.*configuring: .*-222"):
            digitiser.configure()
        digitiser.close()

    def test_a_setting_that_the_device_changes_is_a_fault(self, peer):
        odd = msgspec.structs.replace(SETTINGS, port=peer.url, samples=1023)
        digitiser = ArrayDigitiser(odd, timeout_s=TIMEOUT_S)
        digitiser.open()
        with pytest.raises(DeviceFaultError, match=r"CONF:SAMP\? to answer 1023, got 1022"):
            digitiser.configure()
        digitiser.close()

    def test_it_can_be_closed_twice(self, digitiser):
        digitiser.close()
        digitiser.close()


class TestEmulation:
    def test_a_position_repeats_by_seed_and_attempt(self, stage, robot, digitiser):
        first = digitiser.ping()
        robot.pose = np.array([10, 0, 150.0, 0, 0, 0])
        elsewhere = digitiser.ping()
        robot.pose = np.array([0, 0, 150.0, 0, 0, 0])
        again = digitiser.ping()
        stage.place(scene=stage.scene)
        afresh = digitiser.ping()
        assert not np.array_equal(first.block, elsewhere.block)
        assert not np.array_equal(first.block, again.block)
        np.testing.assert_array_equal(first.block, afresh.block)
        assert first.air_temperature_c == afresh.air_temperature_c

    def test_the_scene_on_the_stage_is_heard(self, stage, digitiser):
        def echo_time(ping):
            later = ping.block[:, 100:].astype(float)
            return np.abs(later).argmax(axis=1).mean()

        bench = echo_time(digitiser.ping())
        stage.place(scene=block())
        assert echo_time(digitiser.ping()) < bench - 20

    def test_the_thermometer_is_off_by_its_error(self, digitiser):
        found = np.mean([digitiser.ping().air_temperature_c for _ in range(4)])
        assert found - 22.0 == pytest.approx(TRUTH.thermometer_error_k, abs=0.05)


@pytest.mark.parametrize(
    ("fault", "error", "said"),
    [
        ("truncated_block", DeviceSilentError, r"definite-length block of 16384 bytes .*got \d+ bytes by the deadline"),
        ("wrong_length", ProtocolError, "announces b'1638'"),
        ("indefinite_block", ProtocolError, "got an indefinite-length block"),
        ("no_trigger", DeviceSilentError, "trigger never came"),
        ("silent", DeviceSilentError, "trigger never came"),
        ("overflow", DeviceFaultError, "-350,\"Queue overflow\""),
        ("disconnect", DeviceAbsentError, "connection broke .*block of 16384 bytes"),
        ("dead_channel", DeviceFaultError, "flat record on receiver 5"),
        ("over_range", DeviceFaultError, "301,\"Input over range\""),
    ],
)  # fmt: skip
def test_each_fault_is_its_error_within_the_deadline_and_the_next_ping_is_good(peer, digitiser, fault, error, said):
    peer.inject(fault, channel=5)
    started_s = time.monotonic()
    with pytest.raises(error, match=rf"array digitiser at socket://127.0.0.1:\d+: .*{said}"):
        digitiser.ping()
    assert time.monotonic() - started_s < 2 * TIMEOUT_S + 1.0
    good = digitiser.ping()
    assert np.ptp(good.block.astype(int), axis=1).min() > 1000


def test_a_second_client_is_turned_away(peer, digitiser):
    rival = ArrayDigitiser(msgspec.structs.replace(SETTINGS, port=peer.url), timeout_s=TIMEOUT_S)
    with pytest.raises(DeviceAbsentError, match="no other program holds the port"):
        rival.open()
    digitiser.ping()


def test_unknown_faults_are_refused(peer):
    with pytest.raises(ValueError, match="unknown fault 'smoke'"):
        peer.inject("smoke")


def test_closing_the_peer_leaves_no_thread_behind(stage):
    before = set(threading.enumerate())
    made = ArrayPeer(stage, SETTINGS, TRUTH)
    made.start()
    made.close()
    made.close()
    assert set(threading.enumerate()) <= before


def test_bytes_of_configuring_and_pinging():
    told = []
    small = msgspec.structs.replace(SETTINGS, samples=64)
    counts = np.arange(8 * 64, dtype="<i2").reshape(8, 64) * 7 - 900
    answers = {
        b"*IDN?": b"A,B,C,D\n",
        b"SYST:ERR?": b'0,"No error"\n',
        b"CONF:RATE?": b"2.5E+5\n",
        b"CONF:SAMP?": b"64\n",
        b"CONF:STAR?": b"0\n",
        b"CONF:SCAL?": b"0.001\n",
        b"INIT;*TRG;*OPC?": b"1\n",
        b"FETC:ECHO?": scpi_block(counts.tobytes()) + b"\n",
        b"FETC:TIME?": b"123456789012345678\n",
        b"MEAS:TEMP?": b"21.75\n",
    }

    def answer(line):
        told.append(line)
        return answers.get(line, b"")

    wire = TcpWire("scripted", answer)
    wire.start()
    digitiser = ArrayDigitiser(msgspec.structs.replace(small, port=wire.url), timeout_s=TIMEOUT_S)
    digitiser.open()
    digitiser.configure()
    ping = digitiser.ping()
    digitiser.close()
    wire.close()
    np.testing.assert_array_equal(ping.block, counts)
    assert (ping.device_t_ns, ping.air_temperature_c, ping.volts_per_count) == (123456789012345678, 21.75, 0.001)
    assert told == [
        b"*IDN?",
        b"*CLS;:CONF:RATE 250000;:CONF:SAMP 64;:CONF:STAR 0;:CONF:PULS WIDEBAND",
        b"SYST:ERR?",
        b"CONF:RATE?",  # read back
        b"CONF:SAMP?",
        b"CONF:STAR?",
        b"CONF:SCAL?",
        b"INIT;*TRG;*OPC?",  # emit, and wait until it is done
        b"FETC:ECHO?",
        b"FETC:TIME?",
        b"MEAS:TEMP?",
        b"SYST:ERR?",
    ]
