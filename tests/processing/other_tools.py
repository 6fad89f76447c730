"""Echoes by somebody else's code: points by PyMUST's simus3, a rigid wall by pyroomacoustics; and their delays."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

import numpy as np
import pyroomacoustics
from scipy.optimize import minimize_scalar

from echolume_messages.geometry import rotation_from_vector

with warnings.catch_warnings():
    # Its docstrings hold a "\m" outside raw strings; Python says so each time that it compiles them.
    warnings.filterwarnings("ignore", message="invalid escape sequence", category=DeprecationWarning)
    warnings.filterwarnings("ignore", message="invalid escape sequence", category=SyntaxWarning)
    import pymust

SPEED_MPS = 343.2
RECEIVERS_MM = np.array([[x, y, 0.0] for y in (-37.5, 0.0, 37.5) for x in (-37.5, 0.0, 37.5) if (x, y) != (0.0, 0.0)])
"""Eight receivers about an emitter at the origin."""
CARRIER_HZ = 40e3
POINT_RATE_HZ = 12 * CARRIER_HZ
"""simus3 puts its spectrum on a grid of which only multiples of twice the carrier are exactly the rate asked for."""
FASTER = 100.0
"""simus3 samples its pulse each nanosecond; with sound and carrier a hundred times as fast that is enough of them."""
ROOM_RATE_HZ = 500e3
ROOM_OFFSET_S = 80e-6
"""Half the 81 taps by which pyroomacoustics places a reflection between samples, at 500 kHz."""
ROOM_M = 6.0
SAMPLES = 4096


def point_echoes(point_mm: np.ndarray) -> np.ndarray:
    """Echoes (8, SAMPLES) float32 of a point at (3,), a burst of four cycles of 40 kHz, at POINT_RATE_HZ."""
    elements = np.vstack([np.zeros(3), RECEIVERS_MM])
    param = pymust.utils.Param()
    param.fc, param.fs, param.c = FASTER * CARRIER_HZ, FASTER * POINT_RATE_HZ, FASTER * SPEED_MPS
    param.elements = 1e-3 * elements[:, :2].T
    param.width = param.height = 2e-3
    param.bandwidth, param.TXnow = 60, 4
    # The emitter alone sounds. Delays that are not numbers, its own way of saying so, crash simus3.
    param.TXapodization = np.eye(1, 9)
    x, y, z = (np.array([[1e-3 * v]]) for v in point_mm)
    heard = np.asarray(pymust.simus3(x, y, z, np.ones((1, 1)), np.zeros((1, 9)), param)[0])[:, 1:].T
    out = np.zeros((8, SAMPLES), dtype=np.float32)
    out[:, : heard.shape[1]] = heard / np.abs(heard).max()
    return out


@dataclass(frozen=True)
class Wall:
    """A rigid wall before the array, as pyroomacoustics hears it."""

    responses: np.ndarray
    """Impulse responses (8, SAMPLES) at ROOM_RATE_HZ, direct sound left out; late by ROOM_OFFSET_S."""
    distance_mm: float
    normal: np.ndarray
    """Towards the array, in its frame, (3,)."""


def wall(distance_mm: float, turn_deg: tuple[float, float, float]) -> Wall:
    """A rigid floor below the array, which looks down and is then turned by a rotation vector."""
    silent = pyroomacoustics.Material(1.0)
    materials = dict.fromkeys(("east", "west", "north", "south", "ceiling"), silent)
    materials["floor"] = pyroomacoustics.Material(0.0)
    room = pyroomacoustics.ShoeBox([ROOM_M] * 3, fs=int(ROOM_RATE_HZ), materials=materials, max_order=1)
    room.set_sound_speed(SPEED_MPS)
    emitter = np.array([ROOM_M / 2, ROOM_M / 2, 1e-3 * distance_mm])
    room_from_array = rotation_from_vector(np.radians(turn_deg)) @ np.diag([1.0, -1.0, -1.0])
    room.add_source(emitter)
    room.add_microphone_array(emitter[:, None] + 1e-3 * room_from_array @ RECEIVERS_MM.T)
    room.compute_rir()
    out = np.zeros((8, SAMPLES))
    for k, receiver_mm in enumerate(RECEIVERS_MM):
        direct_s = 1e-3 * np.linalg.norm(receiver_mm) / SPEED_MPS
        gone = int((direct_s + 2.2 * ROOM_OFFSET_S) * ROOM_RATE_HZ)
        out[k, gone:] = room.rir[k][0][gone:SAMPLES]
    return Wall(out, distance_mm, room_from_array.T @ [0.0, 0.0, 1.0])


def delays_s(of: np.ndarray, behind: np.ndarray, rate_hz: float, band_hz: tuple[float, float]) -> np.ndarray:
    """How much later each row of `of` is than that of `behind`, at the peak of their cross-correlation, (rows,)."""
    length = 2 * of.shape[1]
    frequency_hz = np.fft.rfftfreq(length, 1 / rate_hz)
    inside = (frequency_hz >= band_hz[0]) & (frequency_hz <= band_hz[1])
    cross = np.fft.rfft(of, length, axis=1) * np.conj(np.fft.rfft(behind, length, axis=1)) * inside
    out = np.empty(len(of))
    for k, spectrum in enumerate(cross):
        step_s = 1 / (8 * rate_hz)
        peak = int(np.argmax(np.fft.irfft(spectrum, 8 * length)))
        about_s = step_s * (peak if peak < 4 * length else peak - 8 * length)
        found = minimize_scalar(
            lambda t, s=spectrum: -np.sum(s * np.exp(2j * np.pi * frequency_hz * t)).real,
            bounds=(about_s - step_s, about_s + step_s),
            method="bounded",
            options={"xatol": 1e-13},
        )
        out[k] = found.x
    return out


def point_paths_mm(point_mm: np.ndarray) -> np.ndarray:
    """Emitter -> point -> each receiver, (8,)."""
    return np.linalg.norm(point_mm) + np.linalg.norm(RECEIVERS_MM - point_mm, axis=1)


def wall_paths_mm(there: Wall) -> np.ndarray:
    """Emitter's image -> each receiver, (8,)."""
    return np.linalg.norm(RECEIVERS_MM + 2 * there.distance_mm * there.normal, axis=1)


