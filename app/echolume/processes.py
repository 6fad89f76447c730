"""The demo's process tree: starts, watches and stops the rig's services and the lab's subscribers."""

from __future__ import annotations

import contextlib
import ctypes
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType

from echolume_messages.errors import EcholumeError

STOP_DEADLINE_S = 10.0
_PR_SET_PDEATHSIG = 1


class ProcessEndedError(EcholumeError):
    """A process of the demo ended by itself; the message holds the end of its log."""


@dataclass
class Child:
    """A started process and its log."""

    name: str
    popen: subprocess.Popen[bytes]
    log: Path
    wave: int

    def tail(self, lines: int = 12) -> str:
        """The last lines of the log."""
        text = self.log.read_text(encoding="utf-8", errors="replace").splitlines()
        return "\n".join(f"    {line}" for line in text[-lines:])


def _die_with_parent() -> None:
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)


class ProcessTree:
    """Children in sessions of their own: Ctrl-C reaches only the parent, which stops them in order.

    Should the parent be killed outright, the kernel sends each child SIGTERM.
    """

    def __init__(self, log_directory: Path) -> None:
        log_directory.mkdir(parents=True, exist_ok=True)
        self._logs = log_directory
        self._children: list[Child] = []
        self._sampler = MemorySampler(lambda: [c.popen.pid for c in self._children] + [os.getpid()])

    def __enter__(self) -> ProcessTree:
        self._sampler.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._sampler.stop()
        self.stop()

    @property
    def peak_pss_mib(self) -> float:
        """Largest summed proportional set size seen, MiB."""
        return self._sampler.peak_mib

    def start(self, name: str, arguments: Sequence[str], wave: int = 0) -> Child:
        """Start ``echolume ARGUMENTS`` with its output in a log of its own. Call from the main thread.

        Children of a higher `wave` rest on those of the lower ones: they are stopped, and awaited, before them.
        """
        log = self._logs / f"{name}.log"
        environment = {**os.environ, "OMP_NUM_THREADS": "1", "OPENBLAS_NUM_THREADS": "1"}
        with log.open("wb") as sink:
            popen = subprocess.Popen(
                [sys.executable, "-m", "echolume", *arguments],
                stdin=subprocess.DEVNULL,
                stdout=sink,
                stderr=subprocess.STDOUT,
                start_new_session=True,
                preexec_fn=_die_with_parent,
                env=environment,
            )
        child = Child(name, popen, log, wave)
        self._children.append(child)
        return child

    def check(self) -> None:
        """Raise if a child has ended."""
        for child in self._children:
            code = child.popen.poll()
            if code is not None:
                how = f"by signal {signal.Signals(-code).name}" if code < 0 else f"with exit code {code}"
                raise ProcessEndedError(f"{child.name} ended {how} in mid run; its log ends:\n{child.tail()}")

    def wait_until(self, ready: Callable[[], bool], what: str, timeout_s: float) -> None:
        """Poll `ready` until it holds; a child that ends, or the deadline, is an error."""
        deadline = time.monotonic() + timeout_s
        while not ready():
            self.check()
            if time.monotonic() > deadline:
                raise ProcessEndedError(f"{what}: not there after {timeout_s:.0f} s; see the logs in {self._logs}")
            time.sleep(0.02)

    def stop(self) -> list[str]:
        """Stop the waves from the highest on; returns the names of children that had to be killed."""
        killed: list[str] = []
        for wave in sorted({child.wave for child in self._children}, reverse=True):
            killed += _stop([child for child in self._children if child.wave == wave])
        self._children.clear()
        return killed


def _stop(children: list[Child]) -> list[str]:
    """SIGTERM to all of them, SIGKILL to those that are still there after the deadline."""
    killed: list[str] = []
    for child in children:
        if child.popen.poll() is None:
            child.popen.send_signal(signal.SIGTERM)
    deadline_s = time.monotonic() + STOP_DEADLINE_S
    for child in children:
        try:
            child.popen.wait(max(0.1, deadline_s - time.monotonic()))
        except subprocess.TimeoutExpired:
            child.popen.kill()
            child.popen.wait()
            killed.append(child.name)
    return killed


class MemorySampler:
    """Samples the summed PSS of a set of processes, twice a second."""

    def __init__(self, pids: Callable[[], list[int]]) -> None:
        self._pids = pids
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="memory-sampler", daemon=True)
        self.peak_mib = 0.0

    def start(self) -> None:
        """Begin sampling."""
        self._thread.start()

    def stop(self) -> None:
        """End sampling."""
        self._stop.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._stop.wait(0.5):
            self.peak_mib = max(self.peak_mib, sum(pss_kib(pid) for pid in self._pids()) / 1024)


def pss_kib(pid: int) -> int:
    """Proportional set size of a process in KiB; 0 once it is gone."""
    with contextlib.suppress(FileNotFoundError, ProcessLookupError, PermissionError):
        for line in Path(f"/proc/{pid}/smaps_rollup").read_text(encoding="ascii").splitlines():
            if line.startswith("Pss:"):
                return int(line.split()[1])
    return 0
