"""The codec: what goes in comes out, and what lies is refused before memory is given to it."""

from __future__ import annotations

import io
import tracemalloc

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from echolume_messages import codec, topics
from echolume_messages.errors import PayloadError
from echolume_messages.header import Header, Source
from echolume_messages.topics import TOPICS, Topic

some_topic = st.sampled_from(TOPICS)
finite = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def arrays(draw: st.DrawFn) -> tuple[Topic, np.ndarray]:
    """An array that its topic allows, filled with any bytes."""
    topic = draw(some_topic)
    shape = tuple(draw(st.integers(0, 6)) if n is None else n for n in topic.shape)
    size = int(np.prod(shape)) * topic.dtype.itemsize
    data = draw(st.binary(min_size=size, max_size=size))
    return topic, np.frombuffer(data, dtype=topic.dtype).reshape(shape) if size else np.empty(shape, topic.dtype)


headers = st.builds(
    Header,
    stream=some_topic.map(lambda t: t.name),
    seq=st.integers(0, 2**62),
    t_ns=st.integers(0, 2**62),
    t_wall_ns=st.integers(0, 2**62),
    boot=st.text(min_size=1, max_size=12),
    scan=st.text(max_size=20),
    pass_name=st.text(max_size=20),
    trigger=st.integers(-1, 2**31),
    attempt=st.integers(0, 9),
    calibration=st.text(max_size=16),
    source=st.builds(
        Source,
        frame_id=st.none() | st.integers(0, 2**40),
        laser_on=st.none() | st.booleans(),
        x_mm=st.none() | finite,
        method=st.none() | st.text(max_size=8),
        robot_pose=st.none() | st.tuples(*[finite] * 6),
        air_temperature_c=st.none() | finite,
    ),
)


@given(arrays())
def test_every_array_of_the_table_comes_back_as_it_was(case: tuple[Topic, np.ndarray]) -> None:
    topic, array = case
    data = codec.encode(array)
    found = codec.decode(data, topic)
    assert found.dtype == array.dtype
    assert found.shape == array.shape
    assert found.tobytes() == array.tobytes()
    assert not found.flags.writeable or found.size == 0


@given(arrays())
def test_numpy_reads_what_is_sent_and_its_own_files_are_read(case: tuple[Topic, np.ndarray]) -> None:
    topic, array = case
    assert np.load(io.BytesIO(codec.encode(array)), allow_pickle=False).tobytes() == array.tobytes()
    file = io.BytesIO()
    np.save(file, array)
    assert codec.decode(file.getvalue(), topic).tobytes() == array.tobytes()


def test_arrays_that_are_not_contiguous_are_sent_in_c_order() -> None:
    array = np.arange(48, dtype="u1").reshape(6, 8)[::2, ::-1]
    np.testing.assert_array_equal(codec.decode(codec.encode(array), topics.CAMERA_LEFT), array)


@given(arrays(), st.data())
def test_a_truncated_payload_is_refused(case: tuple[Topic, np.ndarray], data: st.DataObject) -> None:
    topic, array = case
    whole = codec.encode(array)
    with pytest.raises(PayloadError):
        codec.decode(whole[: data.draw(st.integers(0, len(whole) - 1))], topic)
    with pytest.raises(PayloadError):
        codec.decode(whole + b"\0", topic)


@given(arrays(), st.data())
def test_a_payload_with_a_wrong_byte_in_its_head_never_passes_for_something_else(
    case: tuple[Topic, np.ndarray], data: st.DataObject
) -> None:
    topic, array = case
    whole = bytearray(codec.encode(array))
    at = data.draw(st.integers(0, len(whole) - array.nbytes - 1))
    whole[at] = data.draw(st.integers(0, 255).filter(lambda b: b != whole[at]))
    try:
        found = codec.decode(bytes(whole), topic)
    except PayloadError:
        return
    assert (found.dtype, found.size) == (array.dtype, array.size)


@given(some_topic, st.binary(max_size=300))
def test_noise_is_refused(topic: Topic, noise: bytes) -> None:
    assume(not noise.startswith(codec.MAGIC))
    with pytest.raises(PayloadError, match=topic.name):
        codec.decode(noise, topic)
    with pytest.raises(PayloadError):
        codec.decode(codec.MAGIC + noise, topic)


