"""Round trips emulator -> calibration -> pipeline, against the emulator's truth."""

import dataclasses
import json
from collections.abc import Callable
from pathlib import Path

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated.array_truth import ArrayTruth, array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.scene import SCENES, Scene, SceneBuilder
from echolume_messages import plan as plans
from echolume_messages.calibration import ArrayCalibration
from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import robot_from_flange, rotation_angle_rad, rotation_from_vector, transform
from echolume_messages.plan import Pose6
from echolume_messages.rig import ArraySettings
from echolume_messages.types import EchoKind
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic import array_report, calibrate
from echolume_processing.ultrasonic.block import fit_block
from echolume_processing.ultrasonic.footprint import edge_response, top_of
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline, waveforms_from_counts
from echolume_processing.ultrasonic.pose_covariance import POSE_NAMES, array_pose_covariance
from echolume_processing.ultrasonic.poses import block_poses, plate_poses

SETTINGS = ArraySettings(port="none")
SEED = 2
AIR_C = 22.0


def take(scene: Scene, poses: list[Pose6], truth: ArrayTruth, settings: ArraySettings, seed: int) -> list[Ping]:
    rng = np.random.default_rng(seed)
    out = []
    for number, (x, y, z, rx, ry, rz) in enumerate(poses):
        pose = np.array([x, y, z, *np.radians([rx, ry, rz])])
        echoes = simulate_ping(scene, truth.rig_from_array(pose), settings, truth, AIR_C, rng)
        warm = AIR_C + truth.thermometer_error_k
        out.append(Ping(number, echoes, pose, settings.sample_rate_hz, settings.start_s, warm))
    return out


def seen_by_light(scene: Scene) -> np.ndarray:
    """Points of stripes 1 mm apart over the block and the bench around it."""
    x, y = np.meshgrid(np.arange(-40.5, 56.5, 1.0), np.arange(-40.0, 52.0, 0.2))
    column = np.floor((x - scene.x0_mm) / scene.cell_mm).astype(int)
    row = np.floor((y - scene.y0_mm) / scene.cell_mm + 1e-6).astype(int)
    z = scene.optical_mm[row, column] + np.random.default_rng(0).normal(0, 0.03, x.shape)
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


@pytest.fixture(scope="module")
def truth() -> ArrayTruth:
    return array_truth(SEED, SETTINGS)


@pytest.fixture(scope="module")
def over_plate(truth: ArrayTruth) -> list[Ping]:
    return take(SCENES["plate"](), plate_poses(), truth, SETTINGS, 1)


@pytest.fixture(scope="module")
def result(truth: ArrayTruth, over_plate: list[Ping]) -> calibrate.ArrayResult:
    block = SCENES["block"]()
    return calibrate.calibrate_array(
        over_plate,
        take(block, block_poses(), truth, SETTINGS, 2),
        seen_by_light(block),
        SETTINGS,
    )


def test_the_array_is_where_it_is(truth: ArrayTruth, result: calibrate.ArrayResult):
    pose = np.array([0.0, 0.0, 150.0, 0.0, 0.0, 0.0])
    found = result.calibration.robot_pose @ robot_from_flange(pose) @ result.calibration.array_pose
    error = np.linalg.inv(truth.rig_from_array(pose)) @ found
    assert np.abs(error[:3, 3]).max() < 0.2
    assert np.degrees(rotation_angle_rad(error[:3, :3])) < 0.2


@pytest.mark.parametrize("pose", [(0.0, 0.0, 150.0, 0.0, 0.0, 0.0), (80.0, -60.0, 200.0, 0.1, -0.2, 0.5)])
def test_the_joint_covariance_tells_how_far_off_the_array_may_be(
    truth: ArrayTruth, result: calibrate.ArrayResult, pose: tuple[float, ...]
):
    at = np.array(pose)
    covariance = array_pose_covariance(result.calibration, at)
    assert covariance is not None
    found = result.calibration.robot_pose @ robot_from_flange(at) @ result.calibration.array_pose
    true = truth.rig_from_array(at)
    turned = found[:3, :3] @ true[:3, :3].T
    error = np.array([*(found - true)[:3, 3], turned[2, 1], turned[0, 2], turned[1, 0]])
    sigma = np.sqrt(np.diag(covariance))
    assert np.all(sigma[:3] < 0.35)
    assert np.all(np.degrees(sigma[3:]) < 0.3)
    assert 0.02 < error @ np.linalg.solve(covariance, error) / 6 < 4