REFERENCE_MM = np.array([0.0, 0.0, 300.0])
POINTS_MM = np.array([[20.0, 10, 300], [-60, 40, 350], [80, -90, 250], [0, 0, 450], [120, 0, 200]])
WALLS = [(400.0, (0.0, 0.0, 0.0)), (400.0, (10.0, 5.0, 0.0)), (250.0, (-15.0, 20.0, 0.0)), (700.0, (3.0, -2.0, 40.0))]


def point_path_errors_mm() -> np.ndarray:
    """Our paths less simus3's, both from those of a reference point on, (points, 8)."""
    reference = point_echoes(REFERENCE_MM)
    out = np.empty((len(POINTS_MM), 8))
    for k, point_mm in enumerate(POINTS_MM):
        later_s = delays_s(point_echoes(point_mm), reference, POINT_RATE_HZ, (20e3, 60e3))
        out[k] = point_paths_mm(point_mm) - point_paths_mm(REFERENCE_MM) - 1e3 * SPEED_MPS * later_s
    return out


def wall_time_errors_us() -> np.ndarray:
    """Our times of flight less pyroomacoustics', its constant offset taken out, (walls, 8)."""
    impulse = np.zeros((8, SAMPLES))
    impulse[:, 0] = 1.0
    out = np.empty((len(WALLS), 8))
    for k, (distance_mm, turn_deg) in enumerate(WALLS):
        there = wall(distance_mm, turn_deg)
        heard_s = delays_s(there.responses, impulse, ROOM_RATE_HZ, (30e3, 60e3)) - ROOM_OFFSET_S
        out[k] = 1e6 * (1e-3 * wall_paths_mm(there) / SPEED_MPS - heard_s)
    return out