def lying(shape: str, descr: str = "'|u1'", fortran: str = "False", body: bytes = b"") -> bytes:
    text = f"{{'descr': {descr}, 'fortran_order': {fortran}, 'shape': {shape}, }}\n".encode()
    return codec.MAGIC + len(text).to_bytes(2, "little") + text + body


@pytest.mark.parametrize(
    "data",
    [
        lying("(1000000000, 1000000000)"),
        lying("(0, 99999999999999999999)"),
        lying("(4096, 4096)"),
        lying("(-1, 4)"),
        lying("(True, 4)"),
        lying("(2.0, 4)"),
        lying("(4,)"),
        lying("4"),
        lying("(" * 3000 + ")" * 3000),
        lying("(9" + "9" * 3900 + ", 1)"),
        lying("(2, 2)", descr="'|O'", body=b"abcd"),
        lying("(2, 2)", descr="'<f4'", body=bytes(16)),
        lying("(2, 2)", descr="[('a', '|u1')]", body=b"abcd"),
        lying("(2, 2)", fortran="True", body=b"abcd"),
        lying("(2, 2)", body=b"abc"),
        lying("(2, 2), 'more': 1", body=b"abcd"),
        lying("(2, 2)", descr="__import__('os')", body=b"abcd"),
        codec.MAGIC + b"\xff\xff" + b"x" * 70000,
    ],
)
def test_a_payload_that_lies_is_refused_before_memory_is_given_to_it(data: bytes) -> None:
    tracemalloc.start()
    try:
        with pytest.raises(PayloadError, match="cameras/left"):
            codec.decode(data, topics.CAMERA_LEFT)
        assert tracemalloc.get_traced_memory()[1] < 4 << 20
    finally:
        tracemalloc.stop()


def test_objects_are_not_sent() -> None:
    with pytest.raises(PayloadError, match="Python objects"):
        codec.encode(np.array([object()]))


@given(headers)
def test_every_header_comes_back_as_it_was(header: Header) -> None:
    assert codec.decode_header(codec.encode_header(header)) == header


@given(headers, st.data())
def test_a_truncated_header_is_refused(header: Header, data: st.DataObject) -> None:
    text = codec.encode_header(header)
    with pytest.raises(PayloadError, match="header"):
        codec.decode_header(text[: data.draw(st.integers(0, len(text) - 1))])


@settings(max_examples=100)
@given(headers, st.data())
def test_a_header_with_a_wrong_byte_is_refused_or_is_a_header(header: Header, data: st.DataObject) -> None:
    text = bytearray(codec.encode_header(header))
    text[data.draw(st.integers(0, len(text) - 1))] = data.draw(st.integers(0, 255))
    try:
        found = codec.decode_header(bytes(text))
    except PayloadError:
        return
    assert found.v == 1
    assert found.seq >= 0


@pytest.mark.parametrize(
    ("text", "named"),
    [
        (b'{"stream":"a/b","seq":0,"t_ns":0,"t_wall_ns":0,"boot":"x","colour":1}', "colour"),
        (b'{"stream":"a/b","seq":0,"t_ns":0,"t_wall_ns":0}', "boot"),
        (b'{"stream":"a/b","seq":"0","t_ns":0,"t_wall_ns":0,"boot":"x"}', r"\$\.seq"),
        (b'{"stream":"a/b","seq":0,"t_ns":0,"t_wall_ns":0,"boot":"x","source":{"x_mm":"far"}}', r"\$\.source\.x_mm"),
        (b'{"stream":"a/b","seq":-1,"t_ns":0,"t_wall_ns":0,"boot":"x"}', "seq -1"),
        (b'{"stream":"a/b","seq":0,"t_ns":0,"t_wall_ns":0,"boot":"x","v":2}', "version 2"),
        (b"[" * 20000, "at most"),
        (b"\xff\xfe", "header"),
    ],
)
def test_a_wrong_header_is_named(text: bytes, named: str) -> None:
    with pytest.raises(PayloadError, match=named):
        codec.decode_header(text)


@settings(max_examples=40)
@given(
    st.recursive(st.none() | st.booleans() | st.text() | finite, lambda v: st.lists(v) | st.dictionaries(st.text(), v))
)
def test_json_objects_come_back(obj: object) -> None:
    assert codec.json_of(codec.json_array(obj)) == obj


def test_text_that_is_no_json_is_refused() -> None:
    with pytest.raises(PayloadError, match="JSON payload"):
        codec.json_of(np.frombuffer(b"{nonsense", dtype="u1"))
