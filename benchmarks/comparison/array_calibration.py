"""Figures of the array's calibration: errors against the emulator's truth beside what the calibration states."""

from __future__ import annotations

from collections.abc import Mapping
from unittest import mock

import numpy as np

from echolume_drivers.emulated.array_truth import ArrayTruth, array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.scene import SCENES, Scene
from echolume_messages.calibration import ArrayCalibration
from echolume_messages.geometry import robot_from_flange, rotation_angle_rad, rotation_from_vector, transform
from echolume_messages.plan import Pose6
from echolume_messages.rig import ArraySettings
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic import plate_problem
from echolume_processing.ultrasonic.calibrate import ArrayResult, calibrate_array, calibrate_plate
from echolume_processing.ultrasonic.handeye import solve_ax_xb, solve_ax_zb
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline
from echolume_processing.ultrasonic.plate import fit_plate
from echolume_processing.ultrasonic.plate_model import Levels, near_field_mm, plate_levels, plate_paths
from echolume_processing.ultrasonic.pose_covariance import array_pose_covariance
from echolume_processing.ultrasonic.poses import block_poses, plate_poses

SETTINGS = ArraySettings(port="none")
DRAWN_MM = np.array(SETTINGS.layout.receivers_mm)
AIR_C = 22.0
TRUE_MPS = 331.3 * float(np.sqrt(1 + AIR_C / 273.15))
SEEDS = (1, 2, 3, 4, 5)
DRAWS = 60
MOVES = 100
NOMINAL = transform(np.diag([1.0, -1.0, -1.0]), np.zeros(3))
CHECKS: list[Pose6] = [
    (20.0, -30.0, 120.0, 10.0, 0.0, 0.0), (-30.0, 10.0, 140.0, 0.0, -10.0, 30.0), (0.0, 30.0, 160.0, -7.0, 7.0, -20.0),
    (40.0, 40.0, 180.0, 5.0, 8.0, 0.0),
]  # fmt: skip
PLACES = np.array([[0.0, 0, 150, 0, 0, 0], [60.0, -40, 120, 0, 0, 0], [-50.0, 50, 200, 0.1, -0.1, 0.3]])

TARGETS: Mapping[str, str] = {
    "array_pose_mm": "0.2 (demo's fusion)",
    "array_pose_deg": "0.2",
    "array_pose_nees": "0.5-1.5 (priors are wide)",
    "plate_nees": "0.8-1.1",
    "delay_nees": "0.8-1.2",
    "receiver_mm": "below receiver_drawn_mm",
    "footprint_x_fresnel": "0.7-1.3",
    "handeye_xb_nees": "0.9-1.1",
    "handeye_zb_nees": "0.9-1.1",
}
"""No figure is asked of the calibration; this is what they were held against."""


def take(scene: Scene, poses: list[Pose6], truth: ArrayTruth, seed: int) -> list[Ping]:
    """Emulated pings."""
    rng = np.random.default_rng([seed, len(poses)])
    out: list[Ping] = []
    for number, (x, y, z, *angles) in enumerate(poses):
        pose = np.array([x, y, z, *np.radians(angles)])
        echoes = simulate_ping(scene, truth.rig_from_array(pose), SETTINGS, truth, AIR_C, rng)
        warm = AIR_C + truth.thermometer_error_k
        out.append(Ping(number, echoes, pose, SETTINGS.sample_rate_hz, SETTINGS.start_s, warm))
    return out


def seen_by_light(scene: Scene) -> np.ndarray:
    """Points of the block, stripes 1 mm apart, 0.03 mm of noise."""
    x, y = np.meshgrid(np.arange(-40.5, 56.5, 1.0), np.arange(-40.0, 52.0, 0.2) + 0.1)
    column = np.floor((x - scene.x0_mm) / scene.cell_mm).astype(int)
    row = np.floor((y - scene.y0_mm) / scene.cell_mm + 1e-6).astype(int)
    z = scene.optical_mm[row, column] + np.random.default_rng(0).normal(0, 0.03, x.shape)
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def pose_error(truth: ArrayTruth, found: ArrayCalibration, at: np.ndarray) -> np.ndarray:
    """x, y, z in mm and rotation vector in rad, along the rig's axes."""
    pose = found.robot_pose @ robot_from_flange(at) @ found.array_pose
    true = truth.rig_from_array(at)
    turned = pose[:3, :3] @ true[:3, :3].T
    return np.array([*(pose - true)[:3, 3], turned[2, 1], turned[0, 2], turned[1, 0]])


