"""Emulated digitiser of the ultrasonic array: SCPI over TCP, echoes as IEEE 488.2 blocks."""

from __future__ import annotations

import threading
import time

import msgspec
import numpy as np

from echolume_drivers.emulated.array_truth import ArrayTruth
from echolume_drivers.emulated.echoes import echo_waveforms, simulate_ping
from echolume_drivers.emulated.scpi_peer import (
    DATA_STALE,
    TRIGGER_IGNORED,
    ScpiFault,
    ScpiInstrument,
    block,
    choice,
    number,
)
from echolume_drivers.emulated.scpi_wires import TcpWire
from echolume_drivers.emulated.stage import Stage
from echolume_messages.rig import ArraySettings
from echolume_messages.types import EchoBlock

IDENTITY = "ECHOLUME,ARRAY 1+8,0001,1.0"
VOLTS_PER_COUNT = 10.0 / 32768
OVER_RANGE = (301, "Input over range")
THERMOMETER_SIGMA_K = 0.02
PULSES = {"WIDEBAND": "wideband", "WIDE": "wideband", "PAPER": "paper"}
FAULTS = (
    "truncated_block",
    "wrong_length",
    "indefinite_block",
    "no_trigger",
    "overflow",
    "disconnect",
    "dead_channel",
    "over_range",
    "silent",
)


