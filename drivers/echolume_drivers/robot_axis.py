"""The master's side of one CiA 402 axis: SDO with words, PDOs, heartbeat and emergency messages."""

from __future__ import annotations

import struct
import threading
import time
from typing import Final

import can
import canopen
from canopen.sdo.exceptions import SdoAbortedError, SdoCommunicationError

from echolume_drivers.cia402_words import DriveState, drive_state, error_words
from echolume_messages.errors import (
    DeviceAbsentError,
    DeviceError,
    DeviceFaultError,
    DeviceSilentError,
    ProtocolError,
)

MASTER_NODE: Final = 127
PRODUCE_MS: Final = 100
CONSUME_MS: Final = 500
SILENCE_S: Final = 1.0
OPERATIONAL: Final = 0x05


class RobotAxis:
    """One node; `news` is notified whenever it says something."""

    def __init__(self, network: canopen.Network, node_id: int, where: str, news: threading.Condition) -> None:
        self.where = where
        self.node_id = node_id
        self.statusword = 0
        self.status_count = 0
        self.position = 0
        self.low = self.high = 0
        self.trouble: DeviceError | None = None
        self._network = network
        self._news = news
        self._nmt: int | None = None
        self._beat_s = self._pdo_s = time.monotonic()
        self._supervised = False
        self._node = network.add_node(canopen.RemoteNode(node_id, canopen.ObjectDictionary()))
        network.subscribe(0x180 + node_id, self._on_status)
        network.subscribe(0x700 + node_id, self._on_heartbeat)
        network.subscribe(0x080 + node_id, self._on_emergency)

    @property
    def state(self) -> DriveState:
        """State of the drive."""
        return drive_state(self.statusword)

    # --- what the node says; the bus thread ------------------------------------------------------------------

    def _on_status(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        del cob_id, timestamp
        if len(data) != 6:
            self._blame(ProtocolError(f"{self.where}: status PDO of {len(data)} bytes, expected 6"))
            return
        with self._news:
            self.statusword, self.position = struct.unpack("<Hi", data)
            self.status_count += 1
            self._pdo_s = time.monotonic()
            self._news.notify_all()

    def _on_heartbeat(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        del cob_id, timestamp
        with self._news:
            self._beat_s = time.monotonic()
            if len(data) == 1 and data[0] == 0 and self._supervised:
                self._blame(
                    DeviceFaultError(f"{self.where}: the node restarted in the middle of the run; enable again")
                )
            self._nmt = data[0] & 0x7F if len(data) == 1 else None
            self._news.notify_all()

    def _on_emergency(self, cob_id: int, data: bytearray, timestamp: float) -> None:
        del cob_id, timestamp
        code = int.from_bytes(data[:2], "little")
        if code and self._supervised:
            self._blame(DeviceFaultError(f"{self.where}: emergency {error_words(code)}"))

    def _blame(self, error: DeviceError) -> None:
        with self._news:
            self.trouble = self.trouble or error
            self._news.notify_all()

    # --- SDO -------------------------------------------------------------------------------------------------

    def write(self, index: int, sub: int, layout: str, value: int) -> None:
        """Download one number (`layout` as in struct)."""
        try:
            self._node.sdo.download(index, sub, struct.pack("<" + layout, value))
        except (SdoAbortedError, SdoCommunicationError, can.CanError, OSError) as error:
            raise self._translated(error, f"writing {value} to 0x{index:04X}:{sub}") from error

    def read(self, index: int, sub: int, layout: str) -> int:
        """Upload one number."""
        try:
            data = self._node.sdo.upload(index, sub)
        except (SdoAbortedError, SdoCommunicationError, can.CanError, OSError) as error:
            raise self._translated(error, f"reading 0x{index:04X}:{sub}") from error
        if len(data) < struct.calcsize(layout):
            raise ProtocolError(f"{self.where}: 0x{index:04X}:{sub} has {len(data)} bytes, expected {layout}")
        return int(struct.unpack_from("<" + layout, data)[0])

    def set(self, index: int, sub: int, layout: str, value: int) -> None:
        """Download one number and read it back."""
        self.write(index, sub, layout, value)
        seen = self.read(index, sub, layout)
        if seen != value:
            raise ProtocolError(f"{self.where}: wrote 0x{value:X} to 0x{index:04X}:{sub}, read back 0x{seen:X}")

    def _translated(self, error: Exception, doing: str) -> DeviceError:
        if isinstance(error, SdoAbortedError):
            return DeviceFaultError(f"{self.where}: refused {doing}: {error}")
        if isinstance(error, SdoCommunicationError):
            return DeviceSilentError(f"{self.where}: no answer {doing}; is the drive powered and on the bus?")
        return DeviceAbsentError(f"{self.where}: the bus is gone {doing}: {error}")

    # --- set-up ----------------------------------------------------------------------------------------------

    def configure(self) -> None:
        """Heartbeats both ways, and one PDO each way; the node is in PRE-OPERATIONAL."""
        self._supervised = False
        self.set(0x1017, 0, "H", PRODUCE_MS)
        self.set(0x1016, 1, "I", MASTER_NODE << 16 | CONSUME_MS)
        self._map(0x1400, 0x200, (0x60400010, 0x607A0020))
        self._map(0x1800, 0x180, (0x60410010, 0x60640020))
        self.low = self.read(0x607D, 1, "i")
        self.high = self.read(0x607D, 2, "i")
        self.poll()

    def _map(self, link: int, base: int, entries: tuple[int, ...]) -> None:
        cob_id = base + self.node_id
        self.write(link, 1, "I", 0x8000_0000 | cob_id)
        self.write(link + 0x200, 0, "B", 0)
        for k, entry in enumerate(entries):
            self.write(link + 0x200, k + 1, "I", entry)
        self.write(link + 0x200, 0, "B", len(entries))
        self.write(link, 2, "B", 255)  # event driven: with synchronous types the bring-up would wait for a SYNC
        if link == 0x1800:
            self.write(link, 5, "H", PRODUCE_MS)
        self.write(link, 1, "I", cob_id)

    def supervise(self) -> None:
        """From now on a restart, an emergency or a missing heartbeat is an error."""
        with self._news:
            self.trouble = None
            self._beat_s = time.monotonic()
            self._supervised = True

    # --- running ---------------------------------------------------------------------------------------------

    def send(self, controlword: int, target: int | None = None) -> None:
        """Send controlword and target (default: where the axis stands)."""
        data = struct.pack("<Hi", controlword, self.position if target is None else target)
        try:
            self._network.send_message(0x200 + self.node_id, data)
        except (can.CanError, OSError) as error:
            raise DeviceAbsentError(f"{self.where}: the bus is gone: {error}") from error

    def poll(self) -> None:
        """Read statusword and position by SDO, for want of a PDO."""
        statusword, position = self.read(0x6041, 0, "H"), self.read(0x6064, 0, "i")
        with self._news:
            self.statusword, self.position = statusword, position
            self.status_count += 1

    @property
    def is_fresh(self) -> bool:
        """Whether the last status PDO is young enough to stand for now."""
        return time.monotonic() - self._pdo_s < 3 * PRODUCE_MS / 1e3

    @property
    def is_operational(self) -> bool:
        """Whether the last heartbeat said OPERATIONAL."""
        return self._nmt == OPERATIONAL

    def check(self) -> None:
        """Raise what is wrong with this axis, if anything is."""
        if self.trouble is not None:
            raise self.trouble
        if self._supervised and time.monotonic() - self._beat_s > SILENCE_S:
            raise DeviceSilentError(f"{self.where}: no heartbeat for {SILENCE_S:.1f} s; power or CAN cable?")

    def raise_fault(self) -> None:
        """Raise the fault that 0x603F names."""
        raise DeviceFaultError(f"{self.where}: fault {error_words(self.read(0x603F, 0, 'H'))}")