def normal_errors_deg(found: ArrayCalibration, pings: list[Ping]) -> list[float]:
    """Of the normals that tilted pings over the plate find."""
    points = [UltrasonicPipeline(found).process(ping) for ping in pings]
    up = [np.array([p[n][0] for n in ("nx", "ny", "nz")], dtype=np.float64) for p in points if len(p)]
    return [float(np.degrees(np.arctan2(np.hypot(n[0], n[1]), n[2]))) for n in up]


def delay_errors_us(truth: ArrayTruth, found: ArrayCalibration) -> np.ndarray:
    """Less their mean: templates are cut at common samples, so a delay undoes the reference's differences in path."""
    pose = truth.rig_from_array(np.array([0.0, 0, 150, 0, 0, 0]))
    places = DRAWN_MM + truth.placement_mm * [1, 1, 0]
    paths = plate_paths(pose[None], np.zeros(3), places)[0]
    late = 1e6 * np.array(found.delays_s) + 1e3 * paths / TRUE_MPS
    return late - late.mean()


def calibrated(seed: int) -> tuple[ArrayTruth, ArrayResult, ArrayCalibration, list[float], list[float]]:
    """Truth, calibration, the plate's with receivers held as drawn, and both ones' errors of normals."""
    truth, block = array_truth(seed, SETTINGS), SCENES["block"]()
    plate = take(SCENES["plate"](), plate_poses(), truth, seed)
    result = calibrate_array(plate, take(block, block_poses(), truth, seed), seen_by_light(block), SETTINGS)
    with mock.patch.object(plate_problem, "PLACEMENT_SIGMA_MM", (1e-4, 1e-4, 1e-4)):
        held = calibrate_plate(plate, SETTINGS).calibration
    checks = take(SCENES["plate"](), CHECKS, truth, seed + 100)
    return truth, result, held, normal_errors_deg(result.calibration, checks), normal_errors_deg(held, checks)


