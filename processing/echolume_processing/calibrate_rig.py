"""Calibrate a whole rig from the archive of one calibration scan: cameras, laser, array."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from echolume_messages.calibration import Calibration
from echolume_messages.rig import ArraySettings
from echolume_processing.optical.calibrate_rig import calibrate_optics
from echolume_processing.ultrasonic.from_archive import calibrate_array_from_archive


def calibrate_rig(path: Path, rig: str, array: ArraySettings) -> tuple[Calibration, dict[str, Any]]:
    """Calibrate cameras, laser and array.

    Parameters
    ----------
    path
        Archive of a scan with the passes ``board-NN``, ``laser-NN``, ``plate``, ``block-light``, ``block-sound``.
    rig
        Name of the rig, which the calibration will belong to.
    array
        The array's nominal build.

    Returns
    -------
    Calibration
    dict
        Figures: RMS of cameras, laser and array, views kept and left out with their reasons.

    Raises
    ------
    CalibrationRejectedError
        The archive does not determine the calibration; the message names what is missing.
    """
    optics = calibrate_optics(path)
    result = calibrate_array_from_archive(path, optics.left, optics.right, optics.laser, array)
    calibration = Calibration(
        rig=rig,
        left=optics.left,
        right=optics.right,
        stereo_rms_px=optics.stereo_rms_px,
        laser=optics.laser,
        array=result.calibration,
    )
    figures = {
        "left_rms_px": optics.left.rms_px,
        "right_rms_px": optics.right.rms_px,
        "stereo_rms_px": optics.stereo_rms_px,
        "plane_rms_mm": optics.laser.rms_mm,
        "path_rms_mm": result.calibration.path_rms_mm,
        "views": len(optics.report.views),
        "views_left_out": optics.report.rejected,
        "pings_left_out": result.pings_rejected,
    }
    return calibration, figures
