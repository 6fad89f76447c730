"""The one table of topics: what is published, of which type and shape, how often, recorded or not."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from echolume_messages import types

SHARDS = 16
"""Streams that belong to a trigger end in one more key chunk, ``trigger mod SHARDS``."""


@dataclass(frozen=True)
class Topic:
    """One row: a stream of one service.

    ``shape`` holds None where the length varies; ``limit_bytes`` bounds what a receiver accepts.
    """

    service: str
    stream: str
    dtype: np.dtype[np.generic]
    shape: tuple[int | None, ...]
    rate_hz: float
    recorded: bool
    triggered: bool
    live_decimation: int
    limit_bytes: int
    about: str

    @property
    def name(self) -> str:
        """``service/stream``, as in a header."""
        return f"{self.service}/{self.stream}"

    @property
    def is_json(self) -> bool:
        """Whether the array is the UTF-8 text of a JSON object."""
        return self.dtype == _U1 and len(self.shape) == 1


_U1 = np.dtype("u1")
_MIB = 1 << 20


def _json(service: str, stream: str, rate_hz: float, recorded: bool, about: str) -> Topic:
    """UTF-8 JSON text carried as a one-dimensional uint8 array."""
    return Topic(service, stream, _U1, (None,), rate_hz, recorded, False, 1, 4 * _MIB, about)


CAMERA_LEFT = Topic("cameras", "left", _U1, (None, None), 15, True, True, 4, 32 * _MIB, "raw frame of the left camera")
CAMERA_RIGHT = Topic(
    "cameras", "right", _U1, (None, None), 15, True, True, 4, 32 * _MIB, "raw frame of the right camera"
)
ECHOES = Topic(
    "array",
    "echoes",
    np.dtype("<i2"),
    (8, None),
    30,
    True,
    True,
    1,
    4 * _MIB,
    "raw echoes of one ping, 8 receivers",
)
RUN_STATE = _json("conductor", "state", 2, True, "run state, plan, pass, progress, prompt")
LEDGER = _json("conductor", "ledger", 0.1, True, "the scan's ledger when a pass or the scan ends")
SCAN_START = _json("conductor", "start", 0.01, True, "scan id, plan and calibration at the start of a scan")
DURABLE = _json("recorder", "durable", 20, False, "highest durable seq per stream, and triggers made durable since")
OPTICAL_POINTS = Topic(
    "optical", "points", types.OPTICAL_POINT, (None,), 15, False, True, 1, 16 * _MIB, "points of one stripe"
)
ULTRASONIC_POINTS = Topic(
    "ultrasonic",
    "points",
    types.ULTRASONIC_POINT,
    (None,),
    30,
    False,
    True,
    1,
    1 * _MIB,
    "contact points of one ping",
)
HYBRID_MAP = Topic(
    "hybrid", "map", types.MAP_CELL, (None,), 0.01, False, False, 1, 128 * _MIB, "cells of the hybrid map"
)
HYBRID_GROWING = Topic(
    "hybrid",
    "growing",
    types.MAP_CELL,
    (None,),
    0.5,
    False,
    False,
    1,
    64 * _MIB,
    "cells of the map of what came so far, by the footprint gate",
)
HYBRID_DONE = _json("hybrid", "done", 0.01, False, "the map is written: files, digest, counts, lag")


def health(service: str) -> Topic:
    """Health of one service: queue depths, drops, loop ages, errors."""
    return _json(service, "health", 1, False, f"health of {service}")


SERVICES = ("router", "guide", "cameras", "robot", "array", "recorder", "conductor")
"""The rig's services, in the order in which they start."""
SUBSCRIBERS = ("optical", "ultrasonic", "hybrid")
"""The lab's subscribers."""

TOPICS: tuple[Topic, ...] = (
    CAMERA_LEFT,
    CAMERA_RIGHT,
    ECHOES,
    RUN_STATE,
    LEDGER,
    SCAN_START,
    DURABLE,
    OPTICAL_POINTS,
    ULTRASONIC_POINTS,
    HYBRID_MAP,
    HYBRID_GROWING,
    HYBRID_DONE,
    *(health(s) for s in (*SERVICES[1:], *SUBSCRIBERS)),
)

BY_NAME: dict[str, Topic] = {t.name: t for t in TOPICS}

PASS_STREAMS: dict[str, tuple[Topic, ...]] = {
    "snap": (CAMERA_LEFT, CAMERA_RIGHT),
    "optical": (CAMERA_LEFT, CAMERA_RIGHT),
    "ultrasonic": (ECHOES,),
}
"""Streams that each trigger of a pass must produce exactly once."""


def key(rig: str, tree: str, topic: Topic, trigger: int = -1) -> str:
    """Key expression of a record: ``echolume/v1/<rig>/<tree>/<service>/<stream>[/<shard>]``."""
    base = f"echolume/v1/{rig}/{tree}/{topic.name}"
    return f"{base}/{trigger % SHARDS}" if topic.triggered else base


def key_all(rig: str, tree: str, topic: Topic) -> str:
    """Key expression that matches every record of the topic."""
    base = f"echolume/v1/{rig}/{tree}/{topic.name}"
    return f"{base}/*" if topic.triggered else base


def keys_decimated(rig: str, tree: str, topic: Topic) -> list[str]:
    """Key expressions that match every `live_decimation`-th trigger of the topic, and few others."""
    if not topic.triggered:
        return [key_all(rig, tree, topic)]
    every = math.gcd(topic.live_decimation, SHARDS)
    return [key(rig, tree, topic, shard) for shard in range(0, SHARDS, every)]


def command_key(rig: str, service: str, command: str) -> str:
    """Key of a command, e.g. ``echolume/v1/demo/cmd/guide/expose``."""
    return f"echolume/v1/{rig}/cmd/{service}/{command}"


def alive_key(rig: str, service: str) -> str:
    """Key of a service's liveliness token."""
    return f"echolume/v1/{rig}/alive/{service}"
