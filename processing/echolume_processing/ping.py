"""One ultrasonic ping as `processing` sees it: raw counts, where the robot stood, and the air."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from echolume_messages.geometry import require_shape
from echolume_messages.header import Header
from echolume_messages.types import EchoBlock


@dataclass(frozen=True)
class Ping:
    """Raw echoes of one emission.

    `echoes` are digitiser counts (receivers, samples), int16; `robot_pose` holds the reached axes x, y, z in mm and
    rx, ry, rz in rad; the first sample was taken `start_s` after the emission.
    """

    trigger: int
    echoes: EchoBlock
    robot_pose: NDArray[np.float64]
    sample_rate_hz: float
    start_s: float
    air_temperature_c: float

    def __post_init__(self) -> None:
        require_shape("echoes", self.echoes, (None, None))
        require_shape("robot_pose", self.robot_pose, (6,))


def ping_from_record(header: Header, echoes: EchoBlock) -> Ping:
    """Build a ping from a record of the topic ``array/echoes``.

    Raises
    ------
    ValueError
        If the header lacks the robot pose, the sample rate, the start or the air temperature.
    """
    source = header.source
    if (
        source.robot_pose is None
        or source.sample_rate_hz is None
        or source.start_s is None
        or source.air_temperature_c is None
    ):
        raise ValueError(
            f"{header.stream} trigger {header.trigger}: its header must carry robot_pose, sample_rate_hz, start_s and "
            f"air_temperature_c, got {source}"
        )
    return Ping(
        header.trigger,
        echoes,
        np.array(source.robot_pose, dtype=np.float64),
        source.sample_rate_hz,
        source.start_s,
        source.air_temperature_c,
    )
