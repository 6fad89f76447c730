"""Compiles or loads the kernels of the echo chain ahead of the first ping."""

from __future__ import annotations

import numpy as np

from echolume_messages.calibration import ArrayCalibration
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.cycles import resolve_cycles
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline

RATE_HZ, SPEED_MPS = 250e3, 343.0
PULSE, SAMPLES = 100, 1024
STEPS_MM = (-15.0, 0.0, 15.0)


def warm_up() -> None:
    """Process a made-up ping of a plate 150 mm below: after this, no ping is late for a compiler."""
    receivers = np.array([(x, y, 0.0) for y in STEPS_MM for x in STEPS_MM if x or y])
    paths_mm = np.linalg.norm(receivers - (0.0, 0.0, 300.0), axis=1)
    pulse = np.hanning(PULSE) * np.sin(2 * np.pi * 45e3 / RATE_HZ * np.arange(PULSE))
    calibration = ArrayCalibration(
        emitter_mm=(0.0, 0.0, 0.0),
        receivers_mm=[(float(x), float(y), float(z)) for x, y, z in receivers],
        radius_mm=6.0,
        low_hz=30e3,
        high_hz=60e3,
        delays_s=[0.0] * len(receivers),
        gains=[8000.0] * len(receivers),
        templates=[(8000 * pulse).tolist()] * len(receivers),
        template_origin=0.0,
        sample_rate_hz=RATE_HZ,
        reference_mm=150.0,
        speed_of_sound_mps=SPEED_MPS,
        temperature_c=20.0,
        flange_from_array=np.eye(4).tolist(),
        rig_from_robot=np.eye(4).tolist(),
        path_rms_mm=0.0,
    )
    echoes = np.zeros((len(receivers), SAMPLES), dtype=np.int16)
    for row, path_mm in zip(echoes, paths_mm.tolist(), strict=True):
        first = round(1e-3 * path_mm / SPEED_MPS * RATE_HZ)
        row[first : first + PULSE] = np.rint(8000 * pulse)
    UltrasonicPipeline(calibration).process(Ping(0, echoes, np.zeros(6), RATE_HZ, 0.0, 20.0))
    sigma_mm = np.full(len(receivers), 0.05)
    resolve_cycles(receivers, paths_mm, sigma_mm, 1e3 * SPEED_MPS / 45e3, paths_mm, sigma_mm)
