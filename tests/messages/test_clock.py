"""Clocks are injected; the virtual one jumps instead of waiting."""

from __future__ import annotations

import threading
import time

from echolume_messages.clock import Clock, SystemClock, VirtualClock


def test_a_virtual_wait_takes_no_time_and_moves_both_clocks() -> None:
    clock: Clock = VirtualClock(monotonic_ns=5, wall_ns=7)
    start_s = time.monotonic()
    assert clock.wait(threading.Event(), 3600.0) is False
    assert time.monotonic() - start_s < 1.0
    assert clock.monotonic_ns() == 5 + 3600 * 10**9
    assert clock.wall_ns() == 7 + 3600 * 10**9


def test_a_set_event_is_not_waited_for() -> None:
    event = threading.Event()
    event.set()
    clock = VirtualClock()
    assert clock.wait(event, 10.0) is True
    assert clock.monotonic_ns() == 0
    assert SystemClock().wait(event, 10.0) is True


def test_the_wall_clock_may_jump_alone() -> None:
    clock = VirtualClock(wall_ns=0)
    clock.jump_wall(-3600.0)
    assert (clock.monotonic_ns(), clock.wall_ns()) == (0, -3600 * 10**9)


def test_the_system_s_monotonic_clock_never_goes_back() -> None:
    clock = SystemClock()
    times = [clock.monotonic_ns() for _ in range(100)]
    assert times == sorted(times)
    assert abs(clock.wall_ns() - time.time_ns()) < 10**9
