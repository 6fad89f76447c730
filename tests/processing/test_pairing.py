"""Joining the two cameras' streams: order, losses, and a camera that runs ahead."""

from __future__ import annotations

from collections import deque

import numpy as np

from echolume_messages import topics
from echolume_messages.bus import Message
from echolume_messages.header import Header
from echolume_messages.topics import Topic
from echolume_processing.subscribers.pairing import MAX_WAITING, PATIENCE_S, Pairs


class Stream:
    """A camera's subscription with frames of the given triggers at hand."""

    def __init__(self, topic: Topic, triggers: list[int]) -> None:
        self.frames = deque(
            Message(
                Header(stream=topic.name, seq=k, t_ns=0, t_wall_ns=0, boot="b", scan="s", trigger=trigger),
                topic,
                np.zeros((2, 2), np.uint8),
            )
            for k, trigger in enumerate(triggers)
        )
        self.taken = 0

    def get(self, timeout_s: float) -> Message | None:
        if not self.frames:
            return None
        self.taken += 1
        return self.frames.popleft()


def joined(pairs: Pairs, tries: int = 400) -> list[int]:
    found = [pairs.get(0.0) for _ in range(tries)]
    assert all(p[0].topic is topics.CAMERA_LEFT and p[1].topic is topics.CAMERA_RIGHT for p in found if p)
    assert all(p[0].header.trigger == p[1].header.trigger for p in found if p)
    return [p[0].header.trigger for p in found if p]


def streams(left: list[int], right: list[int]) -> tuple[Stream, Stream]:
    return Stream(topics.CAMERA_LEFT, left), Stream(topics.CAMERA_RIGHT, right)


def test_whole_streams_pair_completely() -> None:
    left, right = streams(list(range(100)), list(range(100)))
    assert joined(Pairs(left, right)) == list(range(100))


def test_lost_frames_cost_only_their_own_trigger() -> None:
    left, right = streams([k for k in range(60) if k != 7], [k for k in range(60) if k not in (20, 21)])
    pairs = Pairs(left, right)
    assert joined(pairs) == [k for k in range(60) if k not in (7, 20, 21)]
    assert pairs.unpaired == 3


def test_a_camera_that_is_held_back_is_waited_for() -> None:
    left, right = streams(list(range(100)), [])
    pairs = Pairs(left, right)
    assert joined(pairs) == []
    assert left.taken == MAX_WAITING
    right.frames.extend(streams([], list(range(100)))[1].frames)
    assert joined(pairs) == list(range(100))
    assert pairs.unpaired == 0


def test_what_waits_in_vain_is_given_up_and_counted() -> None:
    left, right = streams(list(range(5)), [])
    clock = [0.0]
    pairs = Pairs(left, right, lambda: clock[0])
    assert joined(pairs) == []
    clock[0] = PATIENCE_S + 1
    assert pairs.get(0.0) is None
    assert pairs.unpaired == 5
