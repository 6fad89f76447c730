"""The fit over the plate, on paths with known noise: what is imposed is recovered within what the fit states."""

from dataclasses import dataclass

import numpy as np
import pytest

from echolume_messages.errors import CalibrationRejectedError
from echolume_messages.geometry import Matrix, robot_from_flange, rotation_from_euler, rotation_from_vector, transform
from echolume_messages.rig import ArrayElementLayout
from echolume_processing.ultrasonic.air import speed_of_sound_mps
from echolume_processing.ultrasonic.observability import loose_directions, poses_to_add
from echolume_processing.ultrasonic.plate import PlateFit, fit_plate
from echolume_processing.ultrasonic.plate_model import Levels, near_field_mm, path_slopes, plate_levels, plate_paths
from echolume_processing.ultrasonic.plate_problem import NAMES, PlateData, PlateProblem, placement_basis
from echolume_processing.ultrasonic.poses import plate_poses
from echolume_processing.ultrasonic.wiring import apparent_places, require_heights, require_wiring

RECEIVERS_MM = np.array(ArrayElementLayout().receivers_mm)
EMITTER_MM = np.zeros(3)
NOMINAL = transform(rotation_from_euler(np.pi, 0, 0), np.zeros(3))
POSES = np.array(plate_poses()) * [1, 1, 1, *np.radians([1, 1, 1])]
RADIUS_MM = 6.2
FREQUENCY_HZ, WEIGHTS = np.array([38e3, 45e3, 52e3]), np.array([0.25, 0.5, 0.25])


@dataclass(frozen=True)
class Draw:
    """One array, drawn from what the fit believes of mountings."""

    offsets: np.ndarray  # of NAMES
    placement_mm: np.ndarray
    delays_mm: np.ndarray
    radius_mm: float

    def poses(self) -> tuple[Matrix, Matrix]:
        flange = NOMINAL @ transform(rotation_from_vector(self.offsets[3:6]), self.offsets[:3])
        turn = rotation_from_vector(np.array([*self.offsets[7:9], 0.0]))
        return flange, transform(turn, np.array([0, 0, self.offsets[6]]))


def draw(rng: np.random.Generator, scale: float = 1.0) -> Draw:
    sigmas = np.array([1, 1, 1, *np.radians([1, 1, 1]), 1, *np.radians([1, 1]), 0.01 * speed_of_sound_mps(22.0)])
    basis = placement_basis(EMITTER_MM, RECEIVERS_MM)
    placement = (basis @ rng.normal(0, scale, basis.shape[1])).reshape(-1, 3)
    radius = RADIUS_MM * (1 + 0.05 * scale * rng.normal())
    return Draw(sigmas * rng.normal(0, scale, 10), placement, rng.uniform(7, 20, 8), radius)


def measured(truth: Draw, rng: np.random.Generator, poses: np.ndarray = POSES) -> tuple[np.ndarray, np.ndarray, Levels]:
    """Arrivals (pings, receivers), direct sound (receivers,) and levels, with the noise that the fit expects."""
    flange, rig = truth.poses()
    array = rig @ np.array([robot_from_flange(p) for p in poses]) @ flange
    places = RECEIVERS_MM + truth.placement_mm
    paths = plate_paths(array, EMITTER_MM, places)
    noise = rng.normal(0, 0.02, paths.shape) + rng.normal(0, 0.05, (len(poses), 1))
    speed = 1e3 * (speed_of_sound_mps(22.0) + truth.offsets[9])
    late = near_field_mm(paths, truth.radius_mm, 300.0)
    times = (paths + late + truth.delays_mm + noise) / speed
    direct = (np.linalg.norm(RECEIVERS_MM, axis=1) + truth.delays_mm + rng.normal(0, 0.5)) / speed
    levels = plate_levels(
        array, EMITTER_MM, places, 2e-3 * np.pi * FREQUENCY_HZ / speed_of_sound_mps(22.0), WEIGHTS, truth.radius_mm
    )
    levels = levels * 300 * np.exp(rng.normal(0, 0.015, (len(poses), 1)))
    return times, direct, Levels(levels, FREQUENCY_HZ, WEIGHTS, RADIUS_MM)


def fit(truth: Draw, rng: np.random.Generator, poses: np.ndarray = POSES) -> PlateFit:
    times, direct, levels = measured(truth, rng, poses)
    temperatures = np.full(len(poses), 22.0)
    return fit_plate(poses, times, temperatures, EMITTER_MM, RECEIVERS_MM, NOMINAL, direct, levels)


