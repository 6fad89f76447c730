"""How records lie in the archive: channels, schemas, and the bytes of each message. Shared by writer and reader.

Camera frames are Foxglove's ``RawImage`` (protobuf) on ``/cameras/left`` with their header as JSON on
``/cameras/left/header``, written just before; every other record is one message on ``/<service>/<stream>``:
4 bytes little-endian header length, header JSON, NPY 1.0 bytes.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from echolume_messages import topics
from echolume_messages.bus.message import Message
from echolume_messages.codec import decode, decode_header, encode, encode_header
from echolume_messages.errors import PayloadError
from echolume_messages.header import Header
from echolume_messages.topics import Topic

Part = Literal["record", "header", "image"]

RECORD_SCHEMA = 1
HEADER_SCHEMA = 2
IMAGE_SCHEMA = 3
RECORD_TEXT = (
    b"4 bytes little-endian: length n of the header; n bytes: header, JSON text; the rest: the array, NPY 1.0 bytes."
)
CAMERA_TOPICS = (topics.CAMERA_LEFT, topics.CAMERA_RIGHT)

_IMAGE_HEAD = struct.Struct("<BIBIBI")
_WIDTH, _HEIGHT, _STEP, _TIME, _FRAME, _ENCODING, _DATA = 0x15, 0x1D, 0x2D, 0x0A, 0x3A, 0x22, 0x32
"""Protobuf tags of RawImage's fields."""


@dataclass(frozen=True)
class Channel:
    """One MCAP channel."""

    number: int
    name: str
    encoding: str
    schema: int
    topic: Topic
    part: Part


def _channels() -> tuple[Channel, ...]:
    out: list[Channel] = []
    for topic in topics.TOPICS:
        if not topic.recorded:
            continue
        name = f"/{topic.name}"
        if topic in CAMERA_TOPICS:
            out.append(Channel(len(out) + 1, f"{name}/header", "json", HEADER_SCHEMA, topic, "header"))
            out.append(Channel(len(out) + 1, name, "protobuf", IMAGE_SCHEMA, topic, "image"))
        else:
            out.append(Channel(len(out) + 1, name, "x-echolume-record", RECORD_SCHEMA, topic, "record"))
    return tuple(out)


CHANNELS = _channels()
CHANNEL_BY_NAME = {channel.name: channel for channel in CHANNELS}


def schemas() -> list[tuple[int, str, str, bytes]]:
    """(number, name, encoding, data) of the archive's schemas."""
    return [
        (RECORD_SCHEMA, "echolume.Record", "x-text", RECORD_TEXT),
        (HEADER_SCHEMA, "echolume.Header", "jsonschema", b'{"type":"object"}'),
        (IMAGE_SCHEMA, "foxglove.RawImage", "protobuf", raw_image_schema()),
    ]


def raw_image_schema() -> bytes:
    """Serialised FileDescriptorSet of ``foxglove.RawImage`` and what it imports."""
    from google.protobuf import descriptor_pb2, timestamp_pb2

    kind = descriptor_pb2.FieldDescriptorProto
    found = descriptor_pb2.FileDescriptorSet()
    timestamp_pb2.DESCRIPTOR.CopyToProto(found.file.add())
    image = found.file.add(
        name="foxglove/RawImage.proto",
        package="foxglove",
        syntax="proto3",
        dependency=["google/protobuf/timestamp.proto"],
    ).message_type.add(name="RawImage")
    for name, number, type_ in (
        ("timestamp", 1, kind.TYPE_MESSAGE),
        ("frame_id", 7, kind.TYPE_STRING),
        ("width", 2, kind.TYPE_FIXED32),
        ("height", 3, kind.TYPE_FIXED32),
        ("encoding", 4, kind.TYPE_STRING),
        ("step", 5, kind.TYPE_FIXED32),
        ("data", 6, kind.TYPE_BYTES),
    ):
        field = image.field.add(name=name, number=number, type=type_, label=kind.LABEL_OPTIONAL)
        if type_ == kind.TYPE_MESSAGE:
            field.type_name = ".google.protobuf.Timestamp"
    return found.SerializeToString()


def _varint(value: int) -> bytes:
    out = bytearray()
    while value > 0x7F:
        out.append(value & 0x7F | 0x80)
        value >>= 7
    out.append(value)
    return bytes(out)


def _length_delimited(tag: int, data: bytes) -> bytes:
    return bytes((tag,)) + _varint(len(data)) + data


def encode_image(frame: NDArray[np.generic], t_wall_ns: int, frame_id: str) -> bytes:
    """``foxglove.RawImage`` of a mono8 frame (rows, columns).

    Width and height come first and the pixels last, so that a reader without protobuf finds them:
    width at byte 1, height at byte 6 (little-endian uint32), the pixels at the end.
    """
    height, width = frame.shape
    seconds_s, nanoseconds_ns = divmod(t_wall_ns, 1_000_000_000)
    stamp = b"\x08" + _varint(seconds_s) + b"\x10" + _varint(nanoseconds_ns)
    pixels = np.ascontiguousarray(frame).reshape(-1).view(np.uint8)
    return b"".join(
        (
            _IMAGE_HEAD.pack(_WIDTH, width, _HEIGHT, height, _STEP, width),
            _length_delimited(_TIME, stamp),
            _length_delimited(_FRAME, frame_id.encode()),
            _length_delimited(_ENCODING, b"mono8"),
            bytes((_DATA,)) + _varint(pixels.size),
            pixels.data,
        )
    )


def decode_image(data: bytes | memoryview, topic: Topic) -> NDArray[np.generic]:
    """Frame (rows, columns) of a RawImage written by `encode_image`, a view of `data`."""
    if len(data) < _IMAGE_HEAD.size:
        raise PayloadError(f"{topic.name}: RawImage of {len(data)} bytes")
    width_tag, width, height_tag, height, step_tag, step = _IMAGE_HEAD.unpack_from(data)
    size = width * height
    if (width_tag, height_tag, step_tag, step) != (_WIDTH, _HEIGHT, _STEP, width) or size > len(data):
        raise PayloadError(f"{topic.name}: not a RawImage of this archive's layout")
    return np.frombuffer(data, dtype=np.uint8, offset=len(data) - size, count=size).reshape(height, width)


def encode_message(message: Message) -> list[tuple[int, bytes]]:
    """(channel number, bytes) of the MCAP messages of one record, in the order in which they are written."""
    name = f"/{message.topic.name}"
    header = encode_header(message.header)
    channel = CHANNEL_BY_NAME[name]
    if channel.part == "record":
        return [(channel.number, b"".join((len(header).to_bytes(4, "little"), header, encode(message.payload))))]
    image = encode_image(message.payload, message.header.t_wall_ns, message.topic.name)
    return [(CHANNEL_BY_NAME[f"{name}/header"].number, header), (channel.number, image)]


class Assembler:
    """Makes records of an archive's messages, fed in file order."""

    def __init__(self) -> None:
        self._headers: dict[str, Header] = {}

    def feed(self, channel: Channel, data: bytes | memoryview) -> Message | None:
        """The record that this message completes, or None."""
        topic = channel.topic
        if channel.part == "header":
            self._headers[topic.name] = decode_header(data)
            return None
        if channel.part == "image":
            header = self._headers.pop(topic.name, None)
            return None if header is None else Message(header, topic, decode_image(data, topic))
        length = int.from_bytes(data[:4], "little")
        return Message(decode_header(data[4 : 4 + length]), topic, decode(data[4 + length :], topic))
