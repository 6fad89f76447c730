"""What a calibration of the array found, as figures for machines and as lines for people."""

from __future__ import annotations

import msgspec
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from echolume_messages.geometry import Matrix, Points3, invert
from echolume_messages.rig import ArraySettings
from echolume_processing.ultrasonic.calibrate import ArrayResult, nominal_flange_from_array
from echolume_processing.ultrasonic.pose_covariance import POSE_NAMES

HALF_PRESSURE = 2.215
"""k R sin(angle) at which a disk sends half of its pressure."""


def figures(result: ArrayResult, settings: ArraySettings) -> dict[str, object]:
    """All figures of a calibration, ready for JSON; angles in degrees."""
    plate, block, footprint, found = result.plate, result.block, result.footprint, result.calibration
    offsets = [invert(nominal_flange_from_array(settings)) @ plate.flange_from_array, found.robot_pose]
    values = np.concatenate([_six(o) for o in offsets])
    sigmas = _pose_sigmas(result)
    moved = np.array(found.receivers_mm) - np.array(settings.layout.receivers_mm)
    measured: dict[str, object] = {
        "undetermined": list(plate.undetermined),
        "receivers_undetermined": list(plate.receivers_undetermined),
        "accepted": True,
        "reasons": result.reasons,
        "pings_used": result.pings_used,
        "pings_rejected": result.pings_rejected,
        "path_rms_mm": plate.path_rms_mm,
        "level_rms": plate.level_rms,
        "left_out_sigma": float(np.sqrt(np.nanmean(plate.left_out))),
        "speed_of_sound_mps": plate.speed_mps,
        "speed_sigma_mps": plate.sigmas["speed of sound"],
        "temperature_c": plate.temperature_c,
        "radius_mm": plate.radius_mm,
        "radius_sigma_mm": plate.radius_sigma_mm,
        "half_pressure_deg": _half_pressure_deg(result),
        "poses": {
            name: {"offset": value, "sigma": sigma}
            for name, value, sigma in zip(POSE_NAMES, values.tolist(), sigmas.tolist(), strict=True)
        },
        "receivers_moved_mm": moved.tolist(),
        "receivers_sigma_mm": plate.receivers_sigma_mm.tolist(),
        "delays_s": found.delays_s,
        "delays_sigma_s": np.sqrt(np.diag(plate.delay_covariance_s2)).tolist(),
        "gains": found.gains,
        "gains_sigma": found.gains_sigma if found.gains_sigma is not msgspec.UNSET else None,
        "block_explained": block.explained if block is not None else None,
        "footprint_mm": footprint.radius_mm if footprint is not None else None,
        "footprint_sigma_mm": footprint.sigma_mm if footprint is not None else None,
        "footprint_height_mm": footprint.height_mm if footprint is not None else None,
        "footprint_expected_mm": footprint.expected_mm if footprint is not None else None,
        "footprint_hz": footprint.frequency_hz if footprint is not None else None,
        "footprint_agrees": footprint.agrees if footprint is not None else None,
    }
    return measured


def lines(result: ArrayResult, settings: ArraySettings) -> list[tuple[str, str]]:
    """Name and words of each line of the report."""
    plate, block, footprint = result.plate, result.block, result.footprint
    speed_sigma, drawn_mm = plate.sigmas["speed of sound"], settings.layout.radius_mm
    out = [
        ("array", "accepted"),
        ("pings used", f"{result.pings_used}; left out: {result.pings_rejected or 'none'}"),
        ("paths", f"{plate.path_rms_mm:.3f} mm rms"),
        ("speed of sound", f"{plate.speed_mps:.2f} +- {speed_sigma:.2f} m/s at {plate.temperature_c:.1f} C"),
        ("effective radius", f"{plate.radius_mm:.2f} +- {plate.radius_sigma_mm:.2f} mm, drawn {drawn_mm:.2f}"),
        ("half pressure", f"{_half_pressure_deg(result):.1f} degrees off the axis"),
    ]
    offsets = [invert(nominal_flange_from_array(settings)) @ plate.flange_from_array, result.calibration.robot_pose]
    values, sigmas = np.concatenate([_six(o) for o in offsets]), _pose_sigmas(result)
    for name, value, sigma in zip(POSE_NAMES, values.tolist(), sigmas.tolist(), strict=True):
        unit = "deg" if name.endswith((" rx", " ry", " yaw")) else "mm"
        out.append((name, f"{value:+.3f} +- {sigma:.3f} {unit}" if np.isfinite(sigma) else "not measured"))
    moved = np.array(result.calibration.receivers_mm) - np.array(settings.layout.receivers_mm)
    out.extend(
        (f"receiver {k}", f"{_three(shift)} mm off its drawing, +- {_three(sigma, '.3f')}")
        for k, (shift, sigma) in enumerate(zip(moved, plate.receivers_sigma_mm, strict=True))
    )
    whole_us = 1e6 * float(np.mean(np.sqrt(np.diag(plate.delay_covariance_s2))))
    apart_us = 1e6 * float(np.mean(_apart(plate.delay_covariance_s2)))
    out.append(("delays", f"+- {whole_us:.2f} us in common, +- {apart_us:.3f} us among each other"))
    if block is not None:
        out.append(("block", f"{block.explained:.1%} of its echoes explained"))
    if footprint is not None:
        radius, sigma = footprint.at(result.calibration.reference_mm)
        out.append(("footprint", f"{radius:.1f} +- {sigma:.1f} mm at {result.calibration.reference_mm:.0f} mm"))
    return [*out, *(("", reason) for reason in result.reasons)]


def _six(pose: Matrix) -> NDArray[np.float64]:
    """x, y, z in mm and rotation vector in degrees."""
    turned = np.asarray(Rotation.from_matrix(pose[:3, :3]).as_rotvec(), dtype=np.float64)
    return np.concatenate([pose[:3, 3], np.degrees(turned)])


def _pose_sigmas(result: ArrayResult) -> NDArray[np.float64]:
    """Of `POSE_NAMES`, mm and degrees; not a number where nothing was measured."""
    covariance = result.calibration.pose_covariance
    if isinstance(covariance, msgspec.UnsetType):
        out = np.array([result.plate.sigmas.get(name, np.nan) for name in POSE_NAMES])
    else:
        out = np.sqrt(np.diag(np.array(covariance, dtype=np.float64)))
    angles = [name.endswith((" rx", " ry", " yaw")) for name in POSE_NAMES]
    return np.where(angles, np.degrees(out), out)


def _half_pressure_deg(result: ArrayResult) -> float:
    """Angle off the axis at which one transducer sends half of its pressure, at the middle of the band."""
    found = result.calibration
    wavenumber = np.pi * (found.low_hz + found.high_hz) / (1e3 * found.speed_of_sound_mps)
    sine = HALF_PRESSURE / max(float(wavenumber * found.radius_mm), HALF_PRESSURE)
    return float(np.degrees(np.arcsin(sine)))


def _apart(covariance: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviations of values less their mean."""
    centre = np.eye(len(covariance)) - 1 / len(covariance)
    return np.sqrt(np.diag(centre @ covariance @ centre))


def _three(vector: Points3, form: str = "+.3f") -> str:
    return ", ".join(format(v, form) for v in vector.tolist())