def test_receivers_are_nearer_to_where_they_are_than_as_drawn(truth: ArrayTruth, result: calibrate.ArrayResult):
    off = np.array(result.calibration.receivers_mm) - np.array(SETTINGS.layout.receivers_mm) - truth.placement_mm
    assert np.std(off[:, :2]) < 0.7 * np.std(truth.placement_mm[:, :2])
    apart = off - off.mean(axis=0)
    assert np.all(np.abs(apart) < 4 * np.array(result.calibration.receivers_sigma_mm))


def test_gains_and_their_sigmas_are_those_of_the_channels(truth: ArrayTruth, result: calibrate.ArrayResult):
    ratio = np.array(result.calibration.gains) / truth.gains
    share = np.array(result.calibration.gains_sigma) / np.array(result.calibration.gains)
    assert np.std(ratio / ratio.mean()) < 0.05
    assert np.all((share > 0.003) & (share < 0.02))


def test_the_footprint_is_the_first_fresnel_zone(result: calibrate.ArrayResult):
    found = result.footprint
    assert found is not None
    assert found.agrees
    assert found.radius_mm == pytest.approx(found.expected_mm, rel=0.1)
    assert 0 < found.sigma_mm < 1
    assert found.scatter < 0.05
    assert result.calibration.footprint_mm == pytest.approx(
        found.radius_mm * np.sqrt(result.calibration.reference_mm / found.height_mm)
    )


def test_the_report_says_what_was_found_and_what_was_not(result: calibrate.ArrayResult):
    text = "\n".join(f"{name} {words}" for name, words in array_report.lines(result, SETTINGS))
    for part in ("accepted", "z not determined", "agrees with the first Fresnel zone", "poses left out in turn"):
        assert part in text
    figures = json.loads(json.dumps(array_report.figures(result, SETTINGS)))
    assert set(figures["poses"]) == set(POSE_NAMES)
    assert figures["left_out_sigma"] == pytest.approx(1.0, abs=0.35)


def test_a_calibration_without_the_new_fields_stays_as_it_was(result: calibrate.ArrayResult):
    names = [n for n in ArrayCalibration.__struct_fields__ if n in ArrayCalibration.__struct_fields__[-9:]]
    assert names[0] == "receivers_sigma_mm"
    old = msgspec.structs.replace(result.calibration, **dict.fromkeys(names, msgspec.UNSET))
    text = msgspec.json.encode(old)
    assert not any(f'"{name}"'.encode() in text for name in names)
    assert msgspec.json.decode(text, type=ArrayCalibration) == old
    assert array_pose_covariance(old, np.zeros(6)) is None


def test_the_calibration_tells_how_good_it_is(truth: ArrayTruth, result: calibrate.ArrayResult):
    assert result.calibration.path_rms_mm < 0.08
    assert result.block is not None
    assert result.block.explained > 0.9
    assert result.pings_rejected == []
    assert result.calibration.radius_mm == pytest.approx(truth.radius_mm, abs=0.1)
    true_speed = 331.3 * np.sqrt(1 + AIR_C / 273.15)
    assert result.calibration.speed_of_sound_mps == pytest.approx(true_speed, abs=0.3)
    assert min(result.calibration.gains) > 5000


@pytest.mark.parametrize("height_mm", [0.0, 12.0, 40.0])
def test_a_flat_plate_is_measured_within_0p1_mm_and_0p3_degrees(
    truth: ArrayTruth, result: calibrate.ArrayResult, height_mm: float
):
    scene = plate_at(height_mm)
    poses: list[Pose6] = [(-30.0, 20.0, 150.0, 0, 0, 0), (40.0, -35.0, 150.0, 0, 0, 0), (0.0, 0.0, 130.0, 5, -4, 20)]
    pipeline = UltrasonicPipeline(result.calibration)
    points = [pipeline.process(ping) for ping in take(scene, poses, truth, SETTINGS, 5)]
    for found in points:
        assert len(found) == 8
        assert np.all(found["kind"] == EchoKind.PLANE)
        normal = np.array([found[n][0] for n in ("nx", "ny", "nz")])
        assert np.degrees(np.arccos(min(1.0, normal[2] / np.linalg.norm(normal)))) < 0.3
    heights = np.concatenate([found["z_mm"] for found in points])
    assert abs(float(np.mean(heights)) - height_mm) < 0.1
    assert np.abs(heights - height_mm).max() < 0.25


def plate_at(height_mm: float) -> Scene:
    plate = SCENES["plate"]()
    raised = np.full_like(plate.front_mm, height_mm)
    return Scene("plate", plate.x0_mm, plate.y0_mm, plate.cell_mm, raised, raised, plate.material)


