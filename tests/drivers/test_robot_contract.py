"""The robot's contract, on the emulated gantry, over socketcand."""

from __future__ import annotations

import socket
import threading
import time
from collections.abc import Iterator

import numpy as np
import pytest

from echolume_drivers.emulated.cia402 import State
from echolume_drivers.emulated.robot_peer import RobotPeer
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stage import Stage
from echolume_drivers.robot import Cia402Robot
from echolume_messages.errors import DeviceAbsentError, DeviceError, DeviceFaultError, DeviceSilentError
from echolume_messages.rig import RobotSettings

HOVER = np.array([10.0, -20.0, 150.0, 0.1, -0.05, 0.2])


class Bench:
    """A robot on its bus."""

    def __init__(self, speed: float) -> None:
        self.stage = Stage(seed=1, scene=plate(), speed=speed)
        self.peer = RobotPeer(self.stage)
        self.peer.start()
        host, port = self.peer.address
        self.robot = Cia402Robot(RobotSettings(host=host, port=port))

    def close(self) -> None:
        self.robot.close()
        self.peer.close()


@pytest.fixture
def fast() -> Iterator[Bench]:
    bench = Bench(50.0)
    bench.robot.open()
    bench.robot.enable()
    yield bench
    bench.close()


@pytest.fixture
def slow() -> Iterator[Bench]:
    bench = Bench(1.0)
    bench.robot.open()
    bench.robot.enable()
    yield bench
    bench.close()


def until(condition: object, timeout_s: float = 3.0) -> None:
    deadline_s = time.monotonic() + timeout_s
    while not condition():
        assert time.monotonic() < deadline_s
        threading.Event().wait(0.002)


def test_heartbeats_are_set_both_ways_on_every_axis(fast: Bench) -> None:
    for axis in fast.peer.axes:
        assert axis.objects.values[0x1016, 1] == 127 << 16 | 500  # node 127 at most 500 ms silent
        assert axis.objects.values[0x1017, 0] == 100
        assert axis.objects.values[0x605A, 0] == 2
        assert axis.state is State.OPERATION_ENABLED


def test_a_move_ends_where_it_was_sent_and_says_so(fast: Bench) -> None:
    reached = fast.robot.move(HOVER)
    assert reached.shape == (6,)
    assert reached.dtype == np.float64
    np.testing.assert_allclose(reached[:3], HOVER[:3], atol=1e-3)
    np.testing.assert_allclose(reached[3:], HOVER[3:], atol=np.radians(1e-3))
    np.testing.assert_allclose(fast.stage.robot_pose(), reached, atol=1e-9)
    np.testing.assert_allclose(fast.robot.pose(), reached, atol=1e-9)


def test_a_move_of_no_length_is_a_move(fast: Bench) -> None:
    first = fast.robot.move(HOVER)
    np.testing.assert_array_equal(fast.robot.move(first), first)


def test_a_raster_step_is_quick_at_speed_50(fast: Bench) -> None:
    fast.robot.move(HOVER)
    times_s: list[float] = []
    for k in range(15):
        begin_s = time.perf_counter()
        fast.robot.move(HOVER + np.eye(6)[0] * 10.0 * (k % 2))
        times_s.append(time.perf_counter() - begin_s)
    assert np.median(times_s) < 0.03


@pytest.mark.parametrize(
    ("pose", "words"),
    [
        ([401, 0, 150, 0, 0, 0], r"robot axis x .*target 401.000 mm is outside the drive's -400..400 \(0x607D\)"),
        ([0, 0, 10, 0, 0, 0], r"robot axis z "),
        ([0, 0, 150, 2.0, 0, 0], r"robot axis rx .* deg is outside"),
        ([0, 0, float("nan"), 0, 0, 0], r"not finite"),
    ],
)
def test_targets_beyond_the_drives_limits_are_refused(fast: Bench, pose: list[float], words: str) -> None:
    before = fast.stage.robot_pose()
    with pytest.raises(DeviceFaultError, match=words):
        fast.robot.move(pose)
    np.testing.assert_array_equal(fast.stage.robot_pose(), before)
    fast.robot.move(HOVER)


def test_a_pose_has_six_numbers(fast: Bench) -> None:
    with pytest.raises(ValueError, match=r"expected shape \(6,\)"):
        fast.robot.move([0.0, 0.0, 150.0])


def test_nothing_moves_before_enable() -> None:
    bench = Bench(50.0)
    try:
        bench.robot.open()
        with pytest.raises(DeviceFaultError, match=r"not enabled"):
            bench.robot.move(HOVER)
    finally:
        bench.close()


