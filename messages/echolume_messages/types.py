"""Array types of the messages: structured dtypes, label and provenance codes."""

from __future__ import annotations

from enum import IntEnum, IntFlag
from typing import TypeAlias

import numpy as np
from numpy.typing import NDArray

Structured: TypeAlias = NDArray[np.void]
Frame: TypeAlias = NDArray[np.uint8]
"""A camera frame, shape (rows, columns)."""
EchoBlock: TypeAlias = NDArray[np.int16]
"""One ping, shape (8 receivers, samples), in digitiser counts."""


class OpticalSource(IntEnum):
    """How an optical point was triangulated."""

    STEREO = 1
    ACTIVE_LEFT = 2
    ACTIVE_RIGHT = 3


class Provenance(IntFlag):
    """Which senses a map cell rests on."""

    NONE = 0
    STEREO = 1
    ACTIVE_LEFT = 2
    ACTIVE_RIGHT = 4
    ULTRASONIC = 8
    FILLED = 16


class Label(IntEnum):
    """What a map cell is."""

    UNKNOWN = 0
    MATTE = 1
    TRANSPARENT = 2
    ABSORBING = 3
    OCCLUDED = 4


class EchoKind(IntEnum):
    """Which closed-form model explains a ping best."""

    NONE = 0
    PLANE = 1
    POINT = 2


OPTICAL_POINT = np.dtype(
    [
        ("x_mm", "<f4"),
        ("y_mm", "<f4"),
        ("z_mm", "<f4"),
        ("sigma_z_mm", "<f4"),
        ("source", "u1"),  # OpticalSource
        ("flags", "u1"),  # bit 0: saturated; bit 1: both cameras see it
        ("row", "<u2"),  # image row in the camera that saw it (left for stereo)
    ]
)
"""A point of one stripe, rig frame. A stripe publishes all three sets: ST, AT-left and AT-right."""

ULTRASONIC_POINT = np.dtype(
    [
        ("x_mm", "<f4"),
        ("y_mm", "<f4"),
        ("z_mm", "<f4"),
        ("nx", "<f4"),
        ("ny", "<f4"),
        ("nz", "<f4"),
        ("sigma_mm", "<f4"),
        ("xx_mm2", "<f4"),  # covariance of the place, rig frame: noise, air and the robot's repeatability
        ("xy_mm2", "<f4"),
        ("xz_mm2", "<f4"),
        ("yy_mm2", "<f4"),
        ("yz_mm2", "<f4"),
        ("zz_mm2", "<f4"),
        ("path_mm", "<f4"),
        ("energy", "<f4"),
        ("lobes", "u1"),
        ("receiver", "u1"),  # 0..7
        ("kind", "u1"),  # EchoKind
    ]
)
"""A contact point of one receiver of one ping, rig frame, normal towards the array.

The covariance is not a number where no surface explains the ping, infinite along what the array's layout leaves open,
and without what the calibration leaves uncertain, which is the same for all pings."""

NO_TRIGGER = 0xFFFFFFFF
"""Stands where a cell names no trigger: they are numbered from 0."""

MAP_CELL = np.dtype(
    [
        ("ix", "<i2"),
        ("iy", "<i2"),
        ("front_mm", "<f4"),  # height of what is in front (glass: its top)
        ("behind_mm", "<f4"),  # height of what light sees behind it; nan unless transparent
        ("sigma_mm", "<f4"),
        ("label", "u1"),  # Label
        ("provenance", "u1"),  # Provenance
        ("optical_n", "<u2"),  # optical points in the cell
        ("ultrasonic_n", "<u2"),  # pings that the cell's height rests on
        ("probability", "<f4"),  # that the label is right; 0 for UNKNOWN, nan where nobody said
        ("stripe_first", "<u4"),  # lowest trigger of the stripes with points in the cell; NO_TRIGGER: none is known
        ("stripe_last", "<u4"),  # highest of them
        ("ping", "<u4"),  # trigger of the ping nearest to the cell of those that explain it; NO_TRIGGER: none
    ]
)
"""A cell of the hybrid map; x_mm = x0_mm + (ix + 0.5) cell_mm, likewise y."""
