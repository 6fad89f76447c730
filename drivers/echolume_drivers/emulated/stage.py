"""What the emulated devices share: one scene, one guide, one laser, one robot, and noise that can be repeated."""

from __future__ import annotations

import hashlib
import math
import threading
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from echolume_drivers.emulated.scene import Scene

PING_S = 0.5
"""What a ping and the way to it take on a real rig; the air's clock goes on by it at each ping, whatever the speed."""
SCREW_SIGMA_MM = 0.01
"""How far the carriage stands from where the guide's controller believes it."""


@dataclass(frozen=True)
class Board:
    """The calibration chessboard on the stage: inner corners, square, and ``rig_from_board`` (4, 4).

    The board frame has its origin at the first inner corner, x along the columns, y along the rows, and z out of
    the print towards the cameras.
    """

    columns: int
    rows: int
    square_mm: float
    rig_from_board: NDArray[np.float64]


@dataclass
class Stage:
    """Shared state of the emulated rig; every access holds `lock`."""

    seed: int
    scene: Scene
    speed: float = 1.0
    air_temperature_c: float = 22.0
    board: Board | None = None
    guide_x_mm: Callable[[], float] = lambda: 0.0
    laser_on: bool = False
    robot_pose: Callable[[], NDArray[np.float64]] = lambda: np.zeros(6)
    lock: threading.RLock = field(default_factory=threading.RLock)
    _pings: int = 0
    _laser_watchers: list[Callable[[bool], None]] = field(default_factory=list[Callable[[bool], None]])
    _attempts: dict[tuple[str, tuple[int, ...]], int] = field(default_factory=dict[tuple[str, tuple[int, ...]], int])

    def watch_laser(self, callback: Callable[[bool], None]) -> None:
        """Wire a device to the laser-enable line; called at every edge, outside the lock."""
        self._laser_watchers.append(callback)

    def switch_laser(self, on: bool) -> None:
        """Drive the laser-enable line."""
        with self.lock:
            changed = on != self.laser_on
            self.laser_on = on
        if changed:
            for callback in self._laser_watchers:
                callback(on)

    def carriage_mm(self) -> float:
        """Where the guide's carriage really stands; the screw's error is the same at each return to a position."""
        believed_mm = float(self.guide_x_mm())
        return believed_mm + float(self._drawn("screw", round(1000 * believed_mm)).normal(0, SCREW_SIGMA_MM))

    def next_air_c(self) -> tuple[float, float]:
        """Temperature of the air at the next ping, and what a thermometer without error and noise has followed to.

        A drifting air drifts from ping to ping, not with the wall's clock, so that a scan can be repeated.
        """
        with self.lock:
            air, seconds = self.scene.air, self._pings * PING_S
            self._pings += 1
        start_c = self.air_temperature_c if air.temperature_c is None else air.temperature_c
        per_s, lag_s = air.drift_k_per_min / 60, air.thermometer_lag_s
        behind_s = lag_s * (1 - math.exp(-seconds / lag_s)) if lag_s > 0 else 0.0
        return start_c + per_s * seconds, start_c + per_s * (seconds - behind_s)

    def noise(self, device: str, position: NDArray[np.float64]) -> np.random.Generator:
        """Random numbers keyed by (seed, device, position to 1 um, attempt at that position)."""
        spot = tuple(int(v) for v in np.round(np.asarray(position, dtype=np.float64) * 1000))
        with self.lock:
            attempt = self._attempts.get((device, spot), 0)
            self._attempts[device, spot] = attempt + 1
        return self._drawn(device, spot, attempt)

    def _drawn(self, *key: object) -> np.random.Generator:
        """Random numbers of this rig keyed by plain values."""
        text = repr((self.seed, *key)).encode()
        return np.random.default_rng(int.from_bytes(hashlib.sha256(text).digest()[:8], "little"))

    def place(self, scene: Scene | None = None, board: Board | None = None) -> None:
        """Put another scene (or a board over it) on the bench; noise attempts start anew."""
        with self.lock:
            if scene is not None:
                self.scene = scene
                self._pings = 0
            self.board = board
            self._attempts.clear()
