"""The trigger unit: a pulse generator in the BNC 575 dialect that fires both cameras on channel 1."""

from __future__ import annotations

from echolume_drivers.scpi import ScpiPort
from echolume_messages.errors import DeviceFaultError, ProtocolError
from echolume_messages.rig import TriggerSettings

REFUSALS = {
    "?1": "incorrect prefix",
    "?2": "missing command keyword",
    "?3": "invalid command keyword",
    "?4": "missing parameter",
    "?5": "invalid parameter",
    "?6": "query only",
    "?7": "invalid query",
    "?8": "command unavailable in the present state",
}
"""The generator's error answers."""
SHORTEST_S, LONGEST_S = 1e-6, 10.0


class TriggerUnit:
    """Fires the cameras, at once or at the next edge of the laser-enable line.

    Parameters
    ----------
    settings
        Port and baud rate.
    timeout_s
        Deadline of each answer.
    """

    def __init__(self, settings: TriggerSettings, timeout_s: float = 2.0) -> None:
        self._port = ScpiPort(settings.port, settings.baud, "trigger unit", timeout_s)
        self.identity = ""

    def open(self) -> None:
        """Take the port, ask who is there, and disarm."""
        self._port.open()
        try:
            self.identity = self._port.query("*IDN?")
            if self.identity.count(",") < 2:
                raise ProtocolError(
                    f"{self._port.label}: expected maker, model and serial number from *IDN?, "
                    f"got {self.identity!r}; check that the port belongs to the pulse generator"
                )
            self.disarm()
        except BaseException:
            self._port.close()
            raise

    def arm_external(self, exposure_s: float) -> None:
        """From now on every rising edge of the laser-enable line exposes both cameras for `exposure_s`."""
        self._command(":PULSE0:STATE OFF")
        self._set_width(exposure_s)
        self._command(":PULSE0:EXT:MODE TRIG")
        self._command(":PULSE0:STATE ON")

    def fire(self, exposure_s: float) -> None:
        """Expose both cameras once, now."""
        self._command(":PULSE0:STATE OFF")
        self._set_width(exposure_s)
        self._command(":PULSE0:EXT:MODE DIS")
        self._command(":PULSE0:STATE ON")
        self._command("*TRG")

    def disarm(self) -> None:
        """Ignore all edges."""
        self._command(":PULSE0:STATE OFF")

    def count(self) -> int:
        """Pulses fired since the unit was switched on."""
        answer = self._port.query(":PULSE0:COUN:COUN?")
        self._refused(":PULSE0:COUN:COUN?", answer)
        if not answer.isdigit():
            raise ProtocolError(
                f"{self._port.label}: expected a number of pulses from :PULSE0:COUN:COUN?, got {answer!r}; "
                f"check that the port belongs to the pulse generator"
            )
        return int(answer)

    def close(self) -> None:
        """Give the port back; an armed unit stays armed."""
        self._port.close()

    def _set_width(self, exposure_s: float) -> None:
        if not SHORTEST_S <= exposure_s <= LONGEST_S:
            raise ValueError(f"exposure_s: expected {SHORTEST_S} to {LONGEST_S}, got {exposure_s}")
        self._command(f":PULSE1:WIDTH {exposure_s:.9f}")

    def _command(self, command: str) -> None:
        answer = self._port.query(command)
        self._refused(command, answer)
        if answer != "ok":
            raise ProtocolError(
                f"{self._port.label}: expected 'ok' in answer to {command!r}, got {answer!r}; "
                f"check that the port belongs to the pulse generator"
            )

    def _refused(self, command: str, answer: str) -> None:
        if answer.startswith("?"):
            meaning = REFUSALS.get(answer, "an unlisted error")
            raise DeviceFaultError(
                f"{self._port.label}: expected {command!r} to be accepted, got {answer!r} ({meaning}); "
                f"check the unit's firmware and front panel"
            )
