"""The journal is bounded and answers in order; the tracker says what is missing."""

from __future__ import annotations

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from echolume_messages import topics
from echolume_messages.bus.journal import KEEP_BYTES, KEEP_RECORDS, REPLY_BYTES, Journal, Record
from echolume_messages.bus.message import Message
from echolume_messages.bus.tracker import ATTEMPTS_PROMISED, Track
from echolume_messages.header import Header


def record(seq: int, size: int, t_ns: int = 0) -> Record:
    return Record("key", seq, t_ns, b"", bytes(size))


def message(seq: int) -> Message:
    header = Header(stream="array/echoes", seq=seq, t_ns=0, t_wall_ns=0, boot="b")
    return Message(header, topics.ECHOES, np.zeros((8, 0), "<i2"))


@given(st.lists(st.tuples(st.sampled_from("ab"), st.integers(0, 5000)), max_size=60))
def test_a_journal_never_holds_more_than_its_limit_and_one_record_a_stream(puts: list[tuple[str, int]]) -> None:
    journal = Journal(5.0, 10_000)
    for seq, (stream, size) in enumerate(puts):
        journal.add(stream, record(seq, size))
        assert journal.span(stream) is not None
        assert journal.size <= 10_000 + 5000


def test_old_records_of_a_fast_stream_go_and_those_of_a_slow_one_stay() -> None:
    journal = Journal(1.0, 1 << 30)
    for seq in range(10):
        journal.add("fast", record(seq, KEEP_BYTES, t_ns=seq * 500_000_000))
        journal.add("slow", record(seq, 10, t_ns=seq * 500_000_000))
    assert journal.span("fast") == (7, 9)
    assert journal.span("slow") == (0, 9)
    for seq in range(10, 10 + 2 * KEEP_RECORDS):
        journal.add("slow", record(seq, 10, t_ns=seq * 500_000_000))
    assert journal.count("slow") == KEEP_RECORDS


def test_an_answer_is_the_oldest_of_what_was_asked_and_bounded() -> None:
    journal = Journal(5.0, 1 << 30)
    for seq in range(40):
        journal.add("s", record(seq, REPLY_BYTES // 4))
    assert [r.seq for r in journal.select("s", 5, 30)] == [5, 6, 7, 8]
    assert [r.seq for r in journal.select("s", 5, 6)] == [5, 6]
    assert journal.select("s", 40, 50) == []
    assert journal.select("other", 0, 9) == []


@given(st.permutations(range(8)))
def test_records_leave_in_order_however_they_come(order: list[int]) -> None:
    track = Track("array/echoes", "b")
    out: list[int] = []
    for seq in order:
        track.notice(seq, 0)
        assert track.wants(seq)
        track.held[seq] = message(seq)
        while track.ready():
            out.append(track.pop().header.seq)
        gap = track.gap()
        assert gap is None or (gap[0] == len(out) and not any(gap[0] <= s <= gap[1] for s in track.held))
        assert not track.wants(seq)
    assert out == list(range(8))
    assert track.gap() is None


def test_what_came_before_the_subscription_is_not_lost_and_what_came_after_is() -> None:
    track = Track("array/echoes", "b")
    track.notice(100, 0)
    assert track.gap() == (0, 100)
    assert track.step_over(96) == 0
    assert track.gap() == (96, 100)
    assert track.step_over(101) == 5


def test_a_gap_is_asked_for_a_bounded_number_of_times() -> None:
    track = Track("array/echoes", "b")
    track.notice(3, 0)
    now_ns, asked = 0, 0
    while track.later(now_ns, ATTEMPTS_PROMISED):
        assert now_ns < track.due_ns <= now_ns + 10**9
        now_ns, asked = track.due_ns, asked + 1
    assert asked == ATTEMPTS_PROMISED - 1