def emulated_rows() -> dict[str, float]:
    """Errors against the emulator's truth over several arrays."""
    collected: dict[str, list[float]] = {}

    def add(name: str, *values: float) -> None:
        collected.setdefault(name, []).extend(values)

    print("seed  pose mm  sigma    deg  sigma  receivers  drawn     m/s  footprint")
    for seed in SEEDS:
        truth, result, _, normals, held = calibrated(seed)
        found, footprint = result.calibration, result.footprint
        assert footprint is not None
        errors = [pose_error(truth, found, at) for at in PLACES]
        covariances = [array_pose_covariance(found, at) for at in PLACES]
        for error, covariance in zip(errors, covariances, strict=True):
            assert covariance is not None
            add("pose_mm", float(np.linalg.norm(error[:3])))
            add("pose_deg", float(np.degrees(np.linalg.norm(error[3:]))))
            add("pose_sigma_mm", float(np.sqrt(np.trace(covariance[:3, :3]))))
            add("pose_sigma_deg", float(np.degrees(np.sqrt(np.trace(covariance[3:, 3:])))))
            add("nees", float(error @ np.linalg.solve(covariance, error)) / 6)
        nominal = np.linalg.inv(truth.rig_from_array(PLACES[0])) @ robot_from_flange(PLACES[0]) @ NOMINAL
        add("nominal_mm", float(np.linalg.norm(nominal[:3, 3])))
        add("nominal_deg", float(np.degrees(rotation_angle_rad(nominal[:3, :3]))))
        off = (np.array(found.receivers_mm) - DRAWN_MM - truth.placement_mm)[:, :2]
        add("receivers", *off.ravel())
        add("receivers_within", *(off - off.mean(axis=0)).ravel())
        add("drawn", *truth.placement_mm[:, :2].ravel())
        add("delays", *delay_errors_us(truth, found))
        speed = found.speed_of_sound_mps - TRUE_MPS
        add("speed", speed)
        gains = np.array(found.gains) / truth.gains
        add("gains", *(gains / gains.mean() - 1))
        add("radius", found.radius_mm - truth.radius_mm)
        add("footprint", footprint.radius_mm / footprint.expected_mm)
        add("left_out", float(np.nanmean(result.plate.left_out)))
        add("normal", *normals)
        add("held", *held)
        last = {k: v[-1] for k, v in collected.items()}
        print(
            f"{seed:4}{last['pose_mm']:9.3f}{last['pose_sigma_mm']:7.3f}{last['pose_deg']:7.3f}{last['pose_sigma_deg']:7.3f}"
            f"{np.sqrt(np.mean(off**2)):11.3f}{np.std(truth.placement_mm[:, :2]):7.3f}{speed:+8.3f}"
            f"{footprint.radius_mm:6.1f}/{footprint.expected_mm:.1f}"
        )
    rms = {name: float(np.sqrt(np.mean(np.square(values)))) for name, values in collected.items()}
    return {
        "array_pose_mm": rms["pose_mm"], "array_pose_sigma_mm": rms["pose_sigma_mm"],
        "array_pose_nominal_mm": rms["nominal_mm"],
        "array_pose_deg": rms["pose_deg"], "array_pose_sigma_deg": rms["pose_sigma_deg"],
        "array_pose_nominal_deg": rms["nominal_deg"],
        "array_pose_nees": float(np.mean(collected["nees"])),
        "receiver_drawn_mm": rms["drawn"], "receiver_mm": rms["receivers"],
        "receiver_less_common_mm": rms["receivers_within"],
        "normal_deg_calibrated": rms["normal"], "normal_deg_receivers_as_drawn": rms["held"],
        "delay_us_rms": rms["delays"], "gain_rel_rms": rms["gains"], "speed_mps_rms": rms["speed"],
        "radius_error_mm": rms["radius"], "footprint_x_fresnel": float(np.mean(collected["footprint"])),
        "left_out_chi2": float(np.mean(collected["left_out"])),
    }  # fmt: skip


def imposed(rng: np.random.Generator) -> tuple[float, float]:
    """NEES of pose and of delays of one array that is drawn from the fit's own assumptions."""
    basis = plate_problem.placement_basis(np.zeros(3), DRAWN_MM)
    p = rng.normal(0, 1, 11) * [1, 1, 1, *np.radians([1, 1, 1]), 1, *np.radians([1, 1]), 0.01 * TRUE_MPS, 0.05]
    placed = (basis @ rng.normal(0, 1, basis.shape[1])).reshape(-1, 3)
    poses = np.array(plate_poses()) * [1, 1, 1, *np.radians([1, 1, 1])]
    flange = NOMINAL @ transform(rotation_from_vector(p[3:6]), p[:3])
    rig = transform(rotation_from_vector(np.array([p[7], p[8], 0])), np.array([0, 0, p[6]]))
    array = rig @ np.array([robot_from_flange(q) for q in poses]) @ flange
    radius, speed, delays = 6.2 * (1 + p[10]), 1e3 * (TRUE_MPS + p[9]), rng.uniform(7, 20, 8)
    paths = plate_paths(array, np.zeros(3), DRAWN_MM + placed)
    noise = rng.normal(0, 0.02, paths.shape) + rng.normal(0, 0.05, (len(poses), 1))
    times = (paths + near_field_mm(paths, radius, 302.0) + delays + noise) / speed
    direct = (np.linalg.norm(DRAWN_MM, axis=1) + delays + rng.normal(0, 0.5)) / speed
    frequency, weights = np.array([38e3, 45e3, 52e3]), np.array([0.25, 0.5, 0.25])
    level = plate_levels(array, np.zeros(3), DRAWN_MM, 2e-3 * np.pi * frequency / TRUE_MPS, weights, radius)
    levels = Levels(level * np.exp(rng.normal(0, 0.015, (len(poses), 1))), frequency, weights, 6.2)
    found = fit_plate(poses, times, np.full(len(poses), AIR_C), np.zeros(3), DRAWN_MM, NOMINAL, direct, levels)
    first, second = np.linalg.inv(flange) @ found.flange_from_array, found.rig_from_robot @ np.linalg.inv(rig)
    error = np.array([*first[:3, 3], first[2, 1], first[0, 2], first[1, 0], second[2, 3], second[2, 1], second[0, 2]])
    late = found.delays_s - (delays - placed[:, 2]) / speed
    pose = float(error @ np.linalg.solve(found.pose_covariance, error)) / 9
    return pose, float(late @ np.linalg.solve(found.delay_covariance_s2, late)) / 8


