"""The one table of topics holds together."""

from __future__ import annotations

import numpy as np
import pytest

from echolume_messages import codec, topics
from echolume_messages.archive_format import CHANNELS
from echolume_messages.topics import BY_NAME, PASS_STREAMS, SHARDS, TOPICS, Topic

names = pytest.mark.parametrize("topic", TOPICS, ids=lambda t: t.name)


def test_names_and_keys_are_unique() -> None:
    assert len(BY_NAME) == len(TOPICS)
    assert len({topics.key("r", "data", topic) for topic in TOPICS}) == len(TOPICS)


@names
def test_a_row_makes_sense(topic: Topic) -> None:
    assert topic.name == topic.name.lower()
    assert all(n is None or n > 0 for n in topic.shape)
    assert topic.rate_hz > 0
    assert topic.live_decimation >= 1
    assert topic.about
    assert not topic.dtype.hasobject
    least = topic.dtype.itemsize * int(np.prod([n or 1 for n in topic.shape]))
    assert least <= topic.limit_bytes <= 128 << 20


@names
def test_the_smallest_array_of_a_row_is_allowed(topic: Topic) -> None:
    array = np.zeros([n or 1 for n in topic.shape], topic.dtype)
    codec.check(array, topic)
    assert codec.decode(codec.encode(array), topic).shape == array.shape


@names
def test_dtypes_are_little_endian(topic: Topic) -> None:
    for dtype in [topic.dtype[n] for n in topic.dtype.names or ()] or [topic.dtype]:
        assert dtype.str[0] in "<|"


def test_triggered_streams_end_in_their_shard() -> None:
    for topic in TOPICS:
        keys = {topics.key("r", "data", topic, k) for k in range(3 * SHARDS)}
        assert len(keys) == (SHARDS if topic.triggered else 1)
        assert all(key.startswith(f"echolume/v1/r/data/{topic.name}") for key in keys)


def test_both_cameras_of_a_trigger_share_a_shard() -> None:
    left, right = (topics.key("r", "data", t, 37) for t in (topics.CAMERA_LEFT, topics.CAMERA_RIGHT))
    assert left.rsplit("/", 1)[1] == right.rsplit("/", 1)[1] == "5"


def test_streams_of_a_trigger_are_recorded() -> None:
    assert all(t.recorded and t.triggered for streams in PASS_STREAMS.values() for t in streams)


def test_every_recorded_topic_has_its_channels() -> None:
    assert {c.topic.name for c in CHANNELS} == {t.name for t in TOPICS if t.recorded}
    assert len({c.name for c in CHANNELS}) == len({c.number for c in CHANNELS}) == len(CHANNELS)
