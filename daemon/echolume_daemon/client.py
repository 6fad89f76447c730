"""Run a scan from a program: start it, follow it, answer its prompts, get its ledger."""

from __future__ import annotations

import getpass
import os
import socket
import threading
import time
from collections.abc import Callable
from typing import cast

from echolume_daemon.body import Json
from echolume_messages.bus import Bus, Message
from echolume_messages.errors import EcholumeError, NoReplyError, WrongStateError
from echolume_messages.topics import LEDGER, RUN_STATE

START_S = 30.0
_POLL_S = 1.0
_SILENCE_S = 10.0


def default_holder() -> str:
    """``user@host``: who commands from this account."""
    try:
        user = getpass.getuser()
    except (KeyError, OSError):
        user = str(os.getuid())
    return f"{user}@{socket.gethostname()}"


class ScanClient:
    """The operator's side of a scan.

    Examples
    --------
    ::

        with connect("tcp/127.0.0.1:7447", "demo") as bus:
            client = ScanClient(bus)
            scan = client.start(plan_text)
            ledger = client.wait(on_prompt=lambda text: input(text))
    """

    def __init__(self, bus: Bus, holder: str | None = None) -> None:
        self._bus = bus
        self.holder = holder or default_holder()
        self.scan = ""
        self._inbox = bus.subscribe([RUN_STATE, LEDGER], depth=256)
        self._answered = -1

    def start(
        self, plan_text: str, *, holder: str | None = None, archive: str = "", calibration: Json | None = None
    ) -> str:
        """Start a scan and return its name.

        Parameters
        ----------
        plan_text
            The plan, TOML.
        holder
            Who commands; default as given to the constructor.
        archive
            Absolute path of the raw archive; empty: the recorder's directory.
        calibration
            Content of the calibration file, or None for a scan that makes one.

        Raises
        ------
        EcholumeError
            Why the scan was not started: a wrong plan, a missing device, a lease, a run state.
        """
        self.holder = holder or self.holder
        body = {"plan": plan_text, "holder": self.holder, "archive": archive, "calibration": calibration}
        self.scan = str(self._bus.request("conductor", "scan.start", body, START_S)["scan"])
        self._answered = -1
        return self.scan

    def status(self) -> Json:
        """State of the conductor; also renews the lease."""
        return self._bus.request("conductor", "scan.status", {"holder": self.holder})

    def command(self, name: str) -> Json:
        """``pause``, ``resume``, ``abort`` or ``halt``."""
        return self._bus.request("conductor", f"scan.{name}", {"holder": self.holder}, 10.0)

    def wait(
        self,
        on_state: Callable[[Json], None] | None = None,
        on_prompt: Callable[[str], object] | None = None,
        stop: threading.Event | None = None,
    ) -> Json:
        """Follow the scan to its end and return its final ledger.

        Parameters
        ----------
        on_state
            Called with each ``conductor/state`` of this scan.
        on_prompt
            Called with the text of each prompt; the scan goes on when it returns. Without it prompts are answered
            by somebody else.
        stop
            Aborts the scan when set; its ledger is still awaited.

        Raises
        ------
        NoReplyError
            The conductor has been silent for 10 s.
        """
        ledger: Json | None = None
        heard_s = poll_s = time.monotonic()
        told = False
        while True:
            if stop is not None and stop.is_set() and not told:
                told = self._abort()
            message = self._inbox.get(0.1)
            now_s = time.monotonic()
            states: list[Json] = []
            if message is not None and message.header.scan == self.scan:
                heard_s = now_s
                ledger = self._final(message) or ledger
                if message.topic is RUN_STATE:
                    states.append(cast(Json, message.json()))
            if now_s >= poll_s:
                poll_s = now_s + _POLL_S
                status = self._poll()
                heard_s = heard_s if status is None else now_s
                if status is not None and status.get("state") == "idle" and self._is_final(status.get("ledger")):
                    return cast(Json, status["ledger"])
                if status is not None and status.get("scan") == self.scan:
                    states.append(status)
            if now_s - heard_s > _SILENCE_S:
                raise NoReplyError(f"conductor: silent for {_SILENCE_S:.0f} s in mid scan {self.scan}; is it running?")
            for state in states:
                if ledger is not None and state.get("state") == "idle":
                    return ledger
                self._show(state, on_state, on_prompt, stop)

    def _show(
        self,
        state: Json,
        on_state: Callable[[Json], None] | None,
        on_prompt: Callable[[str], object] | None,
        stop: threading.Event | None,
    ) -> None:
        if on_state is not None:
            on_state(state)
        revision = cast(int, state.get("revision", 0))
        prompt = str(state.get("prompt", ""))
        if state.get("state") != "paused" or not prompt or on_prompt is None or revision <= self._answered:
            return
        on_prompt(prompt)
        self._answered = revision
        if stop is not None and stop.is_set():
            return
        try:
            self.command("resume")
        except WrongStateError:
            return  # somebody else has answered meanwhile

    def _final(self, message: Message) -> Json | None:
        if message.topic is not LEDGER:
            return None
        ledger = cast(Json, message.json())
        return ledger if self._is_final(ledger) else None

    def _is_final(self, ledger: object) -> bool:
        if not isinstance(ledger, dict):
            return False
        found = cast(Json, ledger)
        return found.get("final") is True and found.get("scan") == self.scan

    def _poll(self) -> Json | None:
        try:
            return self.status()
        except NoReplyError:
            return None  # `wait` gives up after a while

    def _abort(self) -> bool:
        try:
            self.command("abort")
        except EcholumeError:
            return self.status().get("state") in ("idle", "stopping", "aborting", "halting", "fault")
        return True
