"""A slot keeps its device, finds it again, and says why it is empty."""

from __future__ import annotations

from itertools import pairwise

import pytest

from echolume_daemon.device import Slot
from echolume_messages.errors import DeviceAbsentError, DeviceFaultError, DeviceSilentError


class Gadget:
    """A device whose cable the test holds."""

    def __init__(self) -> None:
        self.plugged, self.answers, self.opened, self.closed = True, True, 0, 0

    def open(self) -> None:
        if not self.plugged:
            raise DeviceAbsentError("gadget at /dev/x: no such port; plug it in")
        self.opened += 1

    def close(self) -> None:
        self.closed += 1

    def ask(self) -> None:
        if not self.answers:
            raise DeviceSilentError("gadget at /dev/x: no answer")


@pytest.fixture
def gadget() -> Gadget:
    return Gadget()


@pytest.fixture
def slot(gadget: Gadget) -> Slot[Gadget]:
    return Slot("gadget", lambda: gadget, probe=lambda g: g.ask())


def state(slot: Slot[Gadget]) -> tuple[object, object]:
    return slot.status()["state"], slot.status()["error"]


def test_an_empty_slot_answers_with_why(slot: Slot[Gadget], gadget: Gadget) -> None:
    gadget.plugged = False
    slot.tick(0.0)
    assert state(slot) == ("absent", "gadget at /dev/x: no such port; plug it in")
    with pytest.raises(DeviceAbsentError, match="plug it in"), slot.use():
        pass


def test_opening_is_tried_again_with_growing_pauses(slot: Slot[Gadget], gadget: Gadget) -> None:
    gadget.plugged = False
    tries: list[float] = []
    made = slot._make
    now = {"s": 0.0}

    def count() -> Gadget:
        tries.append(now["s"])
        return made()

    slot._make = count
    for k in range(1000):
        now["s"] = k * 0.01
        slot.tick(now["s"])
    gaps = [b - a for a, b in pairwise(tries)]
    assert gaps[0] == pytest.approx(0.1, abs=0.02)
    assert max(gaps) == pytest.approx(2.0, abs=0.02)
    gadget.plugged = True
    slot.tick(now["s"] + 2.0)
    assert state(slot) == ("ok", "")


def test_a_device_that_vanishes_in_use_is_let_go(slot: Slot[Gadget], gadget: Gadget) -> None:
    slot.tick(0.0)
    with pytest.raises(DeviceAbsentError), slot.use():
        raise DeviceAbsentError("gadget at /dev/x: cable pulled")
    assert state(slot) == ("absent", "gadget at /dev/x: cable pulled")
    assert gadget.closed == 1


def test_a_silent_device_is_asked_once_more_before_it_is_let_go(slot: Slot[Gadget], gadget: Gadget) -> None:
    slot.tick(0.0)
    with pytest.raises(DeviceSilentError), slot.use():
        raise DeviceSilentError("gadget at /dev/x: no answer to a command")
    slot.tick(0.01)
    assert slot.present
    gadget.answers = False
    with pytest.raises(DeviceSilentError), slot.use() as device:
        device.ask()
    slot.tick(0.02)
    assert state(slot) == ("absent", "gadget at /dev/x: no answer")


def test_a_fault_keeps_the_device_and_shows_until_the_next_success(slot: Slot[Gadget]) -> None:
    slot.tick(0.0)
    with pytest.raises(DeviceFaultError), slot.use():
        raise DeviceFaultError("gadget at /dev/x: alarm 1")
    assert state(slot) == ("fault", "gadget at /dev/x: alarm 1")
    with slot.use():
        pass
    assert state(slot) == ("ok", "")


def test_a_device_that_cannot_be_prepared_stays_absent_and_closed(gadget: Gadget) -> None:
    def refuse(_device: Gadget) -> None:
        raise DeviceFaultError("gadget at /dev/x: wrong firmware")

    slot = Slot("gadget", lambda: gadget, prepare=refuse)
    slot.tick(0.0)
    assert state(slot) == ("absent", "gadget at /dev/x: wrong firmware")
    assert gadget.closed == 1


def test_a_closed_slot_opens_nothing_any_more(slot: Slot[Gadget], gadget: Gadget) -> None:
    slot.tick(0.0)
    slot.close()
    slot.tick(100.0)
    assert not slot.present
    assert (gadget.opened, gadget.closed) == (1, 1)
