"""Whether a calibration of the array is accepted, and why, in plain words."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, invert, rotation_angle_rad
from echolume_processing.ultrasonic.footprint import DISAGREES, Footprint
from echolume_processing.ultrasonic.plate import PlateFit
from echolume_processing.ultrasonic.plate_problem import MOUNTING_SIGMA_MM, MOUNTING_SIGMA_RAD

FAR = 6.0
"""Mounting sigmas: what sits further from the rig file's place is mounted otherwise than it says."""
MISPREDICTED = 9.0
"""Chi-squared per path: a ping which the others predict this badly is not where the robot says."""
MAX_MISPREDICTED = 0.1
"""Share of the pings."""


def require_mounting(fit: PlateFit, nominal_flange_from_array: Matrix) -> None:
    """Refuse an array that sits far from where the rig file has it.

    Raises
    ------
    CalibrationRejectedError
        Saying how far.
    """
    for name, offset in (
        ("array on the flange", invert(nominal_flange_from_array) @ fit.flange_from_array),
        ("robot on the rig", fit.rig_from_robot),
    ):
        far_mm = float(np.linalg.norm(offset[:3, 3]))
        far_rad = rotation_angle_rad(offset[:3, :3])
        if far_mm > FAR * MOUNTING_SIGMA_MM or far_rad > FAR * MOUNTING_SIGMA_RAD:
            raise CalibrationRejectedError(
                f"array calibration: the {name} sits {far_mm:.1f} mm and {np.degrees(far_rad):.1f} degrees from where "
                "the rig file has it; correct `nominal_flange_from_array_mm_deg` or the mounting, and calibrate again"
            )


def mispredicted(fit: PlateFit) -> NDArray[np.bool_]:
    """Pings that the fit without them predicts far worse than its sigma, (pings,)."""
    return fit.left_out > MISPREDICTED


def require_predicted(fit: PlateFit, triggers: Sequence[int]) -> None:
    """Refuse a fit that does not predict the poses that are left out of it.

    Parameters
    ----------
    triggers : numbers of the pings

    Raises
    ------
    CalibrationRejectedError
        Naming the pings.
    """
    bad = mispredicted(fit)
    if not bad.any():
        return
    names = [triggers[int(k)] for k in np.flatnonzero(bad)]
    times = float(np.sqrt(fit.left_out[bad].max()))
    if np.count_nonzero(bad) > MAX_MISPREDICTED * len(bad):
        raise CalibrationRejectedError(
            f"array calibration: pings {names} lie up to {times:.1f} sigma from where all others predict them; did the "
            "robot reach these poses, and is the bench bare there?"
        )


def reasons(fit: PlateFit, footprint: Footprint | None) -> list[str]:
    """What speaks for the calibration, and what to know about it."""
    known = fit.left_out[np.isfinite(fit.left_out)]
    out = [
        f"poses left out in turn are predicted to {float(np.sqrt(known.mean())):.2f} of their sigma, the worst to "
        f"{float(np.sqrt(known.max())):.2f}"
    ]
    placed_mm = float(np.sqrt(np.mean(fit.receivers_sigma_mm[:, :2] ** 2)))
    out.extend(f"not told apart: {words}" for words in fit.undetermined)
    if fit.receivers_undetermined:
        axes = ", ".join(fit.receivers_undetermined)
        out.append(f"receivers: {axes} not determined by these poses, kept as drawn")
    if not {"x", "y"} & set(fit.receivers_undetermined):
        out.append(f"receivers: places in the array's plane to {placed_mm:.2f} mm")
    if fit.suspicion is not None:
        out.append(f"a little as if {fit.suspicion.words}: too little to refuse")
    if footprint is not None:
        share = footprint.radius_mm / footprint.expected_mm - 1
        verdict = "agrees" if footprint.agrees else f"DISAGREES by more than {DISAGREES:.0%}"
        out.append(
            f"footprint {footprint.radius_mm:.1f} +- {footprint.sigma_mm:.1f} mm at {footprint.height_mm:.0f} mm "
            f"{verdict} with the first Fresnel zone, {footprint.expected_mm:.1f} mm ({share:+.0%})"
        )
    return out
