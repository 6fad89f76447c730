"""How well cameras are calibrated from published photographs of a chessboard (13 stereo pairs, 25 mm squares)."""

from __future__ import annotations

import os
from pathlib import Path

from echolume_processing.commands.image_pairs import read_pairs
from echolume_processing.optical.calibrate import calibrate_cameras

ROOT = Path(__file__).resolve().parents[2]
SQUARE_MM = 25.0
PATTERN = (9, 6)
VIEWS = 13


def folder() -> Path:
    """Where the photographs lie: ``$ECHOLUME_DATA``, else beside the project."""
    return Path(os.environ.get("ECHOLUME_DATA", "") or ROOT.parent / "shared" / "data") / "opencv-stereo"


def calibration_rows() -> dict[str, float]:
    """Figures of the calibration by key, empty where the photographs are absent.

    Returns
    -------
    dict of str to float
        RMS reprojection errors (``real_left_px``, ``real_right_px``, ``real_stereo_px``), and by how much the
        triangulated squares are off in the mean and scatter (``real_square_bias_mm``, ``real_square_sd_mm``).
    """
    if not folder().is_dir():
        print(f"real boards: no folder {folder()}; set ECHOLUME_DATA")
        return {}
    names, left, right = read_pairs(folder())
    pair = calibrate_cameras(left, right, PATTERN, SQUARE_MM, names)
    if len(pair.views) != VIEWS:
        raise RuntimeError(f"real boards: {len(pair.views)} of {VIEWS} views used: {pair.rejected}")
    left_out = pair.left_out
    print(f"real boards: views left out in turn: {left_out.rms_px:.4f} px, {left_out.rms_mm:.3f} mm RMS")
    return {
        "real_left_px": pair.left_rms_px,
        "real_right_px": pair.right_rms_px,
        "real_stereo_px": pair.stereo_rms_px,
        "real_square_bias_mm": abs(pair.square_mm[0] - SQUARE_MM),
        "real_square_sd_mm": pair.square_mm[1],
    }


if __name__ == "__main__":
    for key, value in calibration_rows().items():
        print(f"{key:20} {value:.4f}")
