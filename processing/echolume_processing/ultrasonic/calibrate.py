"""Calibrate the array: templates, gains, delays, speed of sound, and its pose to the rig in six degrees of freedom."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import msgspec
import numpy as np
from numpy.typing import NDArray

from echolume_messages.calibration import ArrayCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, Points3, robot_from_flange, rotation_from_euler, transform
from echolume_messages.rig import ArraySettings
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.air import speed_of_sound_mps
from echolume_processing.ultrasonic.array_verdict import mispredicted, reasons, require_mounting, require_predicted
from echolume_processing.ultrasonic.block import BlockFit, fit_block
from echolume_processing.ultrasonic.footprint import Footprint, fit_footprint
from echolume_processing.ultrasonic.pipeline import (
    MAX_PATH_MM,
    MIN_PATH_MM,
    UPSAMPLING,
    UltrasonicPipeline,
    waveforms_from_counts,
)
from echolume_processing.ultrasonic.plate import Levels, PlateFit, fit_plate, plate_paths
from echolume_processing.ultrasonic.plate_problem import LEVEL_SIGMA
from echolume_processing.ultrasonic.pose_covariance import joint_covariance
from echolume_processing.ultrasonic.templates import Templates, cut_templates, reference_pings
from echolume_processing.ultrasonic.wiring import require_heights, require_wiring

REFERENCE_MM = 150.0
"""Height of the perpendicular pings that become the templates, where the plan offers a choice."""
GATE_MM = 60.0
"""The plate's echo is looked for this far around its nominal path."""
DIRECT_MM = 60.0
"""The direct sound arrives, electrical delay included, within this path."""
MIN_DIRECT = 0.05
PING_RMS_MM = 0.3
UPRIGHT = float(np.cos(np.radians(3.0)))
MIN_PINGS = 6


@dataclass(frozen=True)
class ArrayResult:
    """The calibration and what speaks for it."""

    calibration: ArrayCalibration
    plate: PlateFit
    block: BlockFit | None
    pings_used: int
    pings_rejected: list[int]
    """Triggers whose paths do not fit the plate."""
    footprint: Footprint | None = None
    reasons: list[str] = field(default_factory=list[str])
    """Why it was accepted, and what to know about it, in plain words."""


def nominal_flange_from_array(settings: ArraySettings) -> Matrix:
    """How the array was built on, (4, 4)."""
    x, y, z, rx, ry, rz = settings.nominal_flange_from_array_mm_deg
    return transform(
        rotation_from_euler(*(float(np.radians(a)) for a in (rx, ry, rz))), np.array([x, y, z], dtype=np.float64)
    )


def _provisional(
    pings: Sequence[Ping], settings: ArraySettings, nominal: Matrix
) -> tuple[ArrayCalibration, Templates, NDArray[np.float64]]:
    """Templates from the perpendicular pings, everything else nominal; and the nominal paths (pings, receivers)."""
    layout = settings.layout
    emitter, receivers = np.array(layout.emitter_mm), np.array(layout.receivers_mm)
    poses = np.array([robot_from_flange(p.robot_pose) @ nominal for p in pings])
    paths = plate_paths(poses, emitter, receivers)
    chosen = reference_pings(pings, nominal[:3, 2], REFERENCE_MM)
    first = pings[chosen[0]]
    speed = 1e3 * speed_of_sound_mps(first.air_temperature_c)
    path = float(paths[chosen[0]].mean())
    band = (layout.low_hz, layout.high_hz) if settings.pulse == "wideband" else (36e3, 44e3)
    cut = cut_templates(pings, chosen, band, (path - GATE_MM) / speed, (path + 2.5 * GATE_MM) / speed)
    calibration = ArrayCalibration(
        emitter_mm=layout.emitter_mm,
        receivers_mm=list(layout.receivers_mm),
        radius_mm=layout.radius_mm,
        low_hz=band[0],
        high_hz=band[1],
        delays_s=[0.0] * len(receivers),
        gains=cut.peaks.tolist(),
        templates=cut.waveforms.astype(np.float64).tolist(),
        template_origin=(path / speed - first.start_s) * first.sample_rate_hz - cut.first_sample,
        sample_rate_hz=first.sample_rate_hz,
        reference_mm=0.5 * path,
        speed_of_sound_mps=1e-3 * speed,
        temperature_c=first.air_temperature_c,
        flange_from_array=nominal.tolist(),
        rig_from_robot=np.eye(4).tolist(),
        path_rms_mm=0.0,
    )
    return calibration, cut, paths


