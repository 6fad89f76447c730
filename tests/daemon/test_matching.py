"""Frames find their triggers by their ids; nothing is shifted, and what does not fit is marked."""

from __future__ import annotations

from dataclasses import dataclass, field

from hypothesis import given
from hypothesis import strategies as st

from echolume_daemon.matching import Armed, FrameMatcher, Verdict

TIMEOUT_S = 3.0


@dataclass
class Wire:
    """A trigger unit and one camera, played by hand; the clock is a number."""

    matcher: FrameMatcher = field(default_factory=FrameMatcher)
    now_s: float = 0.0
    pulses: int = 0
    camera_id: int = 50
    matched: dict[int, int] = field(default_factory=dict)
    """Trigger by pulse that really exposed the frame."""
    others: list[Verdict] = field(default_factory=list)

    def arm(self) -> int:
        """Arm and fire the next pulse; its trigger has the same number."""
        self.pulses += 1
        item = Armed("s", self.pulses, self.pulses, "light", 0, 0.004, True)
        self.matcher.arm(item, self.now_s + TIMEOUT_S)
        return self.pulses

    def expose(self) -> int:
        """The camera sees a pulse; its frame's id."""
        self.camera_id += 1
        return self.camera_id

    def deliver(self, frame_id: int, pulse: int) -> None:
        verdict, item = self.matcher.frame(frame_id, self.now_s)
        if item is None:
            self.others.append(verdict)
        else:
            self.matched[pulse] = item.trigger

    def shoot(self) -> int:
        """One trigger, and its frame at once."""
        pulse = self.arm()
        self.deliver(self.expose(), pulse)
        return pulse

    def wait_out(self) -> list[int]:
        """Let all deadlines pass; the triggers that are missing."""
        self.now_s += TIMEOUT_S + 0.01
        return [item.trigger for item in self.matcher.expire(self.now_s)]


def right(wire: Wire) -> bool:
    return all(pulse == trigger for pulse, trigger in wire.matched.items())


def test_frames_in_order_are_matched_in_order() -> None:
    wire = Wire()
    for _ in range(5):
        wire.shoot()
    assert wire.matched == {n: n for n in range(1, 6)}
    assert wire.matcher.proven


def test_a_lost_frame_is_missing_and_shifts_nobody() -> None:
    wire = Wire()
    wire.shoot()
    wire.arm()
    wire.expose()
    third = wire.arm()
    wire.deliver(wire.expose(), third)
    assert wire.wait_out() == [2]
    wire.shoot()
    assert wire.matched == {1: 1, 3: 3, 4: 4}
    assert not wire.matcher.revoked


def test_an_overtaken_frame_has_half_a_second() -> None:
    wire = Wire()
    wire.shoot()
    wire.arm(), wire.expose()
    third = wire.arm()
    wire.deliver(wire.expose(), third)
    wire.now_s += 0.51
    assert [item.trigger for item in wire.matcher.expire(wire.now_s)] == [2]


def test_swapped_frames_find_their_own_triggers() -> None:
    wire = Wire()
    wire.shoot()
    second, third = wire.arm(), wire.arm()
    a, b = wire.expose(), wire.expose()
    wire.deliver(b, third)
    wire.deliver(a, second)
    assert wire.matched == {1: 1, 2: 2, 3: 3}


def test_a_late_frame_still_belongs_to_its_trigger() -> None:
    wire = Wire()
    wire.shoot()
    second = wire.arm()
    frame = wire.expose()
    assert wire.wait_out() == [2]
    wire.deliver(frame, second)
    assert wire.matched == {1: 1, 2: 2}


def test_a_doubled_frame_is_a_duplicate() -> None:
    wire = Wire()
    wire.shoot()
    wire.deliver(wire.camera_id, 1)
    assert wire.others == [Verdict.DUPLICATE]


def test_a_frame_that_nobody_fired_is_extra() -> None:
    wire = Wire()
    wire.shoot()
    wire.deliver(wire.expose(), -1)
    assert wire.others == [Verdict.EXTRA]
    assert not wire.matcher.proven


def test_triggers_that_were_never_fired_can_be_taken_back() -> None:
    wire = Wire()
    wire.shoot()
    wire.arm()
    assert [item.trigger for item in wire.matcher.withdraw(1)] == [2]
    assert wire.matcher.outstanding == 0


def test_a_camera_that_misses_a_pulse_has_its_misassigned_frames_revoked() -> None:
    wire = Wire()
    wire.shoot()
    first = wire.arm()  # the camera does not see this pulse
    for _ in range(3):
        following = wire.arm()
        wire.deliver(wire.expose(), following)
    assert first == 2
    assert not right(wire)
    missing = wire.wait_out()
    assert missing == [5]
    for _ in range(2):
        pulse = wire.arm()
        wire.deliver(wire.expose(), pulse)
        wire.wait_out()
    revoked = {item.trigger for item in wire.matcher.revoked}
    wrong = {trigger for pulse, trigger in wire.matched.items() if pulse != trigger}
    assert wrong <= revoked
    pulse = wire.shoot()
    assert wire.matched[pulse] == pulse


@given(st.lists(st.sampled_from(["good", "drop", "double"]), max_size=40), st.integers(1, 4))
def test_dropped_and_doubled_frames_never_pair_wrongly(story: list[str], ahead: int) -> None:
    wire = Wire()
    dropped = set()
    flying: list[tuple[int, str, int]] = []

    def land() -> None:
        pulse, kind, frame = flying.pop(0)
        if kind == "drop":
            dropped.add(pulse)
            return
        wire.deliver(frame, pulse)
        if kind == "double":
            wire.deliver(frame, pulse)

    missing: list[int] = []
    for kind in story:
        if not wire.matcher.proven or len(flying) >= ahead:
            while flying:
                land()
            if wire.matcher.outstanding:
                missing += wire.wait_out()
        pulse = wire.arm()
        flying.append((pulse, kind, wire.expose()))
    while flying:
        land()
    missing += wire.wait_out()
    assert right(wire)
    assert sorted(missing) == sorted(dropped)
    assert set(wire.others) <= {Verdict.DUPLICATE, Verdict.EXTRA}
    assert len(wire.others) == story.count("double")
    assert not wire.matcher.revoked


def test_a_camera_opened_anew_gives_up_what_was_awaited_and_counts_from_anywhere() -> None:
    wire = Wire()
    wire.shoot()
    wire.arm()
    assert [item.trigger for item in wire.matcher.abandon()] == [2]
    wire.camera_id = 900
    pulse = wire.shoot()
    assert wire.matched[pulse] == pulse
