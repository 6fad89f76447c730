"""An emulated Grbl board behind a PTY: the guide's motor and the laser-enable line of the emulated rig.

Opening the port restarts the board after a moment, as DTR does to an Uno. The laser-enable output of the board goes
through a relay of its own (the dead-man) that opens when no byte has arrived for 500 ms and stays open until the
board's output has gone low; ``bare=True`` leaves it out and shows the danger. Deadlines of the relay are real time
whatever the stage's speed.

Faults for `GrblPeer.inject`: ``drop_ok``, ``duplicate_ok``, ``late_ok`` (``delay_s``), ``garbage``, ``half_line``
(each for the next ``ok``; ``count`` for more), ``reset`` (restart now), ``alarm`` (``code``; 6 and 9 strike at the
next homing), ``hang`` (the board goes deaf as it stands), ``eof`` (the port dies).
"""

from __future__ import annotations

import contextlib
import os
import select
import threading
import time
import tty
from typing import Final

from echolume_drivers.emulated.grbl_machine import GrblMachine, ResetDuringLine
from echolume_drivers.emulated.stage import Stage

RELAY_S: Final = 0.5
BOOT_S: Final = 0.05
"""How long the board's boot loader keeps it busy after the port was opened."""
RX_BYTES: Final = 127
_REPLY_FAULTS: Final = ("drop_ok", "duplicate_ok", "late_ok", "garbage", "half_line")


