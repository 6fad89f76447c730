"""Draw the paper's figures: those of sound itself from equations alone, those of a scan from its archive.

example:
  echolume figures --out figures
  echolume figures demo-out/raw.mcap --out figures --json

Without an archive: pressure on the axis (equations 5 and 6), beam (figure 3), contact points (figure 5), energy over
the plate's angle (figure 6) and Table I, which is printed beside ours. With one, figures 8 to 13 of that scan as well.
"""

from __future__ import annotations

import argparse
import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING

from echolume_messages.files import make_folder
from echolume_processing.commands.report_table import say_aside

if TYPE_CHECKING:
    from echolume_processing.ultrasonic.table_one import TableFit


def configure(parser: argparse.ArgumentParser) -> None:
    """Add the command's arguments."""
    parser.add_argument("archive", type=Path, nargs="?", help="raw.mcap of a scan, for its figures 8 to 13")
    parser.add_argument("--out", type=Path, default=Path("figures"), help="folder for the pictures (default: figures)")
    parser.add_argument("--json", action="store_true", help="print Table I and the names of the pictures as JSON")


def run(args: argparse.Namespace) -> int:
    """Draw the figures and print Table I."""
    from echolume_processing import figures_physics
    from echolume_processing.ultrasonic.table_one import fit_table, fit_table_with_cross_talk, table_lines

    out = make_folder(args.out)
    of_scan = [] if args.archive is None else _of_scan(args.archive, out)
    plain, lifted = fit_table(), fit_table_with_cross_talk()
    drawn = figures_physics.draw(plain, lifted, out) + of_scan
    if args.json:
        sys.stdout.write(json.dumps(_report(plain, lifted, drawn), indent=1) + "\n")
        return 0
    lines = [
        "Table I, fits of energy over the plate's angle to a Gaussian (equation 9)",
        "",
        *table_lines(plain, lifted),
        "",
        f"k R alone         {plain.wavenumber_radius:.3f}: c off by {plain.rms_c_deg:.2f} deg RMS, "
        f"{plain.rms_c_without_row_1_deg:.2f} without row 1",
        f"with cross-talk   {lifted.wavenumber_radius:.3f}, level {lifted.level:.4f}: {lifted.rms_c_deg:.2f} deg RMS, "
        f"{lifted.rms_c_without_row_1_deg:.2f} without row 1 (a hypothesis; the paper names no cross-talk)",
        "",
        f"{out}: {', '.join(path.name for path in drawn)}",
    ]
    sys.stdout.write("\n".join(lines) + "\n")
    return 0


def _of_scan(archive: Path, out: Path) -> list[Path]:
    """Figures 8 to 13 of a scan, from its archive as `echolume reprocess` reads it."""
    from echolume_processing import figures, session
    from echolume_processing.hybrid.baselines import baselines
    from echolume_processing.hybrid.fuse import fuse

    say_aside(f"reading {archive}")
    evidence = session.gather(archive)
    optical, ultrasonic = evidence.all_optical(), evidence.all_ultrasonic()
    say_aside(f"fusing {len(optical)} points of light and {len(ultrasonic)} of sound")
    found = fuse(optical, evidence.all_pings(), evidence.calibration, evidence.plan.map)
    return figures.draw(optical, ultrasonic, found, baselines(optical, ultrasonic, evidence.plan.map), out)


def _report(plain: TableFit, lifted: TableFit, drawn: list[Path]) -> dict[str, object]:
    """Table I and the files, as JSON takes it."""
    from echolume_processing.ultrasonic.table_one import TABLE_I

    rows = [
        {
            "distance_mm": row[0],
            "separation_mm": row[1],
            "paper": {"a": row[2], "b_deg": row[3], "c_deg": row[4]},
            "offset_b_deg": float(plain.offsets_deg[k]),
            "kR_alone": {"a": row[2] + float(plain.residuals_a[k]), "c_deg": row[4] + float(plain.residuals_c_deg[k])},
            "with_cross_talk": {
                "a": row[2] + float(lifted.residuals_a[k]),
                "c_deg": row[4] + float(lifted.residuals_c_deg[k]),
            },
        }
        for k, row in enumerate(TABLE_I)
    ]
    return {
        "kR": plain.wavenumber_radius,
        "rms_c_deg": plain.rms_c_deg,
        "rms_c_without_row1_deg": plain.rms_c_without_row_1_deg,
        "with_cross_talk": {
            "kR": lifted.wavenumber_radius,
            "level": lifted.level,
            "rms_c_deg": lifted.rms_c_deg,
            "rms_c_without_row1_deg": lifted.rms_c_without_row_1_deg,
        },
        "table": rows,
        "files": [str(path) for path in drawn],
    }
