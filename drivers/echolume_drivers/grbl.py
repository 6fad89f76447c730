"""The linear guide and its laser on a Grbl 1.1 board in laser mode.

Every laser-on is queued together with its own laser-off: an exposure is one program

``G53 G1 X F`` (queue the move), ``G4 P0.01`` (its ok comes at standstill), ``M3 S``, ``G4 P`` (dwell), ``M5``

that fits the board's receive buffer and goes out in one write, so the board has all of it or none. In laser mode
stock Grbl lights M3 at rest only while the modal motion is G1; hence the move is always sent, even one of no length.
A board that stays silent is reset at once (0x18 switches the laser off); one that answers wrongly or raises an alarm
is braked first, so that it keeps its position; then the error is raised. Real rigs need a dead-man relay on
laser-enable: stock Grbl has none.
"""

from __future__ import annotations

import math
import threading
import time
from dataclasses import dataclass
from typing import Final

from echolume_drivers.grbl_codes import alarm_words
from echolume_drivers.grbl_link import KEEP_ALIVE_S, CancelledError, GrblLink
from echolume_messages.errors import DeviceAbsentError, DeviceError, DeviceFaultError, DeviceSilentError
from echolume_messages.rig import GuideSettings

BANNER_S: Final = 2.5
"""An Uno's boot loader takes up to two seconds after DTR has reset it."""
HOMING_S: Final = 90.0
MARGIN_S: Final = 2.0
LOSES_POSITION: Final = (1, 3, 6, 7, 8, 9, 10)


@dataclass(frozen=True)
class GuideStatus:
    """State as Grbl names it, position in the rig's x, and the alarm that is on."""

    state: str
    x_mm: float
    alarm: int | None