def _echoes(
    pings: Sequence[Ping], calibration: ArrayCalibration, paths_mm: NDArray[np.float64]
) -> tuple[NDArray[np.float64], Levels]:
    """Arrival of the plate's echo after the emission, (pings, receivers), and its level."""
    pipeline = UltrasonicPipeline(calibration)
    times_s, amplitudes = np.full(paths_mm.shape, np.nan), np.full(paths_mm.shape, np.nan)
    for k, ping in enumerate(pings):
        gate = (float(paths_mm[k].min()) - GATE_MM, float(paths_mm[k].max()) + GATE_MM)
        times_s[k], amplitudes[k] = pipeline.strongest(ping, gate)
    frequency_hz, weights = pipeline.band_weights(pings[0].echoes.shape[1])
    return times_s, Levels(amplitudes, frequency_hz, weights, calibration.radius_mm)


def _direct_times(
    pings: Sequence[Ping], chosen: list[int], calibration: ArrayCalibration
) -> NDArray[np.float64] | None:
    """Arrival of the direct sound after the emission (receivers,); None where the pulse is too long to tell it."""
    pipeline = UltrasonicPipeline(calibration)
    first = pings[chosen[0]]
    if first.start_s > 0 or calibration.high_hz - calibration.low_hz < 0.4 * calibration.low_hz:
        return None
    mean = np.mean([waveforms_from_counts(pings[k].echoes) for k in chosen], axis=0, dtype=np.float32)
    magnitude = np.abs(pipeline.compress(np.asarray(mean, dtype=np.float32), first.sample_rate_hz))
    rate_hz = first.sample_rate_hz * UPSAMPLING
    early = magnitude[:, : int(DIRECT_MM / (1e3 * calibration.speed_of_sound_mps) * rate_hz)]
    peak = np.clip(np.argmax(early, axis=1), 1, early.shape[1] - 2)
    rows = np.arange(len(early))
    left, middle, right = early[rows, peak - 1], early[rows, peak], early[rows, peak + 1]
    clear = (middle >= left) & (middle > right) & (middle > MIN_DIRECT)
    shift = 0.5 * (left - right) / np.where(clear, left - 2 * middle + right, -1.0)
    return np.where(clear, (peak + shift) / rate_hz, np.nan)


def _gain_sigmas(levels: Levels, cut: Templates, slopes: NDArray[np.float64]) -> NDArray[np.float64]:
    """Standard deviation of each channel's gain in counts, from how levels scatter among upright pings, (receivers,).

    A ping's channels share most of it: with k pings averaged to the templates, a k-th of both variances remains.
    """
    upright = np.hypot(*slopes.T) < np.sin(np.arccos(UPRIGHT))
    logs = np.log(levels.amplitudes[upright])
    logs = logs[np.isfinite(logs).all(axis=1)]
    apart = logs - logs.mean(axis=1, keepdims=True)
    apart = apart - apart.mean(axis=0)
    channel = float(np.sqrt(np.sum(apart**2) / max(1, (len(apart) - 1) * (apart.shape[1] - 1))))
    return cut.peaks * np.hypot(LEVEL_SIGMA, channel) / np.sqrt(len(cut.pings))


def _require_heights(pings: Sequence[Ping], calibration: ArrayCalibration, nominal: Matrix) -> None:
    """Paths of upright pings, wherever they are, against the heights that the robot says."""
    upright = [p for p in pings if (robot_from_flange(p.robot_pose) @ nominal)[2, 2] < -UPRIGHT]
    pipeline = UltrasonicPipeline(calibration)
    times_s = np.array([pipeline.strongest(p, (MIN_PATH_MM, MAX_PATH_MM))[0] for p in upright])
    known = np.isfinite(times_s).any(axis=1)
    paths = np.full(len(upright), np.nan)
    paths[known] = 1e3 * calibration.speed_of_sound_mps * np.nanmedian(times_s[known], axis=1)
    require_heights(paths, np.array([p.robot_pose[2] for p in upright]))


