"""A small emulated scan for the tests of the fusion: optical points from the scene, echoes from the emulator."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from echolume_drivers.emulated.array_truth import ArrayTruth, array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.scene import Material, Scene, SceneBuilder, plate
from echolume_drivers.emulated.transducer import speed_of_sound_mps
from echolume_messages.calibration import ArrayCalibration, Calibration, CameraCalibration, LaserCalibration
from echolume_messages.geometry import transform
from echolume_messages.plan import MapField, UltrasonicPass, raster
from echolume_messages.rig import ArraySettings
from echolume_messages.types import OPTICAL_POINT, OpticalSource
from echolume_processing.ping import Ping

FIELD = MapField(x_mm=(-48.0, 48.0), y_mm=(-48.0, 48.0), cell_mm=1.0)
TEMPERATURE_C = 22.0
REFERENCE_MM = 150.0
BEFORE = 48
AFTER = {"wideband": 112, "paper": 360}
FIRST_PING = 1000


@dataclass(frozen=True)
class SmallScan:
    """What a scan of a small scene brings home."""

    scene: Scene
    optical: np.ndarray
    pings: list[Ping]
    calibration: Calibration


def glass_and_black() -> Scene:
    """A glass plate 24 mm above the bench, a black block of 17 mm, a matte step of 12 mm."""
    scene = SceneBuilder("small")
    scene.box((-43, -3), (-38, 7), 24.0, Material.GLASS)
    scene.box((8, 41), (-41, -9), 17.0, Material.BLACK)
    scene.box((-20, 30), (22, 40), 12.0)
    return scene.build()


def all_matte() -> Scene:
    """The same shapes, all matte."""
    scene = glass_and_black()
    return replace(scene, name="small-matte", optical_mm=scene.front_mm, material=np.zeros_like(scene.material))


def small_scan(
    scene: Scene, seed: int = 1, pitch_mm: float = 12.0, pulse: Literal["wideband", "paper"] = "wideband"
) -> SmallScan:
    """Scan a scene; the calibration is a little wrong, as a real one is."""
    rng = np.random.default_rng(seed)
    settings = ArraySettings(port="", pulse=pulse)
    truth = array_truth(seed, settings)
    poses = np.array(raster(UltrasonicPass(name="s", x_mm=(-48, 48), y_mm=(-48, 48), pitch_mm=pitch_mm, height_mm=150)))
    pings = [
        Ping(
            FIRST_PING + k,
            simulate_ping(scene, truth.rig_from_array(pose), settings, truth, TEMPERATURE_C, rng),
            pose,
            settings.sample_rate_hz,
            0.0,
            TEMPERATURE_C,
        )
        for k, pose in enumerate(poses)
    ]
    return SmallScan(scene, _optical(scene, rng), pings, calibration_of(settings, truth, rng))


def triggers(points: np.ndarray) -> np.ndarray:
    """Trigger of the stripe that each optical point is of."""
    return np.round(points["x_mm"] + 200).astype(np.uint32)


def stripes(points: np.ndarray) -> dict[int, np.ndarray]:
    """Optical points by the stripe that they belong to."""
    number = triggers(points)
    return {int(k): points[number == k] for k in np.unique(number)}


def _optical(scene: Scene, rng: np.random.Generator) -> np.ndarray:
    """Points of active triangulation from the left with 0.1 mm of noise, none on black."""
    x_mm, y_mm = np.meshgrid(np.arange(-70.0, 70.0, 1.0), np.arange(-70.0, 70.0, 0.3))
    j = np.floor((y_mm - scene.y0_mm) / scene.cell_mm).astype(int)
    i = np.floor((x_mm + 0.5 - scene.x0_mm) / scene.cell_mm).astype(int)
    seen = scene.material[j, i] != Material.BLACK
    points = np.zeros(int(seen.sum()), dtype=OPTICAL_POINT)
    points["x_mm"], points["y_mm"] = x_mm[seen] + 0.5, y_mm[seen]
    points["z_mm"] = scene.optical_mm[j, i][seen] + rng.normal(0, 0.1, points.size)
    points["sigma_z_mm"], points["source"] = 0.1, OpticalSource.ACTIVE_LEFT
    return points


def calibration_of(settings: ArraySettings, truth: ArrayTruth, rng: np.random.Generator) -> Calibration:
    """What a calibration would find: templates over a plate, the pose 0.1 mm off, the radius 3 % off."""
    down = transform(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, REFERENCE_MM]))
    plates = [simulate_ping(plate(), down, settings, truth, TEMPERATURE_C, rng) for _ in range(4)]
    record = np.mean(plates, axis=0)
    elements = np.array([settings.layout.emitter_mm, *settings.layout.receivers_mm])
    path_mm = np.linalg.norm(elements[1:] - (elements[0] + [0, 0, 2 * REFERENCE_MM]), axis=1)
    speed_mps = speed_of_sound_mps(TEMPERATURE_C)
    arrival = (path_mm / (speed_mps * 1e3) + truth.delays_s) * settings.sample_rate_hz - BEFORE
    turn = np.exp(2j * np.pi * np.fft.rfftfreq(record.shape[1]) * arrival[:, None])
    templates = np.fft.irfft(np.fft.rfft(record, axis=1) * turn, n=record.shape[1], axis=1)[
        :, : BEFORE + AFTER[settings.pulse]
    ]
    templates[:, -24:] *= np.cos(np.linspace(0, np.pi / 2, 24))
    moved = truth.flange_from_array @ transform(np.eye(3), np.array([0.06, -0.05, 0.07]))
    camera = CameraCalibration(
        width_px=8, height_px=8, camera_matrix=np.eye(3).tolist(), distortion=[0.0] * 5,
        camera_from_rig=np.eye(4).tolist(), rms_px=0.1,
    )  # fmt: skip
    laser = LaserCalibration(normal=(1.0, 0.0, 0.0), offset_mm=0.0, guide_direction=(1.0, 0.0, 0.0), rms_mm=0.1)
    array = ArrayCalibration(
        emitter_mm=settings.layout.emitter_mm,
        receivers_mm=settings.layout.receivers_mm,
        radius_mm=truth.radius_mm * 1.03,
        low_hz=settings.layout.low_hz,
        high_hz=settings.layout.high_hz,
        delays_s=truth.delays_s.tolist(),
        gains=np.abs(templates).max(axis=1).tolist(),
        templates=templates.tolist(),
        template_origin=float(BEFORE),
        sample_rate_hz=settings.sample_rate_hz,
        reference_mm=REFERENCE_MM,
        speed_of_sound_mps=speed_mps * (1 + 5e-4),
        temperature_c=TEMPERATURE_C,
        flange_from_array=moved.tolist(),
        rig_from_robot=truth.rig_from_robot.tolist(),
        path_rms_mm=0.05,
    )
    return Calibration(rig="test", left=camera, right=camera, stereo_rms_px=0.1, laser=laser, array=array)
