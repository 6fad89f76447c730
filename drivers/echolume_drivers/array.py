"""The digitiser of the ultrasonic array: one emitter, eight receivers, SCPI with IEEE 488.2 blocks."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from echolume_drivers.scpi import ScpiPort
from echolume_messages.errors import DeviceError, DeviceFaultError, DeviceSilentError, ProtocolError
from echolume_messages.rig import ArraySettings
from echolume_messages.types import EchoBlock

PULSE_NAMES = {"wideband": "WIDEBAND", "paper": "PAPER"}
FLAT_COUNTS = 2
"""A channel that moves no more than this over a record is dead: a live one shows at least its noise."""


@dataclass(frozen=True)
class Ping:
    """One emission and what eight receivers heard."""

    block: EchoBlock  # int16 (receivers, samples)
    sample_rate_hz: float
    start_s: float
    volts_per_count: float
    device_t_ns: int
    """The emission on the device's own clock."""
    air_temperature_c: float


class ArrayDigitiser:
    """Emits and records.

    Parameters
    ----------
    settings
        Port, sampling, pulse and the array's build.
    timeout_s
        Deadline of each answer, also of a ping.
    """

    def __init__(self, settings: ArraySettings, timeout_s: float = 2.0) -> None:
        self._settings = settings
        self._port = ScpiPort(settings.port, settings.baud, "array digitiser", timeout_s)
        self._volts_per_count = 0.0
        self._configured = False
        self.identity = ""

    def open(self) -> None:
        """Take the port and ask who is there."""
        self._port.open()
        try:
            self.identity = self._port.query("*IDN?")
        except BaseException:
            self._port.close()
            raise

    def configure(self) -> None:
        """Set sampling and pulse, and read them back.

        Raises
        ------
        DeviceFaultError
            The device refused a setting, or uses another value than it was given.
        """
        s = self._settings
        self._port.write(
            f"*CLS;:CONF:RATE {s.sample_rate_hz:.9g};:CONF:SAMP {s.samples}"
            f";:CONF:STAR {s.start_s:.9g};:CONF:PULS {PULSE_NAMES[s.pulse]}"
        )
        self._port.check_errors("configuring")
        for query, wanted in (
            ("CONF:RATE?", s.sample_rate_hz),
            ("CONF:SAMP?", float(s.samples)),
            ("CONF:STAR?", s.start_s),
        ):
            found = self._number(query)
            if abs(found - wanted) > 1e-6 * max(abs(wanted), 1e-3):
                raise DeviceFaultError(
                    f"{self._port.label}: expected {query} to answer {wanted:g}, got {found:g}; "
                    f"choose a value in the rig file that the digitiser supports"
                )
        self._volts_per_count = self._number("CONF:SCAL?")
        self._configured = True

    def ping(self) -> Ping:
        """Emit once and fetch the record; after a failed ping, connects if need be and configures again first.

        Raises
        ------
        DeviceSilentError
            The trigger never came, or the record stopped half way.
        DeviceFaultError
            The device reports an error, e.g. an input over range, or a channel is dead.
        ProtocolError
            The record is not the block that was configured.
        """
        self._ready()
        try:
            return self._ping()
        except DeviceError:
            self._configured = False  # whatever is left of this ping is cleared before the next
            raise

    def _ping(self) -> Ping:
        s = self._settings
        receivers = len(s.layout.receivers_mm)
        self._emit()
        data = self._port.query_block("FETC:ECHO?", expected_bytes=2 * receivers * s.samples)
        block = np.frombuffer(data, dtype="<i2").reshape(receivers, s.samples).astype(np.int16)
        device_t_ns = self._whole("FETC:TIME?")
        temperature_c = self._number("MEAS:TEMP?")
        self._port.check_errors("ping")
        self._check_channels(block)
        return Ping(block, s.sample_rate_hz, s.start_s, self._volts_per_count, device_t_ns, temperature_c)

    def close(self) -> None:
        """Give the port back."""
        self._port.close()
        self._configured = False

    def _ready(self) -> None:
        if not self._port.is_open:
            self._configured = False
            self.open()
        if not self._configured:
            self.configure()

    def _emit(self) -> None:
        try:
            # one line, one packet: separate small writes wait for each other on a socket (Nagle)
            answer = self._port.query("INIT;*TRG;*OPC?")
        except DeviceSilentError as error:
            raise DeviceSilentError(
                f"{self._port.label}: expected the ping to complete (*OPC?), but its trigger never came; "
                f"check the trigger wire of the digitiser, then ping again"
            ) from error
        if answer != "1":
            raise ProtocolError(f"{self._port.label}: expected '1' from *OPC?, got {answer!r}; reset the digitiser")

    def _check_channels(self, block: EchoBlock) -> None:
        spans = np.max(block, axis=1).astype(np.int64) - np.min(block, axis=1)
        dead = np.nonzero(spans <= FLAT_COUNTS)[0].tolist()
        if dead:
            raise DeviceFaultError(
                f"{self._port.label}: expected an echo or at least noise on every receiver, "
                f"got a flat record on receiver {', '.join(map(str, dead))} (0 to {len(block) - 1}); "
                f"check its cable and preamplifier"
            )

    def _number(self, query: str) -> float:
        answer = self._port.query(query)
        try:
            return float(answer)
        except ValueError as error:
            raise ProtocolError(f"{self._port.label}: expected a number from {query}, got {answer!r}") from error

    def _whole(self, query: str) -> int:
        answer = self._port.query(query)
        try:
            return int(answer)
        except ValueError as error:
            raise ProtocolError(f"{self._port.label}: expected whole ns from {query}, got {answer!r}") from error
