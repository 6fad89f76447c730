"""Run a scan plan on the rig and wait for its ledger.

Prompts of the plan are shown; Enter goes on. Ctrl-C, SIGTERM and a closed terminal abort in good order.
Exit code 0 if every trigger is matched, 8 if some are missing or the scan was aborted.

example:
  echolume scan plans/demo.toml --out /var/lib/echolume/tuesday
"""

from __future__ import annotations

import argparse
import json
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from types import FrameType
from typing import TypeAlias, cast

import msgspec

from echolume_daemon.body import Json
from echolume_daemon.client import ScanClient
from echolume_daemon.commands.options import add_holder, join_bus
from echolume_messages import calibration as calibration_file
from echolume_messages import plan as plan_file
from echolume_messages.errors import IncompleteScanError
from echolume_messages.files import make_folder, read_text
from echolume_messages.rig import Rig
from echolume_messages.rig_option import add_rig, load_rig

Handlers: TypeAlias = Callable[[int, FrameType | None], object] | int | None
ENDING = (signal.SIGINT, signal.SIGTERM, signal.SIGHUP)
"""Ctrl-C, a polite end, and a terminal that is closed: none of them leaves a scan behind that nobody follows."""
COLUMNS = ("planned", "fired", "matched", "missing", "duplicate", "extra")


def configure(parser: argparse.ArgumentParser) -> None:
    """Declare the command's arguments."""
    parser.add_argument("plan", type=Path, metavar="PLAN", help="scan plan (TOML)")
    parser.add_argument("--out", type=Path, metavar="DIR", help="where raw.mcap goes (default: as the recorder)")
    parser.add_argument("--json", action="store_true", help="print the ledger as JSON")
    add_rig(parser)
    add_holder(parser)


def run(args: argparse.Namespace) -> int:
    """Start the scan, follow it, print its ledger."""
    plan_text = read_text(args.plan, "the plan")
    plan_file.parse(plan_text, str(args.plan))  # the conductor checks it too, but does not know the file's name
    rig = load_rig(args.rig)
    calibration = _calibration(rig)
    stop = threading.Event()
    with join_bus(rig) as bus:
        archive = _archive(args.out)
        client = ScanClient(bus, args.holder)
        before = {number: signal.signal(number, lambda _n, _f: stop.set()) for number in ENDING}
        try:
            scan = client.start(plan_text, archive=archive, calibration=calibration)
            sys.stderr.write(f"scan {scan}\n")
            progress = Progress()
            ledger = client.wait(progress.show, lambda text: _ask(text, stop), stop)
        finally:
            _restore(before)
    sys.stdout.write(json.dumps(ledger, indent=1) + "\n" if args.json else table(ledger))
    if ledger["outcome"] == "complete":
        return 0
    why = f": {progress.error}" if progress.error else ""
    raise IncompleteScanError(f"scan {scan}: {ledger['outcome']}{why}; {missing(ledger)}")


def _archive(out: Path | None) -> str:
    if out is None:
        return ""
    return str(make_folder(out).resolve() / "raw.mcap")


def _calibration(rig: Rig) -> Json | None:
    if not rig.calibration:
        return None
    path = Path(rig.calibration)
    return cast(Json, msgspec.to_builtins(calibration_file.load(path, rig.name)))


def _ask(text: str, stop: threading.Event) -> None:
    """Show a prompt; Enter goes on, Ctrl-C aborts."""
    sys.stderr.write(f"\n{text}\n[Enter goes on, Ctrl-C aborts] ")
    sys.stderr.flush()

    def interrupt(_number: int, _frame: FrameType | None) -> None:
        raise KeyboardInterrupt

    before = {number: signal.signal(number, interrupt) for number in ENDING}
    try:
        if not sys.stdin.readline():
            sys.stderr.write("nobody is there to answer (end of input): the scan is aborted\n")
            stop.set()
    except KeyboardInterrupt:
        stop.set()
    finally:
        _restore(before)


def _restore(handlers: dict[signal.Signals, Handlers]) -> None:
    for number, handler in handlers.items():
        signal.signal(number, handler)


class Progress:
    """Progress on stderr: rewritten in place on a terminal, one line a pass elsewhere."""

    def __init__(self) -> None:
        self._last: tuple[object, object] = ("", "")
        self.error = ""
        """What ended the scan, if it failed."""

    def show(self, state: Json) -> None:
        """Show a state of the conductor."""
        self.error = str(state.get("error") or "") or self.error
        line = f"{state['state']:<9} {state['pass'] or '':<12} {state['matched']}/{state['planned']} matched"
        if sys.stderr.isatty():
            sys.stderr.write(f"\r{line:<70}")
            sys.stderr.flush()
            return
        key = (state["state"], state["pass"])
        if key != self._last:
            self._last = key
            sys.stderr.write(line + "\n")


def table(ledger: Json) -> str:
    """The ledger as text."""
    passes = cast("dict[str, Json]", ledger["passes"])
    width = max((len(name) for name in passes), default=4)
    rows = ["  ".join([f"{'pass':<{width}}", f"{'kind':<10}", *(f"{c:>9}" for c in COLUMNS)])]
    for name, entry in passes.items():
        rows.append("  ".join([f"{name:<{width}}", f"{entry['kind']:<10}", *(f"{entry[c]:>9}" for c in COLUMNS)]))
    rows.append(f"outcome: {ledger['outcome']}; {ledger['acknowledged']} records acknowledged in {ledger['archive']}")
    return "\n".join(rows) + "\n"


def missing(ledger: Json) -> str:
    """The missing triggers of each pass, as text."""
    passes = cast("dict[str, Json]", ledger["passes"])
    lists = {name: cast("list[int]", entry["missing_triggers"]) for name, entry in passes.items()}
    named = [f"{name}: {_runs(triggers)}" for name, triggers in lists.items() if triggers]
    return "missing triggers: " + ("; ".join(named) or "none")


def _runs(numbers: list[int]) -> str:
    """``[3, 5-9]`` for 3, 5, 6, 7, 8, 9."""
    runs: list[list[int]] = []
    for number in sorted(numbers):
        if runs and number == runs[-1][1] + 1:
            runs[-1][1] = number
        else:
            runs.append([number, number])
    return "[" + ", ".join(str(a) if a == b else f"{a}-{b}" for a, b in runs) + "]"