def errors(truth: Draw, found: PlateFit) -> np.ndarray:
    """Of the nine pose offsets, small."""
    flange, rig = truth.poses()
    first, second = np.linalg.inv(flange) @ found.flange_from_array, found.rig_from_robot @ np.linalg.inv(rig)
    return np.array([*first[:3, 3], first[2, 1], first[0, 2], first[1, 0], second[2, 3], second[2, 1], second[0, 2]])


def test_stated_covariances_hold_over_many_arrays():
    rng = np.random.default_rng(1)
    poses, speeds, places, delays, left_out = [], [], [], [], []
    for _ in range(10):
        truth = draw(rng, 0.8)
        found = fit(truth, rng)
        error = errors(truth, found)
        poses.append(error @ np.linalg.solve(found.pose_covariance, error) / 9)
        speeds.append((found.speed_mps - speed_of_sound_mps(22.0) - truth.offsets[9]) / found.sigmas["speed of sound"])
        off = found.receivers_mm - RECEIVERS_MM - truth.placement_mm
        places.append(np.mean((off / found.receivers_sigma_mm)[:, :2] ** 2))
        # z stays as drawn: what it adds to an upright path is the delay's
        speed = 1e3 * (speed_of_sound_mps(22.0) + truth.offsets[9])
        late = found.delays_s - (truth.delays_mm - truth.placement_mm[:, 2]) / speed
        delays.append(late @ np.linalg.solve(found.delay_covariance_s2, late) / 8)
        left_out.append(np.mean(found.left_out))
    assert 0.6 < np.mean(poses) < 1.3
    assert 0.5 < np.mean(np.square(speeds)) < 1.9
    assert 0.4 < np.mean(places) < 1.3
    assert 0.6 < np.mean(delays) < 1.4
    assert np.mean(left_out) == pytest.approx(1.0, abs=0.15)


def test_receivers_come_nearer_to_where_they_are():
    rng = np.random.default_rng(2)
    nominal, calibrated = [], []
    for _ in range(3):
        truth = draw(rng, 0.4)
        found = fit(truth, rng)
        nominal.append(truth.placement_mm[:, :2])
        calibrated.append((found.receivers_mm - RECEIVERS_MM - truth.placement_mm)[:, :2])
        assert found.receivers_undetermined == ("z",)
        np.testing.assert_array_equal(found.receivers_mm[:, 2], RECEIVERS_MM[:, 2])
    assert np.std(calibrated) < 0.35 * np.std(nominal)


def test_heights_are_told_only_as_a_sum_and_the_fit_says_so():
    found = fit(draw(np.random.default_rng(3), 0.5), np.random.default_rng(3))
    assert len(found.undetermined) <= 1
    sum_mm = np.sqrt(np.array([1, -1]) @ found.pose_covariance[np.ix_([2, 6], [2, 6])] @ [1, -1])
    assert sum_mm < 0.3
    assert found.sigmas["flange_from_array z"] > 0.2


def test_the_problems_slopes_are_those_of_its_residuals():
    rng = np.random.default_rng(4)
    times, direct, levels = measured(draw(rng), rng)
    times[3, 2] = np.nan
    data = PlateData(POSES, times, np.full(len(POSES), 22.0), direct, levels)
    problem = PlateProblem(data, EMITTER_MM, RECEIVERS_MM, NOMINAL)
    at = problem.start() + rng.normal(0, 0.2, problem.size)
    step = 1e-5
    numeric = np.column_stack(
        [
            (problem.residuals(at + step * e) - problem.residuals(at - step * e)) / (2 * step)
            for e in np.eye(problem.size)
        ]
    )
    np.testing.assert_allclose(problem.jacobian(at), numeric, atol=2e-3, rtol=2e-3)


def test_slopes_of_paths_with_places_are_those_of_the_paths():
    array = np.array([robot_from_flange(p) @ NOMINAL for p in POSES])
    slopes = path_slopes(array, EMITTER_MM, RECEIVERS_MM)
    for k, axis in enumerate(1e-4 * np.eye(3)):
        grown = plate_paths(array, EMITTER_MM, RECEIVERS_MM + axis) - plate_paths(
            array, EMITTER_MM, RECEIVERS_MM - axis
        )
        np.testing.assert_allclose(slopes[:, :, k], grown / 2e-4, atol=1e-7)


def test_placements_have_neither_turn_nor_shift_in_common():
    basis = placement_basis(EMITTER_MM, RECEIVERS_MM)
    assert basis.shape == (24, 18)
    for way in basis.T.reshape(-1, 8, 3):
        np.testing.assert_allclose(np.cross(RECEIVERS_MM, way).sum(axis=0), 0, atol=1e-6)
        np.testing.assert_allclose(way.sum(axis=0), 0, atol=1e-6)