def calibrate_plate(pings: Sequence[Ping], settings: ArraySettings) -> ArrayResult:
    """Everything that pings at tilted poses over the plate z = 0 can tell; x, y and yaw of the robot stay nominal.

    Raises
    ------
    CalibrationRejectedError
        Too few pings, no perpendicular one, silent receivers, an undetermined parameter (named), or a bad fit.
    """
    if len(pings) < MIN_PINGS:
        raise CalibrationRejectedError(
            f"array calibration: the pass 'plate' has {len(pings)} pings, {MIN_PINGS} are needed"
        )
    nominal = nominal_flange_from_array(settings)
    provisional, cut, paths = _provisional(pings, settings, nominal)
    _require_heights(pings, provisional, nominal)
    times, levels = _echoes(pings, provisional, paths)
    direct = _direct_times(pings, cut.pings, provisional)
    poses = np.array([p.robot_pose for p in pings])
    temperatures = np.array([p.air_temperature_c for p in pings])
    emitter, receivers = np.array(provisional.emitter_mm), np.array(provisional.receivers_mm)
    slopes = np.array([(robot_from_flange(p) @ nominal)[2, :2] for p in poses])
    require_wiring(times * (1e3 * provisional.speed_of_sound_mps), slopes, receivers)

    def fitted(kept: NDArray[np.bool_]) -> PlateFit:
        part = replace(levels, amplitudes=levels.amplitudes[kept])
        return fit_plate(poses[kept], times[kept], temperatures[kept], emitter, receivers, nominal, direct, part)

    fit = fitted(np.ones(len(pings), dtype=np.bool_))
    require_mounting(fit, nominal)
    require_predicted(fit, [p.trigger for p in pings])
    known = np.isfinite(fit.residuals_mm)
    spread = np.sqrt(np.nansum(fit.residuals_mm**2, axis=1) / np.maximum(known.sum(axis=1), 1))
    limit_mm = max(PING_RMS_MM, 4 * float(np.nanmedian(np.abs(fit.residuals_mm))))
    good = (spread < limit_mm) & (known.sum(axis=1) >= len(receivers) / 2) & ~mispredicted(fit)
    if np.count_nonzero(good) < MIN_PINGS or np.count_nonzero(good) < 0.7 * len(pings):
        raise CalibrationRejectedError(
            f"array calibration: only {int(np.count_nonzero(good))} of {len(pings)} pings fit the plate (rms "
            f"{fit.path_rms_mm:.2f} mm); is the bench bare and flat, and the nominal mounting of the array right?"
        )
    if not good.all():
        fit = fitted(good)
    array_pose = fit.rig_from_robot @ robot_from_flange(poses[cut.pings[0]])
    array_pose = array_pose @ fit.flange_from_array
    calibration = msgspec.structs.replace(
        provisional,
        receivers_mm=[(x, y, z) for x, y, z in fit.receivers_mm.tolist()],
        radius_mm=fit.radius_mm,
        delays_s=fit.delays_s.tolist(),
        reference_mm=float((array_pose[:3, :3] @ emitter + array_pose[:3, 3])[2]),
        speed_of_sound_mps=fit.speed_mps,
        temperature_c=fit.temperature_c,
        flange_from_array=fit.flange_from_array.tolist(),
        rig_from_robot=fit.rig_from_robot.tolist(),
        path_rms_mm=fit.path_rms_mm,
        receivers_sigma_mm=[(x, y, z) for x, y, z in fit.receivers_sigma_mm.tolist()],
        delay_covariance_s2=fit.delay_covariance_s2.tolist(),
        gains_sigma=_gain_sigmas(levels, cut, slopes).tolist(),
        radius_sigma_mm=fit.radius_sigma_mm,
        speed_sigma_mps=fit.sigmas["speed of sound"],
    )
    rejected = [pings[int(k)].trigger for k in np.flatnonzero(~good)]
    return ArrayResult(calibration, fit, None, int(np.count_nonzero(good)), rejected, None, reasons(fit, None))


def calibrate_array(
    pings_plate: Sequence[Ping],
    pings_block: Sequence[Ping],
    optical_block_points_mm: Points3,
    settings: ArraySettings,
) -> ArrayResult:
    """Calibrate the array completely.

    Parameters
    ----------
    pings_plate : pings at perpendicular and tilted poses over the bare bench (`poses.plate_poses`)
    pings_block : raster over the block (`poses.block_poses`)
    optical_block_points_mm : (n, 3) float64
        What light sees of the block and the bench around it, rig frame.
    settings : ArraySettings
        Nominal build.

    Raises
    ------
    CalibrationRejectedError
        With the reason in plain words: what stays undetermined (and the poses that would determine it), what is wired
        or counted the wrong way round, or what was moved.
    """
    plate = calibrate_plate(pings_plate, settings)
    block = fit_block(pings_block, optical_block_points_mm, plate.calibration)
    calibration = msgspec.structs.replace(plate.calibration, rig_from_robot=block.rig_from_robot.tolist())
    poses = np.array([p.robot_pose for p in pings_block])
    covariance = joint_covariance(calibration, plate.plate.pose_covariance, block.covariance, poses)
    footprint = fit_footprint(pings_block, optical_block_points_mm, calibration)
    radius_mm, sigma_mm = footprint.at(calibration.reference_mm)
    calibration = msgspec.structs.replace(
        calibration,
        pose_covariance=covariance.tolist(),
        footprint_mm=radius_mm,
        footprint_sigma_mm=sigma_mm,
        footprint_hz=footprint.frequency_hz,
    )
    found = reasons(plate.plate, footprint)
    return ArrayResult(calibration, plate.plate, block, plate.pings_used, plate.pings_rejected, footprint, found)
