"""The ``echolume`` program: finds the commands that the rooms registered and loads only the one asked for."""

from __future__ import annotations

import argparse
import errno
import logging
import os
import sys
from collections.abc import Sequence
from importlib.metadata import EntryPoint, entry_points, version

GROUP = "echolume.commands"
CLOSED_PIPE = 141
"""Exit code, as of a program that SIGPIPE ended."""

SUMMARIES = {
    "demo": "scan the emulated rig into a hybrid map, from nothing",
    "emulate": "run the emulated rig by itself, over the same wires as a real one",
    "serve": "run one of the rig's services",
    "scan": "run a scan plan on the rig",
    "status": "show what the rig is doing",
    "pause": "pause the scan at the next trigger",
    "resume": "go on with a paused scan",
    "abort": "end the scan in good order; what was acquired stays",
    "halt": "stop now: laser off, robot stopped (no replacement for the emergency stop)",
    "calibrate": "calibrate cameras, laser or array",
    "process": "run one of the lab's subscribers",
    "reprocess": "rebuild the hybrid map from a raw archive",
    "figures": "draw the paper's figures, and those of a scan",
    "image": "acoustic images of a scan, and the volume by delay-and-sum",
    "export": "write a hybrid map as PLY, LAS, E57, mesh or npz",
    "evaluate": "score a hybrid map against the truth",
    "explain": "tell what one cell of a map is, and what it rests on",
    "localise": "locate a target in recorded echoes of a 1+N array",
}


def commands() -> dict[str, EntryPoint]:
    """Commands by name, as registered by the installed rooms."""
    return {entry.name: entry for entry in entry_points(group=GROUP)}


def overview(found: dict[str, EntryPoint]) -> str:
    """The text of ``echolume --help``."""
    known = [name for name in SUMMARIES if name in found]
    others = sorted(set(found) - set(known))
    rows = [f"  {name:<10} {SUMMARIES.get(name, found[name].value)}" for name in (*known, *others)]
    return "\n".join(
        [
            "usage: echolume COMMAND [options]",
            "",
            "Scans objects in air with light and with sound and fuses both into one hybrid 3D map.",
            "",
            "commands:",
            *rows,
            "",
            "`echolume COMMAND --help` explains one of them, with an example; `echolume --version` tells the version.",
            "Without a rig, begin with: echolume demo --out demo-out",
            "",
        ]
    )


def main(argv: Sequence[str] | None = None) -> int:
    """Run the program; returns the exit code."""
    try:
        try:
            return _main(argv)
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # whoever read has seen enough, as in `| head -1`
        _give_up_stdout()
        return CLOSED_PIPE
    except OSError as error:
        # The system's refusal of a file is no fault of the program; one that names no file may be.
        if error.filename is None and error.errno != errno.ENOSPC:
            raise
        if error.filename is None:
            _give_up_stdout()
        where = "the output" if error.filename is None else str(error.filename)
        sys.stderr.write(f"echolume: {where}: {error.strerror}\n")
        return 1


def _main(argv: Sequence[str] | None) -> int:
    arguments = list(sys.argv[1:] if argv is None else argv)
    if arguments and arguments[0] == "--version":
        sys.stdout.write(f"echolume {version('echolume')}\n")
        return 0
    found = commands()
    if not arguments or arguments[0] in ("-h", "--help", "help"):
        sys.stdout.write(overview(found))
        return 0 if arguments else 2
    name, *rest = arguments
    if name not in found:
        sys.stderr.write(f"echolume: there is no command {name!r}; `echolume --help` lists them\n")
        return 2
    return _run(found[name], name, rest)


def _run(entry: EntryPoint, name: str, rest: list[str]) -> int:
    from echolume_messages.errors import EcholumeError

    try:
        module = entry.load()
    except KeyboardInterrupt:
        return _interrupted()
    except ModuleNotFoundError as error:
        if error.name is None or error.name.startswith("echolume"):
            raise
        sys.stderr.write(
            f"echolume: `{name}` needs {error.name!r}, which is not installed; "
            f"install the extra that has it: pip install 'echolume[rig]' or 'echolume[lab]'\n"
        )
        return 2
    parser = argparse.ArgumentParser(
        prog=f"echolume {name}",
        description=module.__doc__,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    module.configure(parser)
    args = parser.parse_args(rest)
    level = os.environ.get("ECHOLUME_LOG", "").upper() or "INFO"
    if level not in logging.getLevelNamesMapping():
        known = ", ".join(logging.getLevelNamesMapping())
        sys.stderr.write(f"echolume: $ECHOLUME_LOG is {level!r}; known levels: {known}\n")
        return 2
    logging.basicConfig(level=level, format="%(levelname)s %(name)s: %(message)s")
    try:
        return int(module.run(args))
    except EcholumeError as error:
        sys.stderr.write(f"echolume: {error}\n")
        return error.exit_code
    except KeyboardInterrupt:
        return _interrupted()


def _give_up_stdout() -> None:
    """Let the interpreter's last flush go nowhere, instead of failing on the closed pipe."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _interrupted() -> int:
    sys.stderr.write("echolume: interrupted\n")
    return 130