def test_predicted_echoes_are_processed_exactly_as_measured_ones(truth: ArrayTruth, result: calibrate.ArrayResult):
    pipeline = UltrasonicPipeline(result.calibration)
    ping = take(SCENES["plate"](), [(0.0, 0.0, 150.0, 0.0, 0.0, 0.0)], truth, SETTINGS, 6)[0]
    floats = waveforms_from_counts(ping.echoes)
    again = pipeline.process_echoes(floats, ping.robot_pose, ping.sample_rate_hz, ping.start_s, ping.air_temperature_c)
    assert floats.dtype == np.float32
    assert pipeline.process(ping).tobytes() == again.tobytes()


def test_a_silent_record_has_no_points(result: calibrate.ArrayResult):
    pipeline = UltrasonicPipeline(result.calibration)
    ping = Ping(0, np.zeros((8, 1024), dtype=np.int16), np.zeros(6), 250e3, 0.0, 22.0)
    assert len(pipeline.process(ping)) == 0


def test_a_raster_without_tilts_is_refused_and_names_what_it_leaves_open(truth: ArrayTruth):
    poses: list[Pose6] = [(x, y, 150.0, 0.0, 0.0, 0.0) for x in (-60.0, 0.0, 60.0) for y in (-60.0, 0.0, 60.0)]
    pings = take(SCENES["plate"](), poses, truth, SETTINGS, 3)
    with pytest.raises(CalibrationRejectedError) as caught:
        calibrate.calibrate_plate(pings, SETTINGS)
    for name in ("flange_from_array x", "flange_from_array y", "flange_from_array yaw", "speed of sound"):
        assert name in str(caught.value)


def test_without_a_block_x_y_and_yaw_stay_undetermined(truth: ArrayTruth, result: calibrate.ArrayResult):
    with pytest.raises(CalibrationRejectedError, match="rig_from_robot x, rig_from_robot y, rig_from_robot yaw"):
        fit_block([], np.zeros((0, 3)), result.calibration)
    bench = take(SCENES["plate"](), block_poses(pitch_mm=40.0), truth, SETTINGS, 4)
    flat = seen_by_light(SCENES["plate"]())
    with pytest.raises(CalibrationRejectedError, match="light sees no block"):
        fit_block(bench, flat, result.calibration)


def test_a_block_that_sound_does_not_see_is_refused(truth: ArrayTruth, result: calibrate.ArrayResult):
    bench = take(SCENES["plate"](), block_poses(pitch_mm=30.0), truth, SETTINGS, 4)
    with pytest.raises(CalibrationRejectedError, match="block"):
        fit_block(bench, seen_by_light(SCENES["block"]()), result.calibration)


def crossed(ping: Ping) -> Ping:
    return dataclasses.replace(ping, echoes=ping.echoes[[0, 6, 2, 3, 4, 5, 1, 7]])


def other_way(axis: int) -> Callable[[Ping], Ping]:
    def turned(ping: Ping) -> Ping:
        pose = ping.robot_pose.copy()
        pose[axis] = 300 - pose[axis] if axis == 2 else -pose[axis]
        return dataclasses.replace(ping, robot_pose=pose)

    return turned


@pytest.mark.parametrize(
    ("spoiled", "words"),
    [
        (crossed, r"receivers \[1, 6\] are wired crosswise"),
        (other_way(2), "its z axis runs the other way"),
        (other_way(3), "rx runs the other way"),
        (other_way(4), "ry runs the other way"),
    ],
    ids=["crossed wires", "z", "rx", "ry"],
)
def test_what_is_wired_or_counted_the_wrong_way_is_named(
    over_plate: list[Ping], spoiled: Callable[[Ping], Ping], words: str
):
    with pytest.raises(CalibrationRejectedError, match=words):
        calibrate.calibrate_plate([spoiled(p) for p in over_plate], SETTINGS)


def test_a_bench_that_is_not_flat_is_refused(truth: ArrayTruth):
    book = SceneBuilder("book").box((15, 120), (-120, 120), 1.0).build()
    with pytest.raises(CalibrationRejectedError, match="is the bench bare and flat"):
        calibrate.calibrate_plate(take(book, plate_poses(), truth, SETTINGS, 1), SETTINGS)


def moved_by(truth: ArrayTruth, z_mm: float, rx_deg: float = 0.0) -> ArrayTruth:
    bump = transform(rotation_from_vector(np.radians([rx_deg, 0.0, 0.0])), np.array([0.0, 0.0, z_mm]))
    return dataclasses.replace(truth, rig_from_robot=bump @ truth.rig_from_robot)


