"""The JSON header that travels beside each payload."""

from __future__ import annotations

import msgspec


class Source(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True):
    """What the device said of this record. Unknown values are absent, never zero."""

    frame_id: int | None = None
    device_t_ns: int | None = None
    exposure_s: float | None = None
    laser_on: bool | None = None
    x_mm: float | None = None
    sigma_mm: float | None = None
    method: str | None = None
    robot_pose: tuple[float, float, float, float, float, float] | None = None
    """Reached axes: x, y, z in mm, rx, ry, rz in rad; ``geometry.robot_from_flange`` makes a transform of it."""
    pose_sigma_mm: float | None = None
    sample_rate_hz: float | None = None
    start_s: float | None = None
    """Time of the first sample after the emission."""
    volts_per_count: float | None = None
    air_temperature_c: float | None = None


class Header(msgspec.Struct, omit_defaults=True, forbid_unknown_fields=True, rename={"pass_name": "pass"}):
    """Header of a record: who, when, of which scan and trigger."""

    stream: str
    """``service/stream``, e.g. ``cameras/left``."""
    seq: int
    t_ns: int
    """CLOCK_MONOTONIC of the capture."""
    t_wall_ns: int
    boot: str
    v: int = 1
    scan: str = ""
    pass_name: str = ""
    trigger: int = -1
    """Number of the trigger within the scan; -1 where the stream belongs to none."""
    attempt: int = 0
    calibration: str = ""
    source: Source = msgspec.field(default_factory=Source)
