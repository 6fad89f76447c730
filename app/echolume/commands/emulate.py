"""Run the emulated rig by itself: every device answers over the same wire as a real one.

Prints where its rig file is; the services, `echolume scan` and any other program then use it like a real rig's.
Ends on Ctrl-C, SIGTERM or the control's ``quit``, with the laser off and nothing left behind.

example: echolume emulate --out emulated --speed 20
then, elsewhere: echolume serve guide --rig emulated/rig.toml
"""

from __future__ import annotations

import argparse
import signal
import sys
import threading
from pathlib import Path
from types import FrameType

from echolume.scene_option import add_scene_option


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("--out", type=Path, default=Path("emulated"), help="folder for rig.toml (default emulated)")
    parser.add_argument("--seed", type=int, default=1, help="seed of the rig's build and its noise (default 1)")
    parser.add_argument("--speed", type=float, default=1.0, help="how much faster than real the axes move (default 1)")
    add_scene_option(parser)
    parser.add_argument(
        "--pulse",
        choices=("wideband", "paper"),
        default="wideband",
        help="ultrasonic transducers: 30-60 kHz, or the paper's 40 kHz narrow band",
    )
    parser.add_argument("--room", choices=("dark", "bright"), default="dark", help="light around: dark lab, lamps on")
    parser.add_argument("--bare", action="store_true", help="without the relay that opens the laser line by itself")


def run(args: argparse.Namespace) -> int:
    """Run until told to stop; 0 after an orderly end."""
    stop = threading.Event()

    def end(number: int, frame: FrameType | None) -> None:
        del number, frame
        stop.set()

    signal.signal(signal.SIGTERM, end)
    signal.signal(signal.SIGINT, end)
    from echolume_drivers.emulated.rig import EmulatedRig
    from echolume_messages.files import make_folder

    out: Path = args.out
    emulated = EmulatedRig(args.seed, args.scene, args.speed, args.pulse, out, bare=args.bare, room=args.room)
    make_folder(out)
    with emulated as rig:
        sys.stdout.write(
            f"emulated rig {rig.rig.name} is ready: {rig.rig_file}\n"
            f"  use it:   echolume serve router --rig {rig.rig_file}   (likewise guide, cameras, robot, array, ...)\n"
            f"  control:  {rig.control_address} (JSON lines: place, truth, fault, status, quit)\n"
            "  end it:   Ctrl-C\n"
        )
        sys.stdout.flush()
        while not stop.is_set() and not rig.wait(0.1):
            pass
        left_on = rig.stage.laser_on
    sys.stdout.write(f"emulated rig ended; its hosts left the laser {'ON: switched off now' if left_on else 'off'}\n")
    return 0