class GrblGuide:
    """Guide and laser; `stop`, `laser_off` and `status` may be called from any thread at any time."""

    def __init__(self, settings: GuideSettings) -> None:
        self._settings = settings
        self._link = GrblLink("guide", settings.port, settings.baud)
        self._turn = threading.Lock()
        self._homed = False
        self._x_mm = 0.0
        self._steps_per_mm = 1.0
        self._acceleration_mm_per_s2 = 1.0
        self._top_mm_per_s = 1.0
        self._checked_s = 0.0

    def open(self) -> None:
        """Take the port, let the board restart, and check its settings; the laser is off afterwards.

        Raises
        ------
        DeviceError
            Absent, held by another program, silent, or not in laser mode.
        """
        self._link.open()
        try:
            if not self._link.await_banner(0, BANNER_S) and not self._link.reset():
                raise DeviceSilentError(f"{self._link.where}: no Grbl banner; is this a Grbl 1.1 board?")
            self._check_settings(self._read_settings())
        except DeviceError:
            self._link.close()
            raise

    def _read_settings(self) -> dict[int, float]:
        answers = self._link.run(["$$"], MARGIN_S)
        pairs = (line[1:].partition("=")[::2] for line in answers if line.startswith("$"))
        return {int(key): float(value) for key, value in pairs}

    def _check_settings(self, settings: dict[int, float]) -> None:
        for key, why in ((32, "laser mode"), (22, "homing"), (20, "soft limits")):
            if settings.get(key) != 1:
                raise DeviceFaultError(
                    f"{self._link.where}: ${key}={settings.get(key, 'missing')}, but {why} must be on: send ${key}=1"
                )
        self._steps_per_mm = settings.get(100, 250.0)
        self._top_mm_per_s = settings.get(110, 6000.0) / 60
        self._acceleration_mm_per_s2 = settings.get(120, 100.0)

    def home(self) -> float:
        """Run the homing cycle and return where it ended, x in mm; this also clears an alarm."""
        with self._turn:
            self._homed = False
            self._program(["$H"], HOMING_S, listening=False)
            self._link.alarm, self._link.restarted = None, False
            self._homed = True
            return self._look()

    def move(self, x_mm: float) -> float:
        """Go to `x_mm` with the laser off; returns where the board says it stands, mm."""
        with self._turn:
            self._require(x_mm)
            self._program(["M5", self._go(x_mm), "G4P0.01"], self._deadline_s(x_mm))
            return self._look()

    def expose(self, x_mm: float, exposure_s: float) -> float:
        """Go to `x_mm`, stand still, light the laser for `exposure_s`; returns the x that was reached, mm.

        Notes
        -----
        The position is the commanded one on the motor's step grid (step and shoot). It is compared with a status
        report at most five times a second, as the board's manual asks.
        """
        if not 0 < exposure_s <= 10:
            raise DeviceFaultError(f"{self._link.where}: exposure {exposure_s} s is not within 0..10 s")
        with self._turn:
            target_mm = self._require(x_mm)
            light = [f"M3S{self._settings.laser_power}", f"G4P{exposure_s:.4f}", "M5"]
            self._program([self._go(x_mm), "G4P0.01", *light], self._deadline_s(x_mm) + exposure_s)
            self._x_mm = target_mm
            if time.monotonic() - self._checked_s >= KEEP_ALIVE_S:
                self._verify(target_mm)
            return target_mm

    def laser_off(self) -> None:
        """Switch the laser off; whatever is under way is stopped for it."""
        if self._turn.acquire(blocking=False):
            try:
                if self._link.alarm is None and self._homed:
                    self._program(["M5"], MARGIN_S)
                else:
                    self._reset()
            finally:
                self._turn.release()
        else:
            self.stop()

    def stop(self) -> None:
        """Brake (``!``), wait for standstill, reset: laser off, position kept. Never waits for its turn."""
        self._link.send(b"!")
        deadline_s = time.monotonic() + MARGIN_S
        while time.monotonic() < deadline_s:
            try:
                if self._link.report(0.3).state.startswith(("Hold:0", "Alarm", "Idle")):
                    break
            except DeviceSilentError:
                break  # homing, or an alarm that answers nothing but a reset
            time.sleep(0.02)
        self._reset()

    def status(self) -> GuideStatus:
        """Ask the board where it is; the position is not that of an encoder while it moves."""
        if self._turn.acquire(blocking=False):
            try:
                self._leave_alarm()
            finally:
                self._turn.release()
        report = self._link.report()
        x_mm = report.machine_mm + self._settings.x_home_mm
        return GuideStatus(report.state, x_mm, self._link.alarm if report.state == "Alarm" else None)

    def close(self) -> None:
        """Reset the board (laser off) and give the port back."""
        if self._link.is_open:
            try:
                self._reset()
            except DeviceAbsentError:
                self._homed = False  # it is gone; its dead-man has the laser
        self._link.close()

    # --- inside ----------------------------------------------------------------------------------------------

    def _require(self, x_mm: float) -> float:
        low_mm, high_mm = self._settings.min_mm, self._settings.max_mm
        if not (math.isfinite(x_mm) and low_mm <= x_mm <= high_mm):
            raise DeviceFaultError(f"{self._link.where}: x {x_mm} mm is outside {low_mm}..{high_mm} mm")
        self._leave_alarm()
        alarm = self._link.alarm
        if alarm is not None and alarm in LOSES_POSITION:
            raise DeviceFaultError(f"{self._link.where}: {alarm_words(alarm)}")
        if not self._homed:
            raise DeviceFaultError(f"{self._link.where}: not homed: home the guide first")
        machine_mm = x_mm - self._settings.x_home_mm
        return round(machine_mm * self._steps_per_mm) / self._steps_per_mm + self._settings.x_home_mm

    def _leave_alarm(self) -> None:
        """After a limit alarm the board answers nothing but a reset."""
        if self._link.alarm is not None and self._link.is_troubled:
            self._reset()

    def _go(self, x_mm: float) -> str:
        return f"G53G1X{x_mm - self._settings.x_home_mm:.3f}F{self._settings.feed_mm_per_min:.0f}"

    def _deadline_s(self, x_mm: float) -> float:
        speed = min(self._settings.feed_mm_per_min / 60, self._top_mm_per_s)
        return abs(x_mm - self._x_mm) / speed + 2 * speed / self._acceleration_mm_per_s2 + MARGIN_S

    def _program(self, lines: list[str], timeout_s: float, listening: bool = True) -> None:
        try:
            self._link.run(lines, timeout_s, listening)
        except DeviceAbsentError:
            self._homed = False
            raise
        except CancelledError:
            raise  # `stop` has seen to the board
        except DeviceSilentError:
            self._reset()
            raise
        except DeviceError:
            self.stop()
            raise

    def _reset(self) -> None:
        came = self._link.reset(0.5)
        if not came or self._link.restarted or self._link.alarm in LOSES_POSITION:
            self._homed = False

    def _look(self) -> float:
        self._checked_s = time.monotonic()
        self._x_mm = self._link.report().machine_mm + self._settings.x_home_mm
        return self._x_mm

    def _verify(self, target_mm: float) -> None:
        seen_mm = self._look()
        if abs(seen_mm - target_mm) > 1.5 / self._steps_per_mm + 0.001:
            self._homed = False
            raise DeviceFaultError(
                f"{self._link.where}: stands at x {seen_mm:.3f} mm instead of {target_mm:.3f} mm; home again"
            )
