"""What is kept of a scan for its reviewer: a bounded number of frames, times, and what was reported."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from echolume_drivers.emulated.array_truth import array_truth
from echolume_messages import plan as plans
from echolume_messages import topics
from echolume_messages.bus import Message
from echolume_messages.codec import json_array
from echolume_messages.header import Header, Source
from echolume_messages.rig import ArraySettings
from echolume_processing import review
from echolume_processing.review import Review
from processing.hybrid_scan import calibration_of

PLAN = """
name = "{name}"
[map]
x_mm = [-3.0, 3.0]
y_mm = [-20.0, 20.0]
[[pass]]
name = "light"
kind = "optical"
start_mm = 0.0
stop_mm = {stop_mm}
pitch_mm = 1.0
"""
FRAME = np.arange(64, dtype=np.uint8).reshape(8, 8)  # of the calibration's size


def plan(stripes: int) -> plans.Plan:
    return plans.parse(PLAN.format(name="p", stop_mm=float(stripes - 1)))


@pytest.fixture
def kept() -> Review:
    settings = ArraySettings(port="")
    return Review.of(plan(40), calibration_of(settings, array_truth(1, settings), np.random.default_rng(1)))


def message(topic: topics.Topic, payload: np.ndarray, trigger: int = -1, attempt: int = 0, t_ns: int = 5) -> Message:
    header = Header(
        stream=topic.name, seq=0, t_ns=t_ns, t_wall_ns=1, boot="b", scan="s", trigger=trigger, attempt=attempt,
        source=Source(x_mm=1.5),
    )  # fmt: skip
    return Message(header, topic, payload)


def told(kept: Review, topic: topics.Topic, body: dict[str, Any]) -> list[tuple[str, str]]:
    kept.add_report(message(topic, json_array(body)))
    return [(line.level, line.text) for line in kept.lines]


def test_the_topic_table_says_which_frames_are_kept(kept: Review) -> None:
    for trigger in range(9):
        wanted = trigger % topics.CAMERA_LEFT.live_decimation == 0
        assert kept.add_frame(message(topics.CAMERA_LEFT, FRAME, trigger)) is wanted
    assert sorted(kept.pictures) == [("left", 0), ("left", 4), ("left", 8)]
    shown = cv2.imdecode(np.frombuffer(kept.pictures["left", 4].jpeg, dtype=np.uint8), cv2.IMREAD_GRAYSCALE)
    np.testing.assert_allclose(shown, FRAME, atol=4)


def test_a_long_plan_keeps_fewer_of_its_triggers(monkeypatch: pytest.MonkeyPatch, kept: Review) -> None:
    monkeypatch.setattr(review, "MOST_PICTURES", 5)
    long = Review.of(plan(100), kept.calibration)
    assert sum(long.add_frame(message(topics.CAMERA_RIGHT, FRAME, trigger)) for trigger in range(100)) == 5


@pytest.mark.parametrize("shape", [(8, 9), (4, 8), (0, 0), (1, 64)])
def test_a_frame_of_another_size_is_not_kept(kept: Review, shape: tuple[int, int]) -> None:
    assert not kept.add_frame(message(topics.CAMERA_LEFT, np.zeros(shape, dtype=np.uint8), 4))
    assert not kept.pictures


def test_frames_without_a_trigger_are_not_kept(kept: Review) -> None:
    assert not kept.add_frame(message(topics.CAMERA_LEFT, FRAME, -4))


def test_of_a_triggers_attempts_the_latest_counts(kept: Review) -> None:
    for attempt, wanted in ((1, True), (0, False), (2, True), (1, False)):
        own = message(topics.CAMERA_LEFT, FRAME, 4, attempt, t_ns=attempt)
        assert kept.add_frame(own) is wanted
        kept.add_moment(own.header)
    assert kept.pictures["left", 4].t_ns == 2
    assert kept.moments[4] == review.Moment(2, 2, 1.5)


def test_a_run_state_is_a_line_only_when_it_changes(kept: Review) -> None:
    told(kept, topics.RUN_STATE, {"state": "running", "pass": "light", "fired": 1})
    told(kept, topics.RUN_STATE, {"state": "running", "pass": "light", "fired": 2})
    lines = told(kept, topics.RUN_STATE, {"state": "failed", "error": "the guide stands"})
    assert lines == [("INFO", "running; pass light"), ("ERROR", "failed; the guide stands")]


def test_an_incomplete_final_ledger_is_an_error_in_the_log(kept: Review) -> None:
    passes = {"light": {"planned": 3, "matched": 2}}
    told(kept, topics.LEDGER, {"final": False, "outcome": "incomplete", "passes": passes})
    lines = told(kept, topics.LEDGER, {"final": True, "outcome": "incomplete", "passes": passes})
    assert lines == [
        ("INFO", "ledger, so far: matched light 2 of 3"),
        ("ERROR", "ledger, incomplete: matched light 2 of 3"),
    ]


def test_a_report_that_cannot_be_read_is_named_in_the_log(kept: Review) -> None:
    ((level, text),) = told(kept, topics.LEDGER, {"passes": {"light": {"planned": "many"}}})
    assert level == "WARN"
    assert "conductor/ledger seq 0" in text
    assert "$.passes" in text
    assert kept.ledger is None


def test_the_log_is_bounded(monkeypatch: pytest.MonkeyPatch, kept: Review) -> None:
    monkeypatch.setattr(review, "MOST_LINES", 3)
    for k in range(9):
        told(kept, topics.RUN_STATE, {"state": f"s{k}"})
    assert [line.text for line in kept.lines] == ["s0", "s1", "s2"]