def imposed_rows() -> dict[str, float]:
    """Consistency of the plate fit over arrays drawn from its own assumptions."""
    rng = np.random.default_rng(1)
    nees = np.array([imposed(rng) for _ in range(DRAWS)]).mean(axis=0)
    return {"plate_nees": float(nees[0]), "delay_nees": float(nees[1])}


def handeye_rows() -> dict[str, float]:
    """Hand-eye: consistency, and error beside the closed form's."""
    rng = np.random.default_rng(2)
    x = transform(rotation_from_vector(np.array([3.1, 0.2, -0.1])), np.array([4.0, -7.0, 52.0]))
    z = transform(rotation_from_vector(np.array([0.02, -0.01, 0.4])), np.array([120.0, -80.0, 3.0]))
    turns = rng.normal(0, 0.25, (12, 3))
    a = np.array([transform(rotation_from_vector(t), rng.normal(0, 80, 3)) for t in turns])
    sigma_mm, sigma_rad = 0.3, 2e-3
    nees: dict[str, list[float]] = {"xb": [], "zb": [], "joint": [], "closed": []}

    def noisy(poses: np.ndarray) -> np.ndarray:
        out = poses.copy()
        out[:, :3, 3] += rng.normal(0, sigma_mm, (len(poses), 3))
        out[:, :3, :3] @= np.array([rotation_from_vector(w) for w in rng.normal(0, sigma_rad, (len(poses), 3))])
        return out

    def small(moved: np.ndarray) -> np.ndarray:
        return np.array([*moved[:3, 3], moved[2, 1], moved[0, 2], moved[1, 0]])

    for _ in range(MOVES):
        b = noisy(np.linalg.inv(x) @ a @ x)
        found = solve_ax_xb(a, b, sigma_mm, sigma_rad)
        error = small(np.linalg.inv(x) @ found.x)
        nees["xb"].append(float(error @ np.linalg.solve(found.covariance, error)) / 6)
        nees["joint"].append(float(np.linalg.norm(error[3:])))
        # without weight on translations only the rotations speak: the closed form
        alone = small(np.linalg.inv(x) @ solve_ax_xb(a, b, 1e5, sigma_rad, wanted_mm=1e9).x)
        nees["closed"].append(float(np.linalg.norm(alone[3:])))
        both = solve_ax_zb(a, noisy(np.linalg.inv(z) @ a @ x), sigma_mm, sigma_rad)
        assert both.z is not None
        error = np.concatenate([small(np.linalg.inv(x) @ both.x), small(both.z @ np.linalg.inv(z))])
        nees["zb"].append(float(error @ np.linalg.solve(both.covariance, error)) / 12)
    rms = {name: float(np.sqrt(np.mean(np.square(v)))) for name, v in nees.items()}
    return {
        "handeye_xb_nees": float(np.mean(nees["xb"])),
        "handeye_zb_nees": float(np.mean(nees["zb"])),
        "handeye_joint_over_rotations_alone": rms["joint"] / rms["closed"],
    }


def array_calibration_rows() -> dict[str, float]:
    """All figures of the array's calibration, printed beside truth, stated sigmas and what they were held against."""
    print(f"\nCalibration of the array on {len(SEEDS)} emulated ones, the demo's plan, errors at three poses each")
    figures = emulated_rows() | imposed_rows() | handeye_rows()
    print(f"\n{'array calibration':36}{'measured':>10}   held against")
    for key, value in figures.items():
        print(f"{key:36}{value:10.4f}   {TARGETS.get(key, '')}".rstrip())
    return figures


if __name__ == "__main__":
    array_calibration_rows()
