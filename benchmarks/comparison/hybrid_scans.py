"""Scans of the emulated rig through its wires, each read into memory and its archives deleted at once."""

from __future__ import annotations

import subprocess
import sys
import tempfile
from dataclasses import dataclass
from pathlib import Path

from echolume.evaluation import images
from echolume.evaluation.images import Reference
from echolume_processing.evidence import Evidence
from echolume_processing.session import gather

NO_BETTER = 9
"""Exit code of a demo whose scan is whole, but whose map does not beat both senses."""


@dataclass(frozen=True)
class Recorded:
    """A scan, with the calibration that the rig made itself, and its truth."""

    scene: str
    evidence: Evidence
    truth: Reference


def scan(scene: str, seed: int, pulse: str = "wideband") -> Recorded:
    """Build, calibrate and scan an emulated rig.

    Raises
    ------
    RuntimeError
        The demo failed; its last words are in the message.
    """
    with tempfile.TemporaryDirectory(prefix="echolume-bench-") as name:
        options = ["--scene", scene, "--seed", str(seed), "--pulse", pulse, "--out", name]
        done = subprocess.run(
            [sys.executable, "-m", "echolume", "demo", *options], capture_output=True, text=True, check=False
        )
        if done.returncode not in (0, NO_BETTER):
            raise RuntimeError(f"echolume demo {' '.join(options)}: exit {done.returncode}: {done.stderr[-800:]}")
        return load(Path(name), scene)


def load(folder: Path, scene: str) -> Recorded:
    """The scan of a demo's folder."""
    evidence = gather(folder / "raw.mcap")
    return Recorded(scene, evidence, images.reference(folder / "truth.npz", evidence.plan.map))
