"""The guide's contract, on the emulated board."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass, field

import pytest

from echolume_drivers.emulated.grbl_peer import GrblPeer
from echolume_drivers.emulated.scene import plate
from echolume_drivers.emulated.stage import Stage
from echolume_drivers.grbl import GrblGuide
from echolume_messages.errors import DeviceAbsentError, DeviceError, DeviceFaultError, DeviceSilentError, ProtocolError
from echolume_messages.rig import GuideSettings


@dataclass
class Bench:
    """A guide, its board, and what the laser-enable line did."""

    stage: Stage
    peer: GrblPeer
    guide: GrblGuide
    edges: list[tuple[float, bool, float]] = field(default_factory=list)
    lit: threading.Condition = field(default_factory=threading.Condition)

    def note(self, on: bool) -> None:
        with self.lit:
            self.edges.append((time.monotonic(), on, self.stage.guide_x_mm()))
            self.lit.notify_all()

    def wait_laser(self, on: bool, timeout_s: float = 3.0) -> None:
        with self.lit:
            assert self.lit.wait_for(lambda: self.stage.laser_on is on, timeout_s)


def bench(speed: float, homed: bool = True, **settings: float) -> Iterator[Bench]:
    stage = Stage(seed=1, scene=plate(), speed=speed)
    peer = GrblPeer(stage, x_home_mm=settings.get("x_home_mm", 0.0), start_x_mm=149.0)
    peer.start()
    made = Bench(stage, peer, GrblGuide(GuideSettings(port=peer.url, **settings)))
    stage.watch_laser(made.note)
    try:
        made.guide.open()
        if homed:
            made.guide.home()
        yield made
    finally:
        made.guide.close()
        peer.close()
        assert not stage.laser_on


@pytest.fixture
def fast() -> Iterator[Bench]:
    yield from bench(50.0)


@pytest.fixture
def slow() -> Iterator[Bench]:
    yield from bench(1.0)


@pytest.fixture
def unhomed() -> Iterator[Bench]:
    yield from bench(50.0, homed=False)


def test_home_ends_at_the_defined_place(unhomed: Bench) -> None:
    assert unhomed.guide.home() == pytest.approx(150.0)
    assert unhomed.stage.guide_x_mm() == pytest.approx(150.0)


@pytest.mark.parametrize("x_mm", [-150.0, -33.3, 0.0, 150.0])
def test_move_reaches_and_says_so(fast: Bench, x_mm: float) -> None:
    assert fast.guide.move(x_mm) == pytest.approx(x_mm, abs=0.002)
    assert fast.stage.guide_x_mm() == pytest.approx(x_mm, abs=0.002)
    assert fast.edges == []


def test_a_stock_board_counts_from_its_own_zero() -> None:
    for made in bench(50.0, x_home_mm=155.0):
        assert made.guide.move(-150.0) == pytest.approx(-150.0)
        assert made.stage.guide_x_mm() == pytest.approx(-150.0)
        assert made.guide.status().x_mm == pytest.approx(-150.0)


def test_expose_lights_the_laser_once_at_standstill_at_the_place(fast: Bench) -> None:
    for k in range(20):
        x_mm = fast.guide.expose(-40 + 0.5 * k, 0.02)
        assert x_mm == pytest.approx(-40 + 0.5 * k)
        assert [(on, x) for _, on, x in fast.edges] == [(True, x_mm), (False, x_mm)]
        fast.edges.clear()


def test_expose_at_the_same_place_lights_again(fast: Bench) -> None:
    fast.guide.move(10.0)
    fast.guide.expose(10.0, 0.02)
    fast.guide.expose(10.0, 0.02)
    assert [on for _, on, _ in fast.edges] == [True, False, True, False]


def test_exposure_lasts_as_long_as_asked(slow: Bench) -> None:
    slow.guide.expose(149.0, 0.1)
    (on_s, _, _), (off_s, _, _) = slow.edges
    assert off_s - on_s == pytest.approx(0.1, abs=0.05)


def test_an_exposure_longer_than_the_dead_man_is_kept_alive(slow: Bench) -> None:
    slow.guide.expose(149.0, 0.9)
    (on_s, _, _), (off_s, _, _) = slow.edges
    assert off_s - on_s == pytest.approx(0.9, abs=0.1)


def test_a_step_at_speed_50_is_quick(fast: Bench) -> None:
    fast.guide.move(-50)
    begin_s = time.perf_counter()
    for k in range(40):
        fast.guide.expose(-50 + k, 0.02)
    assert (time.perf_counter() - begin_s) / 40 < 0.02


def test_nothing_moves_before_homing(unhomed: Bench) -> None:
    with pytest.raises(DeviceFaultError, match=r"guide .* not homed: home the guide first"):
        unhomed.guide.move(0.0)
    assert unhomed.guide.status().state == "Alarm"
    unhomed.guide.laser_off()


@pytest.mark.parametrize("x_mm", [-150.1, 151.0, float("nan")])
def test_beyond_the_settings_nothing_is_sent(fast: Bench, x_mm: float) -> None:
    with pytest.raises(DeviceFaultError, match=r"outside -150.0..150.0 mm"):
        fast.guide.expose(x_mm, 0.02)
    fast.guide.move(0.0)


def test_stop_in_motion_keeps_the_position(slow: Bench) -> None:
    failures: list[DeviceError] = []

    def travel() -> None:
        try:
            slow.guide.move(0.0)
        except DeviceError as error:
            failures.append(error)

    mover = threading.Thread(target=travel)
    mover.start()
    deadline_s = time.monotonic() + 2
    while slow.stage.guide_x_mm() > 145:
        assert time.monotonic() < deadline_s
    slow.guide.stop()
    mover.join(5.0)
    assert [str(error).endswith("stopped on request") for error in failures] == [True]
    status = slow.guide.status()
    assert status.state == "Idle"
    assert status.x_mm == pytest.approx(slow.stage.guide_x_mm(), abs=0.01)
    assert 5 < slow.stage.guide_x_mm() < 145
    slow.guide.move(148.0)  # still homed
    assert slow.stage.guide_x_mm() == pytest.approx(148.0)


def test_laser_off_interrupts_an_exposure(slow: Bench) -> None:
    failures: list[DeviceError] = []

    def expose() -> None:
        try:
            slow.guide.expose(150.0, 5.0)
        except DeviceError as error:
            failures.append(error)

    exposer = threading.Thread(target=expose)
    exposer.start()
    slow.wait_laser(True)
    slow.guide.laser_off()
    assert not slow.stage.laser_on
    exposer.join(5.0)
    assert len(failures) == 1
    slow.guide.expose(150.0, 0.02)


def test_two_programs_cannot_hold_one_port(fast: Bench) -> None:
    second = GrblGuide(GuideSettings(port=fast.peer.url))
    with pytest.raises(DeviceAbsentError, match=r"does no other program hold it"):
        second.open()
    fast.guide.move(1.0)  # the first one did not notice


def test_a_port_that_is_not_there() -> None:
    with pytest.raises(DeviceAbsentError, match=r"guide \(/dev/echolume-none\): cannot open the port"):
        GrblGuide(GuideSettings(port="/dev/echolume-none")).open()


@pytest.mark.parametrize(("key", "words"), [(32, "laser mode must be on: send"), (20, "soft limits"), (22, "homing")])
def test_a_board_that_is_set_up_wrongly_is_refused(key: int, words: str) -> None:
    stage = Stage(seed=1, scene=plate(), speed=50.0)
    peer = GrblPeer(stage)
    peer.machine.settings[key] = 0
    peer.start()
    try:
        with pytest.raises(DeviceFaultError, match=words):
            GrblGuide(GuideSettings(port=peer.url)).open()
    finally:
        peer.close()


# --- faults --------------------------------------------------------------------------------------------------


def test_a_dropped_ok_is_named_and_the_laser_is_off(fast: Bench, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("echolume_drivers.grbl.MARGIN_S", 0.4)
    fast.peer.inject("drop_ok")
    with pytest.raises(DeviceSilentError, match=r"no ok for 'M5' within"):
        fast.guide.expose(149.0, 0.02)
    assert not fast.stage.laser_on
    fast.guide.expose(148.0, 0.02)


def test_a_late_ok_is_waited_for(fast: Bench) -> None:
    fast.peer.inject("late_ok", delay_s=0.3)
    assert fast.guide.expose(0.0, 0.02) == 0.0


def test_one_ok_too_many_is_found_out(fast: Bench) -> None:
    fast.peer.inject("duplicate_ok")
    with pytest.raises(ProtocolError, match=r"an `ok` that answers nothing"):
        for k in range(30):
            fast.guide.expose(float(k), 0.02)
    assert not fast.stage.laser_on
    fast.guide.expose(9.0, 0.02)


@pytest.mark.parametrize("fault", ["garbage", "half_line"])
def test_noise_on_the_wire_is_found_out(fast: Bench, fault: str) -> None:
    fast.peer.inject(fault)
    with pytest.raises(ProtocolError, match=r"expected ok, error, ALARM or a report"):
        fast.guide.expose(0.0, 0.02)
    assert not fast.stage.laser_on
    fast.guide.expose(1.0, 0.02)


@pytest.mark.parametrize(("code", "words"), [(1, "hard limit switch hit"), (3, "reset while in motion")])
def test_an_alarm_is_told_in_words_and_asks_for_homing(fast: Bench, code: int, words: str) -> None:
    fast.peer.inject("alarm", code=code)
    for _ in range(2):
        with pytest.raises(DeviceFaultError, match=words):
            fast.guide.expose(0.0, 0.02)
    assert fast.guide.status().alarm == code
    fast.guide.home()
    fast.guide.expose(0.0, 0.02)


def test_the_boards_own_soft_limit_is_told_in_words(fast: Bench) -> None:
    fast.peer.machine.settings[130] = 20.0
    with pytest.raises(DeviceFaultError, match=r"ALARM:2 \(soft limit"):
        fast.guide.expose(-100.0, 0.02)
    assert fast.edges == []


@pytest.mark.parametrize(("code", "words"), [(6, "reset during homing"), (9, "limit switch was not found")])
def test_homing_that_fails_says_why(fast: Bench, code: int, words: str) -> None:
    fast.peer.inject("alarm", code=code)
    with pytest.raises(DeviceFaultError, match=words):
        fast.guide.home()
    with pytest.raises(DeviceFaultError):
        fast.guide.move(0.0)
    fast.guide.home()
    fast.guide.move(0.0)


def test_a_board_that_restarts_by_itself_must_be_homed(slow: Bench) -> None:
    threading.Timer(0.2, slow.peer.inject, ["reset"]).start()
    with pytest.raises(DeviceFaultError, match=r"restarted by itself; home again"):
        slow.guide.move(0.0)
    with pytest.raises(DeviceFaultError, match=r"not homed"):
        slow.guide.move(0.0)
    slow.guide.home()


def test_a_hung_board_is_given_up_and_the_dead_man_takes_the_laser(slow: Bench) -> None:
    trouble: list[DeviceError] = []

    def expose() -> None:
        try:
            slow.guide.expose(150.0, 9.0)
        except DeviceError as error:
            trouble.append(error)

    exposer = threading.Thread(target=expose)
    exposer.start()
    slow.wait_laser(True)
    hung_s = time.monotonic()
    slow.peer.inject("hang")
    slow.wait_laser(False)
    assert time.monotonic() - hung_s < 0.9  # the last answered query, and 500 ms
    exposer.join(5.0)
    assert isinstance(trouble[0], DeviceSilentError)
    assert not slow.stage.laser_on


def test_a_port_that_dies_is_an_absent_device(fast: Bench) -> None:
    fast.peer.inject("eof")
    with pytest.raises(DeviceAbsentError, match=r"Check the cable and power"):
        fast.guide.move(0.0)


def test_a_dead_host_leaves_no_light(slow: Bench) -> None:
    slow.guide._link.send(b"G1 F6000\nM3 S500\n")  # what no driver of ours sends: a laser-on without its off
    slow.wait_laser(True)
    slow.guide._link.close()  # ... and then the host is gone
    slow.wait_laser(False, 0.8)