def test_a_robot_that_was_bumped_among_the_pings_is_dated(truth: ArrayTruth, over_plate: list[Ping]):
    later = take(SCENES["plate"](), plate_poses()[14:], moved_by(truth, 0.5), SETTINGS, 3)
    with pytest.raises(CalibrationRejectedError, match="moved between pings 13 and 14"):
        calibrate.calibrate_plate([*over_plate[:14], *later], SETTINGS)


@pytest.mark.parametrize(
    ("z_mm", "rx_deg", "words"),
    [(0.4, 0.0, "mm higher"), (0.0, 0.6, "degrees more tilted"), (3.0, 0.0, "was moved after the pass 'plate'")],
)
def test_a_robot_that_was_bumped_between_the_passes_is_refused(
    truth: ArrayTruth, result: calibrate.ArrayResult, z_mm: float, rx_deg: float, words: str
):
    block = SCENES["block"]()
    pings = take(block, block_poses(pitch_mm=16.0), moved_by(truth, z_mm, rx_deg), SETTINGS, 2)
    plate_only = msgspec.structs.replace(result.calibration, rig_from_robot=result.plate.rig_from_robot.tolist())
    with pytest.raises(CalibrationRejectedError, match=words):
        fit_block(pings, seen_by_light(block), plate_only)


def test_an_array_mounted_far_from_its_place_is_refused(over_plate: list[Ping]):
    settings = msgspec.structs.replace(SETTINGS, nominal_flange_from_array_mm_deg=(0, 0, 25.0, 180, 0, 0))
    with pytest.raises(CalibrationRejectedError, match="from where the rig file has it"):
        calibrate.calibrate_plate(over_plate, settings)


def test_the_echo_of_an_edge_is_half_of_a_plates_and_an_endless_top_is_a_plate():
    share, weight = np.linspace(0.75, 1.25, 21), np.full(21, 1 / 21)
    x, y = np.meshgrid(np.arange(-150.5, 151.0), np.arange(-150.5, 151.0))
    places, areas = np.column_stack([x.ravel(), y.ravel()]), np.ones(x.size)
    middle = edge_response(np.zeros((1, 2)), top_of(places, areas), 18.0, share, weight)
    assert middle[0] == pytest.approx(1.0, abs=0.03)
    half = places[:, 0] > 0
    edge = edge_response(np.array([[0.0, 0.0], [-60.0, 0.0]]), top_of(places[half], areas[half]), 18.0, share, weight)
    assert edge[0] == pytest.approx(0.5, abs=0.03)
    assert edge[1] < 0.1


def test_too_few_pings_are_refused():
    with pytest.raises(CalibrationRejectedError, match="has 0 pings"):
        calibrate.calibrate_plate([], SETTINGS)


def test_a_dead_receiver_is_named(truth: ArrayTruth):
    pings = take(SCENES["plate"](), plate_poses(), truth, SETTINGS, 1)
    for ping in pings:
        ping.echoes[3] = np.random.default_rng(0).integers(-2, 3, 1024)
    with pytest.raises(CalibrationRejectedError, match=r"receivers \[3\]"):
        calibrate.calibrate_plate(pings, SETTINGS)


def test_the_narrow_band_array_of_the_paper_is_calibrated_too():
    settings = ArraySettings(port="none", pulse="paper")
    truth = array_truth(1, settings)
    found = calibrate.calibrate_plate(take(SCENES["plate"](), plate_poses(), truth, settings, 1), settings)
    assert found.calibration.path_rms_mm < 0.1
    error = np.linalg.inv(truth.flange_from_array) @ found.calibration.array_pose
    assert np.degrees(rotation_angle_rad(error[:3, :3])) < 0.3
    pipeline = UltrasonicPipeline(found.calibration)
    ping = take(SCENES["plate"](), [(10.0, 0.0, 150.0, 0.0, 0.0, 0.0)], truth, settings, 9)[0]
    assert abs(float(np.median(pipeline.process(ping)["z_mm"]))) < 0.2


def test_the_plan_of_the_array_holds_these_poses():
    path = Path(__file__).parents[2] / "app/echolume/plans/calibrate-array.toml"
    plan = plans.load(path)
    plate, light, sound = plan.passes
    assert isinstance(plate, plans.UltrasonicPass)
    assert isinstance(sound, plans.UltrasonicPass)
    assert (plate.name, light.name, sound.name) == ("plate", "block-light", "block-sound")
    assert plate.poses == plate_poses()
    assert plans.raster(sound) == block_poses()