class GrblPeer:
    """The board on a pseudo-terminal; `url` is the port to open."""

    def __init__(
        self,
        stage: Stage,
        *,
        bare: bool = False,
        x_home_mm: float = 0.0,
        start_x_mm: float = 20.0,
        resets_on_open: bool = True,
    ) -> None:
        self._stage = stage
        self._bare = bare
        self._resets_on_open = resets_on_open
        self.machine = GrblMachine(stage.speed, x_home_mm, start_x_mm)
        self._master, slave = os.openpty()
        tty.setraw(slave)
        self._url = os.ttyname(slave)
        os.close(slave)  # from now on the master sees whether anybody has the port open
        os.set_blocking(self._master, False)
        self._wake = os.eventfd(0, os.EFD_NONBLOCK)
        self._rx = bytearray()
        self._arrived = threading.Condition()
        self._out = threading.Lock()
        self._laser = threading.RLock()
        self._faults: dict[str, list[float]] = {name: [] for name in _REPLY_FAULTS}
        self._last_byte_s = 0.0
        self._hung = self._tripped = self._eof = False
        self._stopping = False
        self._threads = [
            threading.Thread(target=self._listen, name="grbl-port", daemon=True),
            threading.Thread(target=self._work, name="grbl-lines", daemon=True),
        ]

    @property
    def url(self) -> str:
        """Path of the pseudo-terminal."""
        return self._url

    def start(self) -> None:
        """Put the guide and the laser on the stage and begin to listen."""
        self._stage.guide_x_mm = self.machine.x_mm
        for thread in self._threads:
            thread.start()

    def close(self) -> None:
        """Stop; the laser goes off and the port disappears."""
        if self._stopping:
            return
        self._stopping = True
        self.machine.soft_reset()
        with self._arrived:
            self._arrived.notify_all()
        self._kick()
        for thread in self._threads:
            if thread.is_alive():
                thread.join(5.0)
        self._stage.switch_laser(False)
        os.close(self._wake)
        self._hang_up()

    def inject(self, fault: str, *, count: int = 1, delay_s: float = 0.3, code: int = 1) -> None:
        """Make something go wrong; see the module's list."""
        if fault in _REPLY_FAULTS:
            self._faults[fault] += [delay_s] * count
        elif fault == "alarm" and code in (6, 7, 8, 9):
            self.machine.homing_fails = code
        elif fault == "alarm":
            self._say(self.machine.trip(code))
        elif fault == "reset":
            self._restart()
        elif fault == "hang":
            self._hung = True
        elif fault == "eof":
            self._eof = True
        else:
            raise ValueError(f"GrblPeer: unknown fault {fault!r}")
        self._refresh()
        self._kick()

    # --- port ------------------------------------------------------------------------------------------------

    def _kick(self) -> None:
        os.eventfd_write(self._wake, 1)

    def _listen(self) -> None:
        present = False
        boot_s: float | None = None
        while not self._stopping:
            if self._eof:
                self._hang_up()
            events = self._poll(boot_s, present)
            self._say(self.machine.poll(time.monotonic()))
            if events & select.POLLIN:
                self._receive(booting=boot_s is not None)
            gone = bool(events & select.POLLHUP)
            if gone and not events & select.POLLIN:
                time.sleep(0.005)  # nobody has the port open: poll() would return at once for ever
            if not gone and not present and self._resets_on_open:
                boot_s = time.monotonic() + BOOT_S
            present = not gone
            if boot_s is not None and time.monotonic() >= boot_s:
                boot_s = None
                self._restart()
            self._refresh()

    def _poll(self, boot_s: float | None, present: bool) -> int:
        now_s = time.monotonic()
        due = [self.machine.next_event_s(now_s), boot_s]
        if self._stage.laser_on and not self._bare:
            due.append(self._last_byte_s + RELAY_S)
        if not present:
            due.append(now_s + 0.005)  # nothing but asking tells when somebody opens the port
        wait_s = min((max(0.0, at_s - now_s) for at_s in due if at_s is not None), default=1.0)
        poller = select.poll()
        poller.register(self._wake, select.POLLIN)
        if self._master >= 0:
            poller.register(self._master, select.POLLIN)
        found = dict(poller.poll(min(wait_s, 1.0) * 1e3 + 0.05))
        if self._wake in found:
            with contextlib.suppress(BlockingIOError):
                os.eventfd_read(self._wake)
        return found.get(self._master, 0)

    def _hang_up(self) -> None:
        with self._out:
            if self._master >= 0:
                os.close(self._master)
                self._master = -1

    def _receive(self, booting: bool) -> None:
        try:
            data = os.read(self._master, 4096)
        except BlockingIOError:
            return
        except OSError:  # the last opener left between poll and read
            return
        self._last_byte_s = time.monotonic()
        if self._hung or booting:
            return
        for byte in data:
            if byte in b"\x18?!~" or byte >= 0x80:
                self._real_time(byte)
            else:
                with self._arrived:
                    if len(self._rx) < RX_BYTES:  # the real board loses the rest, too
                        self._rx.append(byte)
        with self._arrived:
            self._arrived.notify_all()

    def _real_time(self, byte: int) -> None:
        if byte == ord("?"):
            answer = self.machine.status()
            if answer is not None:
                self._say([answer])
        elif byte == ord("!"):
            self.machine.hold()
        elif byte == ord("~"):
            self.machine.resume()
        elif byte == 0x18:
            with self._arrived:
                self._rx.clear()
            self._say(self.machine.soft_reset())
        self._refresh()

    def _restart(self) -> None:
        self._hung = False
        with self._arrived:
            self._rx.clear()
        self._say(self.machine.power_on())
        self._refresh()

    # --- lines -----------------------------------------------------------------------------------------------

    def _work(self) -> None:
        while (line := self._next_line()) is not None:
            try:
                answer = self.machine.execute(line)
            except ResetDuringLine:
                answer, self.machine.pending_says = self.machine.pending_says or [], None
            self._refresh()
            self._answer(answer)
            self._kick()

    def _next_line(self) -> str | None:
        with self._arrived:
            while not self._stopping:
                end = self._rx.find(b"\n")
                if end >= 0 and not self._hung:
                    line = bytes(self._rx[:end])
                    del self._rx[: end + 1]
                    return line.decode("latin-1").strip("\r")
                if end < 0 and len(self._rx) >= RX_BYTES:
                    self._rx.clear()
                self._arrived.wait()
        return None

    def _answer(self, lines: list[str]) -> None:
        if not lines or lines[-1] != "ok" or not any(self._faults.values()):
            self._say(lines)
            return
        name = next(name for name, waiting in self._faults.items() if waiting)
        delay_s = self._faults[name].pop(0)
        if name == "late_ok":
            time.sleep(delay_s)
            self._say(lines)
        elif name == "duplicate_ok":
            self._say([*lines, "ok"])
        elif name == "garbage":
            self._write(b"\xfe\x00#z%\r\n" + _wire(lines))
        elif name == "half_line":
            self._write(b"o")
        else:
            self._say(lines[:-1])

    def _say(self, lines: list[str]) -> None:
        if lines and not self._hung:
            self._write(_wire(lines))

    def _write(self, data: bytes) -> None:
        with self._out:
            if self._master < 0:
                return
            with contextlib.suppress(BlockingIOError):  # nobody reads: a real board's bytes are lost too
                os.write(self._master, data)

    # --- laser -----------------------------------------------------------------------------------------------

    def _refresh(self) -> None:
        with self._laser:
            now_s = time.monotonic()
            demand = self.machine.laser_demand(now_s)
            if not demand:
                self._tripped = False
            elif not self._bare and now_s >= self._last_byte_s + RELAY_S:
                self._tripped = True
            self._stage.switch_laser(demand and not self._tripped)


def _wire(lines: list[str]) -> bytes:
    return "".join(line + "\r\n" for line in lines).encode("latin-1")