class ArrayPeer:
    """One emitter and eight receivers on the emulated robot; pings the scene at the robot's pose of the moment."""

    def __init__(self, stage: Stage, settings: ArraySettings, truth: ArrayTruth) -> None:
        self._stage = stage
        self._settings = settings
        self._truth = truth
        self._lock = threading.Lock()
        self._faults: dict[str, int] = {}
        self._channel = 0
        self._initiated = False
        self._echo: EchoBlock | None = None
        self._device_t_ns = 0
        self._temperature_c = 0.0
        self._waiting = False
        self._boot_ns = time.monotonic_ns()
        self._instrument = ScpiInstrument(
            IDENTITY,
            {
                "CONFigure:RATE": self._set_rate,
                "CONFigure:RATE?": lambda _: f"{self._settings.sample_rate_hz:.9g}",
                "CONFigure:SAMPles": self._set_samples,
                "CONFigure:SAMPles?": lambda _: str(self._settings.samples),
                "CONFigure:STARt": self._set_start,
                "CONFigure:STARt?": lambda _: f"{self._settings.start_s:.9g}",
                "CONFigure:PULSe": self._set_pulse,
                "CONFigure:PULSe?": lambda _: self._settings.pulse.upper(),
                "CONFigure:SCALe?": lambda _: f"{VOLTS_PER_COUNT:.9g}",
                "INITiate": self._initiate,
                "*TRG": self._trigger,
                "*OPC?": self._completed,
                "FETCh:ECHO?": self._fetch,
                "FETCh:TIME?": self._fetch_time,
                "MEASure:TEMPerature?": self._measure_temperature,
            },
        )
        self._wire = TcpWire("array-peer", self._line)

    @property
    def url(self) -> str:
        """``socket://127.0.0.1:port``."""
        return self._wire.url

    def start(self) -> None:
        """Answer from now on; the first ping is computed here once, so that compiling does not delay it."""
        above = self._truth.rig_from_array(np.array([0, 0, 150.0, 0, 0, 0]))
        echo_waveforms(self._stage.scene, above, self._settings, self._truth, self._stage.air_temperature_c)
        self._wire.start()

    def close(self) -> None:
        """Unplug."""
        self._wire.close()

    def inject(self, fault: str, times: int = 1, channel: int = 3) -> None:
        """Fail the next `times` occasions; ``none`` heals.

        ``truncated_block``, ``wrong_length``, ``indefinite_block`` and ``disconnect`` spoil an echo block,
        ``no_trigger`` never completes a ping, ``overflow`` fills the error queue, ``dead_channel`` silences
        `channel`, ``over_range`` drives the input into its limits, ``silent`` swallows commands.
        """
        if fault not in (*FAULTS, "none"):
            raise ValueError(f"array: unknown fault {fault!r}, one of {', '.join(FAULTS)} or none")
        with self._lock:
            if fault == "none":
                self._faults.clear()
            else:
                self._faults[fault] = times
                self._channel = channel

    def _take(self, fault: str) -> bool:
        with self._lock:
            left = self._faults.get(fault, 0)
            if left:
                self._faults[fault] = left - 1
            return left > 0

    def _line(self, line: bytes) -> bytes:
        if self._take("silent"):
            return b""
        if self._take("overflow"):
            for _ in range(20):
                self._instrument.errors.push(*TRIGGER_IGNORED)
        return self._instrument.handle(line)

    def _set_rate(self, arguments: list[str]) -> None:
        rate_hz = number(arguments, 200e3, 2e6)
        self._settings = msgspec.structs.replace(self._settings, sample_rate_hz=rate_hz)

    def _set_samples(self, arguments: list[str]) -> None:
        samples = int(number(arguments, 64, 16384)) // 2 * 2
        self._settings = msgspec.structs.replace(self._settings, samples=samples)

    def _set_start(self, arguments: list[str]) -> None:
        self._settings = msgspec.structs.replace(self._settings, start_s=number(arguments, 0.0, 0.1))

    def _set_pulse(self, arguments: list[str]) -> None:
        pulse = "wideband" if choice(arguments, PULSES) == "wideband" else "paper"
        self._settings = msgspec.structs.replace(self._settings, pulse=pulse)

    def _initiate(self, _: list[str]) -> None:
        self._initiated = True
        self._echo = None

    def _trigger(self, _: list[str]) -> None:
        if not self._initiated:
            raise ScpiFault(*TRIGGER_IGNORED)
        if self._take("no_trigger"):
            self._waiting = True
            return
        self._initiated, self._waiting = False, False
        self._device_t_ns = time.monotonic_ns() - self._boot_ns
        with self._stage.lock:
            pose = np.asarray(self._stage.robot_pose(), dtype=np.float64)
            scene = self._stage.scene
            air_c, felt_c = self._stage.next_air_c()
        rng = self._stage.noise("array", pose)
        echo = simulate_ping(scene, self._truth.rig_from_array(pose), self._settings, self._truth, air_c, rng)
        self._temperature_c = felt_c + self._truth.thermometer_error_k + rng.normal(0, THERMOMETER_SIGMA_K)
        if self._take("dead_channel"):
            echo[self._channel] = 0
        if self._take("over_range"):
            echo = np.clip(echo.astype(np.int32) * 16, -32768, 32767).astype(np.int16)
        if np.max(echo) == 32767 or np.min(echo) == -32768:
            self._instrument.errors.push(*OVER_RANGE)
        self._echo = echo

    def _completed(self, _: list[str]) -> str | None:
        return None if self._waiting else "1"

    def _fetched(self) -> EchoBlock:
        if self._echo is None:
            raise ScpiFault(*DATA_STALE)
        return self._echo

    def _fetch(self, _: list[str]) -> bytes:
        good = block(self._fetched().astype("<i2").tobytes())
        if self._take("truncated_block"):
            return good[: len(good) // 2]
        if self._take("wrong_length"):
            return good[:1] + b"4" + good[2:]
        if self._take("indefinite_block"):
            return b"#0" + good[2 + int(good[1:2]) :]
        if self._take("disconnect"):
            self._wire.hang_up_after_reply()
            return good[: len(good) // 2]
        return good

    def _fetch_time(self, _: list[str]) -> str:
        self._fetched()
        return str(self._device_t_ns)

    def _measure_temperature(self, _: list[str]) -> str:
        if self._echo is None:
            return f"{self._stage.air_temperature_c + self._truth.thermometer_error_k:.3f}"
        return f"{self._temperature_c:.3f}"
