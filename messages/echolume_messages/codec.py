"""Payloads as NPY 1.0 bytes, headers as JSON; everything from a peer is checked before memory is given to it."""

from __future__ import annotations

import ast
import math
import re
from functools import lru_cache

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import PayloadError
from echolume_messages.header import Header
from echolume_messages.topics import Topic

ENCODING = "application/x-npy"
MAGIC = b"\x93NUMPY\x01\x00"
ALIGN = 64
HEADER_LIMIT = 4096
"""Longest NPY header text accepted, in bytes."""
JSON_HEADER_LIMIT = 16384
"""Longest JSON header accepted, in bytes."""

# No operators, escapes or line breaks: what is left cannot do more to the parser than be wrong.
_PLAIN = re.compile(rb"[A-Za-z0-9_<>|=', :()\[\]{}]*\n")
_header_decoder = msgspec.json.Decoder(Header)
_header_encoder = msgspec.json.Encoder()


@lru_cache(maxsize=64)
def _descr(dtype: np.dtype[np.generic]) -> object:
    """What an NPY header says of a dtype."""
    return np.lib.format.dtype_to_descr(dtype)


@lru_cache(maxsize=512)
def _preamble(dtype: np.dtype[np.generic], shape: tuple[int, ...]) -> bytes:
    """Magic, version, length and header text, padded so that the data starts at a multiple of 64 bytes."""
    text = f"{{'descr': {_descr(dtype)!r}, 'fortran_order': False, 'shape': {shape!r}, }}".encode("ascii")
    pad = -(len(MAGIC) + 2 + len(text) + 1) % ALIGN
    length = len(text) + pad + 1
    return MAGIC + length.to_bytes(2, "little") + text + b" " * pad + b"\n"


def encode(array: NDArray[np.generic]) -> bytes:
    """NPY 1.0 bytes of an array, in C order.

    Parameters
    ----------
    array
        Any shape, any dtype without Python objects.

    Raises
    ------
    PayloadError
        The dtype holds Python objects.
    """
    if array.dtype.hasobject:
        raise PayloadError(f"cannot send an array of dtype {array.dtype}: it holds Python objects")
    flat = np.ascontiguousarray(array).reshape(-1).view(np.uint8)
    return b"".join((_preamble(array.dtype, array.shape), flat.data))


@lru_cache(maxsize=512)
def _parse_preamble(text: bytes) -> tuple[object, tuple[int, ...]]:
    """(descr, shape) of an NPY header text that promises C order."""
    if not _PLAIN.fullmatch(text):
        raise PayloadError("NPY header: not a plain literal on one line")
    try:
        found: object = ast.literal_eval(text.decode("ascii").strip())
    except (ValueError, SyntaxError, TypeError, MemoryError, RecursionError) as error:
        raise PayloadError(f"NPY header: cannot be read: {error}") from error
    if not isinstance(found, dict) or set(found) != {"descr", "fortran_order", "shape"}:
        raise PayloadError("NPY header: expected the keys descr, fortran_order and shape")
    if found["fortran_order"] is not False:
        raise PayloadError("NPY header: expected fortran_order False")
    shape: object = found["shape"]
    if not isinstance(shape, tuple) or not all(type(n) is int and n >= 0 for n in shape):
        raise PayloadError(f"NPY header: shape {shape!r} is not a tuple of lengths")
    return found["descr"], shape


def check_shape(shape: tuple[int, ...], topic: Topic) -> int:
    """Size in bytes of an array of `shape` on `topic`; PayloadError where the topic table does not allow it."""
    if len(shape) != len(topic.shape) or any(
        want is not None and got != want for got, want in zip(shape, topic.shape, strict=True)
    ):
        expected = tuple("n" if n is None else n for n in topic.shape)
        raise PayloadError(f"{topic.name}: expected shape {expected}, got {shape}")
    size = math.prod(shape) * topic.dtype.itemsize
    if size > topic.limit_bytes or max(shape, default=0) > topic.limit_bytes:
        raise PayloadError(f"{topic.name}: shape {shape} is beyond the limit of {topic.limit_bytes} bytes")
    return size


def check(array: NDArray[np.generic], topic: Topic) -> None:
    """Raise PayloadError unless `array` may be published on `topic`."""
    if array.dtype != topic.dtype:
        raise PayloadError(f"{topic.name}: expected dtype {topic.dtype}, got {array.dtype}")
    check_shape(array.shape, topic)


def decode(data: bytes | memoryview, topic: Topic) -> NDArray[np.generic]:
    """Array of an NPY payload, a read-only view of `data`.

    Magic, header, dtype, shape and the exact length are compared with the topic table before anything is allocated.

    Parameters
    ----------
    data
        NPY 1.0 bytes.
    topic
        Row of the topic table that the payload came on.

    Raises
    ------
    PayloadError
        The payload is not what the topic promises; the message names the topic, expected and seen.
    """
    start = len(MAGIC) + 2
    if bytes(data[: len(MAGIC)]) != MAGIC:
        raise PayloadError(f"{topic.name}: not an NPY 1.0 payload: starts with {bytes(data[: len(MAGIC)])!r}")
    length = int.from_bytes(data[len(MAGIC) : start], "little")
    offset = start + length
    if length > HEADER_LIMIT or len(data) < offset:
        raise PayloadError(f"{topic.name}: NPY header of {length} bytes in a payload of {len(data)} bytes")
    try:
        descr, shape = _parse_preamble(bytes(data[start:offset]))
    except PayloadError as error:
        raise PayloadError(f"{topic.name}: {error}") from error
    if descr != _descr(topic.dtype):
        raise PayloadError(f"{topic.name}: expected dtype {topic.dtype}, got {descr!r}")
    size = check_shape(shape, topic)
    if len(data) - offset != size:
        raise PayloadError(f"{topic.name}: shape {shape} needs {size} bytes, the payload holds {len(data) - offset}")
    if size == 0:
        return np.empty(shape, dtype=topic.dtype)
    return np.frombuffer(data, dtype=topic.dtype, offset=offset).reshape(shape)


def encode_header(header: Header) -> bytes:
    """JSON text of a header."""
    return _header_encoder.encode(header)


def decode_header(data: bytes | memoryview) -> Header:
    """Header of its JSON text; PayloadError names the path of what is wrong."""
    if len(data) > JSON_HEADER_LIMIT:
        raise PayloadError(f"header: {len(data)} bytes, at most {JSON_HEADER_LIMIT} are accepted")
    try:
        header = _header_decoder.decode(data)
    except (msgspec.DecodeError, UnicodeDecodeError) as error:
        raise PayloadError(f"header: {error}") from error
    if header.v != 1:
        raise PayloadError(f"header: version {header.v}, this program reads version 1")
    if header.seq < 0 or not header.boot:
        raise PayloadError(
            f"header: seq {header.seq} of boot {header.boot!r}: seq counts from 0 and boot is never empty"
        )
    return header


def json_array(obj: object) -> NDArray[np.uint8]:
    """UTF-8 JSON text of `obj` as a one-dimensional uint8 array, the payload of a JSON topic."""
    return np.frombuffer(msgspec.json.encode(obj), dtype=np.uint8)


def json_of(array: NDArray[np.generic]) -> object:
    """Object of a JSON topic's payload."""
    try:
        return msgspec.json.decode(array.tobytes())
    except (msgspec.DecodeError, UnicodeDecodeError, RecursionError) as error:
        raise PayloadError(f"JSON payload of {array.size} bytes: {error}") from error