@pytest.mark.parametrize(
    ("kept", "names", "advice"),
    [
        (np.abs(POSES[:, 3:5]).max(axis=1) == 0, ("flange_from_array x", "flange_from_array yaw"), "tilted about x"),
        (POSES[:, 2] == 150.0, ("speed of sound",), "heights from 70 to 250"),
    ],
    ids=["no tilt", "one height"],
)
def test_what_a_plan_leaves_open_is_named_with_the_poses_to_add(kept: np.ndarray, names: tuple[str, ...], advice: str):
    rng = np.random.default_rng(5)
    with pytest.raises(CalibrationRejectedError, match="add poses") as caught:
        fit(draw(rng, 0.5), rng, POSES[kept])
    for part in (*names, advice):
        assert part in str(caught.value)


def test_a_step_of_the_robot_is_told_from_noise_and_dated():
    rng = np.random.default_rng(6)
    times, direct, levels = measured(draw(rng, 0.5), rng)
    times[17:] += 1.2 / speed_of_sound_mps(22.0) * 1e-3
    with pytest.raises(CalibrationRejectedError, match="moved between pings 16 and 17"):
        fit_plate(POSES, times, np.full(28, 22.0), EMITTER_MM, RECEIVERS_MM, NOMINAL, direct, levels)


def test_a_few_slipped_paths_are_left_out_and_nobodys_fault():
    rng = np.random.default_rng(7)
    truth = draw(rng, 0.5)
    times, direct, levels = measured(truth, rng)
    times[[2, 9, 20], [1, 5, 7]] += 7.6 / speed_of_sound_mps(22.0) * 1e-3
    found = fit_plate(POSES, times, np.full(28, 22.0), EMITTER_MM, RECEIVERS_MM, NOMINAL, direct, levels)
    assert np.count_nonzero(np.isnan(found.residuals_mm)) == 3
    assert found.path_rms_mm < 0.07


class TestWiring:
    SLOPES = np.array([(robot_from_flange(p) @ NOMINAL)[2, :2] for p in POSES])

    def paths(self, places: np.ndarray) -> np.ndarray:
        array = np.array([robot_from_flange(p) @ NOMINAL for p in POSES])
        rng = np.random.default_rng(8)
        return plate_paths(array, EMITTER_MM, places) + rng.uniform(7, 20, 8) + rng.normal(0, 0.05, (28, 8))

    def test_each_channel_tells_where_its_receiver_sits(self):
        places = apparent_places(self.paths(RECEIVERS_MM), self.SLOPES)
        assert places is not None
        np.testing.assert_allclose(places, RECEIVERS_MM[:, :2], atol=0.6)
        require_wiring(self.paths(RECEIVERS_MM), self.SLOPES, RECEIVERS_MM)

    @pytest.mark.parametrize(("a", "b"), [(0, 1), (2, 5), (3, 4), (0, 7)])
    def test_crossed_wires_are_named(self, a: int, b: int):
        order = np.arange(8)
        order[[a, b]] = b, a
        with pytest.raises(CalibrationRejectedError, match=rf"receivers \[{a}, {b}\] are wired crosswise"):
            require_wiring(self.paths(RECEIVERS_MM[order]), self.SLOPES, RECEIVERS_MM)

    @pytest.mark.parametrize(
        ("signs", "words"), [((1, -1, 1), "rx runs the other way"), ((-1, 1, 1), "ry runs the other way")]
    )
    def test_a_tilt_that_runs_the_other_way_is_named(self, signs: tuple[int, int, int], words: str):
        with pytest.raises(CalibrationRejectedError, match=words):
            require_wiring(self.paths(RECEIVERS_MM * signs), self.SLOPES, RECEIVERS_MM)

    def test_a_z_axis_that_runs_the_other_way_is_named(self):
        heights = np.array([70.0, 100, 150, 250])
        require_heights(2 * heights, heights)
        with pytest.raises(CalibrationRejectedError, match="its z axis runs the other way"):
            require_heights(600 - 2 * heights, heights)
        with pytest.raises(CalibrationRejectedError, match="z axis is off"):
            require_heights(2 * heights, 1.2 * heights)


def test_directions_are_named_alone_together_and_against_each_other():
    information = np.diag([100.0, 0.01, 100.0])
    assert loose_directions(information, NAMES[:3]) == [(0.01, "flange_from_array y")]
    pair = np.array([[50.0, 50, 0], [50, 50, 0], [0, 0, 9]])
    assert [words for _, words in loose_directions(pair, ["a", "b", "c"])] in (["a against b"], ["b against a"])
    pair[0, 1] = pair[1, 0] = -50
    assert [words for _, words in loose_directions(pair, ["a", "b", "c"])] in (
        ["a together with b"],
        ["b together with a"],
    )
    assert poses_to_add(["speed of sound", "flange_from_array z"]) == ["perpendicular, at heights from 70 to 250 mm"]