def test_quick_stop_brakes_a_move_in_the_air(slow: Bench) -> None:
    failures: list[DeviceError] = []

    def travel() -> None:
        try:
            slow.robot.move([300.0, 0, 250, 0, 0, 0])
        except DeviceError as error:
            failures.append(error)

    mover = threading.Thread(target=travel)
    mover.start()
    until(lambda: slow.stage.robot_pose()[0] > 30)
    slow.robot.quick_stop()
    mover.join(5.0)
    assert "stopped on the way" in str(failures[0])
    until(lambda: all(axis.state is State.SWITCH_ON_DISABLED for axis in slow.peer.axes))
    assert 30 < slow.stage.robot_pose()[0] < 100
    with pytest.raises(DeviceFaultError, match=r"not enabled"):
        slow.robot.move(HOVER)
    slow.robot.enable()


def test_close_takes_the_power_off(fast: Bench) -> None:
    fast.robot.close()
    until(lambda: all(axis.state is State.SWITCH_ON_DISABLED for axis in fast.peer.axes))


def test_no_server_is_an_absent_device() -> None:
    with socket.create_server(("127.0.0.1", 0)) as free:
        port = free.getsockname()[1]
    begin_s = time.monotonic()
    with pytest.raises(DeviceAbsentError, match=r"no socketcand server"):
        Cia402Robot(RobotSettings(port=port)).open()
    assert time.monotonic() - begin_s < 2.0


# --- faults --------------------------------------------------------------------------------------------------


def test_a_lost_status_pdo_is_made_up_for_by_sdo(fast: Bench) -> None:
    for node in range(1, 7):
        fast.peer.inject("lost_tpdo", node=node, count=2)
    np.testing.assert_allclose(fast.robot.move(HOVER), HOVER, atol=1e-4)


def test_an_emergency_stops_the_move_and_is_told_in_words(fast: Bench) -> None:
    fast.peer.inject("emcy", node=3, code=0x4310)
    with pytest.raises(DeviceFaultError, match=r"robot axis z \(node 3, can0\): .*0x4310 \(drive too hot\)"):
        for _ in range(50):
            fast.robot.move(HOVER)
            fast.robot.move(-HOVER * [1, 1, -1, 1, 1, 1])
    fast.robot.enable()
    fast.robot.move(HOVER)


def test_a_following_error_is_told_in_words(slow: Bench) -> None:
    slow.peer.inject("following_error", node=1)
    with pytest.raises(DeviceFaultError, match=r"robot axis x .*0x8611 \(following error"):
        slow.robot.move([50.0, 0, 250, 0, 0, 0])
    until(lambda: all(axis.state is not State.OPERATION_ENABLED for axis in slow.peer.axes))
    slow.robot.enable()
    slow.robot.move([5.0, 0, 250, 0, 0, 0])


def test_a_heartbeat_that_stops_is_a_silent_device(slow: Bench) -> None:
    slow.peer.inject("frozen_heartbeat", node=5)
    begin_s = time.monotonic()
    with pytest.raises(DeviceSilentError, match=r"robot axis ry .*no heartbeat for 1.0 s"):
        slow.robot.move([400.0, 0, 250, 0, 0, 0])  # takes more than two seconds
    assert time.monotonic() - begin_s < 1.6


def test_a_node_that_restarts_in_the_run_is_found_out(slow: Bench) -> None:
    threading.Timer(0.2, slow.peer.inject, ["boot_up"], {"node": 2}).start()
    with pytest.raises(DeviceFaultError, match=r"robot axis y .*restarted in the middle of the run"):
        slow.robot.move([0.0, 200.0, 250, 0, 0, 0])
    slow.robot.enable()  # configures the node again
    slow.robot.move([0.0, 1.0, 250, 0, 0, 0])
    assert slow.peer.axes[1].objects.values[0x1016, 1] == 127 << 16 | 500


def test_a_dead_node_does_not_answer_at_open() -> None:
    bench = Bench(50.0)
    try:
        bench.peer.axes[3].dead = True
        with pytest.raises(DeviceSilentError, match=r"robot axis rx \(node 4, can0\): no answer"):
            bench.robot.open()
    finally:
        bench.close()


def test_a_broken_connection_ends_the_move(slow: Bench) -> None:
    threading.Timer(0.2, slow.peer.inject, ["disconnect"]).start()
    with pytest.raises((DeviceAbsentError, DeviceSilentError)):
        slow.robot.move([300.0, 0, 250, 0, 0, 0])
    # ... and the axes stop by themselves, for want of the master's heartbeat
    until(lambda: all(axis.state is State.FAULT for axis in slow.peer.axes))
    assert slow.stage.robot_pose()[0] < 250
