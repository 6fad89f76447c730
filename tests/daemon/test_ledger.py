"""The ledger: whatever is lost, doubled or reordered, its sums close."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from echolume_daemon.ledger import Expected, Ledger
from echolume_messages.plan import Step
from echolume_messages.topics import CAMERA_LEFT, CAMERA_RIGHT, ECHOES

LEFT, RIGHT, SOUND = CAMERA_LEFT.name, CAMERA_RIGHT.name, ECHOES.name
STEPS = [
    *(Step(i, "light", "optical", 0.004, guide_x_mm=float(i)) for i in range(3)),
    *(Step(i, "sound", "ultrasonic", pose=(0, 0, 150, 0, 0, 0)) for i in range(3, 6)),
]
triggers, attempts = st.integers(-1, 7), st.integers(0, 2)
records = st.tuples(st.sampled_from([LEFT, RIGHT, SOUND]), triggers, attempts)
events = st.one_of(
    st.tuples(st.just("fired"), st.tuples(triggers, attempts)),
    st.tuples(st.sampled_from(["durable", "lost", "revoked"]), records),
)


def tell(ledger: Ledger, story: list) -> None:
    for name, arguments in story:
        getattr(ledger, name)(*arguments)


@given(st.lists(events, max_size=60))
def test_the_sums_close_whatever_happens(story: list) -> None:
    ledger = Ledger(STEPS)
    tell(ledger, story)
    report = ledger.report("s", "incomplete", final=True)
    received = 0
    for name, entry in report["passes"].items():
        assert entry["planned"] == entry["matched"] + entry["missing"]
        assert entry["missing_triggers"] == [s.trigger for s in ledger.missing(name)]
        assert len(report["triggers"][name]) == entry["matched"]
        sums = entry["records"]
        assert sums["expected"] == sums["matched"] + sums["missing"]
        assert sums["received"] == sums["matched"] + sums["duplicate"] + sums["extra"]
        assert all(count >= 0 for count in sums.values())
        received += sums["received"]
    assert received + report["stray"] == report["acknowledged"]
    assert ledger.count()[2] == sum(len(t) for t in report["triggers"].values())


@given(
    st.lists(st.one_of(events), max_size=30).flatmap(lambda story: st.tuples(st.just(story), st.permutations(story)))
)
def test_the_order_in_which_it_is_told_does_not_matter(stories: tuple[list, list]) -> None:
    first, second = Ledger(STEPS), Ledger(STEPS)
    tell(first, stories[0])
    tell(second, stories[1])
    assert first.report("s", "incomplete", final=True) == second.report("s", "incomplete", final=True)
    assert first.open == second.open


@given(st.sets(st.tuples(st.sampled_from([LEFT, RIGHT]), st.integers(0, 2))), st.integers(1, 3))
def test_lost_frames_are_missing_and_doubled_ones_duplicate(lost: set, copies: int) -> None:
    ledger = Ledger(STEPS)
    for trigger in range(3):
        ledger.fired(trigger, 0)
        for topic in (LEFT, RIGHT):
            if (topic, trigger) in lost:
                ledger.lost(topic, trigger, 0)
            else:
                for _ in range(copies):
                    ledger.durable(topic, trigger, 0)
    entry = ledger.report("s", "incomplete", final=True)["passes"]["light"]
    assert entry["missing_triggers"] == sorted({trigger for _, trigger in lost})
    assert entry["duplicate"] == (6 - len(lost)) * (copies - 1)
    assert entry["extra"] == 0
    assert not ledger.open


def test_both_frames_of_a_match_are_of_one_attempt() -> None:
    ledger = Ledger(STEPS)
    ledger.fired(0, 0)
    ledger.durable(LEFT, 0, 0)
    ledger.lost(RIGHT, 0, 0)
    ledger.fired(0, ledger.next_attempt(0))
    ledger.durable(RIGHT, 0, 1)
    assert ledger.count() == (6, 2, 0)
    ledger.durable(LEFT, 0, 1)
    assert ledger.count() == (6, 2, 1)
    assert ledger.report("s", "incomplete", final=True)["attempts"] == {"0": 1}


def test_a_frame_that_comes_late_after_all_counts() -> None:
    ledger = Ledger(STEPS)
    ledger.fired(3, 0)
    assert ledger.open == {Expected(SOUND, 3, 0)}
    ledger.lost(SOUND, 3, 0)
    assert not ledger.open
    assert [s.trigger for s in ledger.missing("sound")] == [3, 4, 5]
    ledger.durable(SOUND, 3, 0)
    assert [s.trigger for s in ledger.missing("sound")] == [4, 5]


def test_a_revoked_frame_is_extra_and_its_trigger_missing() -> None:
    ledger = Ledger(STEPS)
    ledger.fired(0, 0)
    ledger.durable(LEFT, 0, 0)
    ledger.durable(RIGHT, 0, 0)
    ledger.revoked(LEFT, 0, 0)
    entry = ledger.report("s", "incomplete", final=True)["passes"]["light"]
    assert (entry["matched"], entry["extra"], entry["records"]["missing"]) == (0, 1, 1)


def test_records_of_no_planned_trigger_are_stray() -> None:
    ledger = Ledger(STEPS)
    ledger.durable(LEFT, 99, 0)
    ledger.durable("conductor/state", -1, 0)
    report = ledger.report("s", "incomplete", final=True)
    assert (report["stray"], report["acknowledged"]) == (1, 1)


def test_what_the_device_did_not_publish_is_counted_too() -> None:
    ledger = Ledger(STEPS)
    ledger.reported("light", "duplicate", 2)
    ledger.reported("light", "duplicate", 3)
    ledger.reported("light", "extra", 1)
    entry = ledger.report("s", "incomplete", final=True)["passes"]["light"]
    assert (entry["duplicate"], entry["extra"]) == (3, 1)
