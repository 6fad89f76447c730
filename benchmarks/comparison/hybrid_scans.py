"""Scans of the emulated rig through its wires, kept where asked, else read into memory and deleted at once."""

from __future__ import annotations

import shutil
import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume.evaluation import images
from echolume.evaluation.images import Reference
from echolume.scoring import window
from echolume_drivers.emulated.scene_model import Expectation
from echolume_messages.plan import MapField
from echolume_processing.evidence import Evidence
from echolume_processing.session import gather

NO_BETTER = 9
"""Exit code of a demo whose scan is whole, but whose map one sense beats, or that says what it must not."""
PAPER = "paper-array"
"""The demo scene with the paper's 40 kHz array."""
NEEDED = ("raw.mcap", "truth.npz", "report.json")
"""Files of a demo's folder that a whole scan has; the last is written last."""


@dataclass(frozen=True)
class Asked:
    """What a scene asks of a map, on the map's cells; all images have the shape of the field."""

    expect: list[Expectation]
    regions: list[str]
    region: NDArray[np.integer]
    """Counts `regions`."""
    behind_mm: NDArray[np.float64]


@dataclass(frozen=True)
class Recorded:
    """A scan, with the calibration that the rig made itself, and its truth."""

    scene: str
    evidence: Evidence
    truth: Reference
    asked: Asked | None = None


def scan(name: str, seed: int, keep: Path | None = None) -> Recorded:
    """Build, calibrate and scan an emulated rig, or read what an earlier run has kept.

    Parameters
    ----------
    name
        A scene, or `PAPER`.
    seed
        Of the rig and its flaws.
    keep
        Folder of folders ``NAME-SEED``; one that is there and whole is used as it is, one that is not is made.

    Raises
    ------
    RuntimeError
        The demo failed; its last words are in the message.
    """
    if keep is None:
        with tempfile.TemporaryDirectory(prefix="echolume-bench-") as folder:
            return load(_made(name, seed, Path(folder)), name)
    kept = keep / f"{name}-{seed}"
    if not all((kept / each).exists() for each in NEEDED):
        part = kept.with_name(f".{kept.name}.part")
        shutil.rmtree(part, ignore_errors=True)
        _made(name, seed, part).rename(kept)
    return load(kept, name)


def _made(name: str, seed: int, folder: Path) -> Path:
    scene, pulse = ("demo", "paper") if name == PAPER else (name, "wideband")
    print(f"scanning {name}, seed {seed}", flush=True)
    options = ["--scene", scene, "--seed", str(seed), "--pulse", pulse, "--out", str(folder)]
    done = subprocess.run(
        [sys.executable, "-m", "echolume", "demo", *options], capture_output=True, text=True, check=False
    )
    if done.returncode not in (0, NO_BETTER):
        raise RuntimeError(f"echolume demo {' '.join(options)}: exit {done.returncode}: {done.stderr[-800:]}")
    return folder


def load(folder: Path, name: str) -> Recorded:
    """The scan of a demo's folder."""
    evidence = gather(folder / "raw.mcap")
    field = evidence.plan.map
    return Recorded(name, evidence, images.reference(folder / "truth.npz", field), _asked(folder / "truth.npz", field))


def _asked(truth: Path, field: MapField) -> Asked:
    with np.load(truth) as real:
        corner_mm, cell_mm = (float(real["x0_mm"]), float(real["y0_mm"])), float(real["cell_mm"])
        at = window(real["front_mm"].shape, *corner_mm, cell_mm, field)
        return Asked(
            msgspec.json.decode(str(real["expect"]), type=list[Expectation]),
            [str(region) for region in real["regions"]],
            real["region"][at],
            real["optical_mm"][at],
        )
