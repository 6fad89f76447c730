"""Contact points of any layout: known answers, Cramer-Rao bounds, honest covariances, slips, and the emulated array."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.scene import plate
from echolume_messages.geometry import rotation_from_vector
from echolume_messages.plan import Pose6
from echolume_messages.rig import ArraySettings
from echolume_messages.types import EchoKind
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.calibrate import calibrate_plate
from echolume_processing.ultrasonic.contact import contact, fit_plane, fit_point
from echolume_processing.ultrasonic.contacts import Contacts, contacts, full
from echolume_processing.ultrasonic.cycles import resolve_cycles
from echolume_processing.ultrasonic.layout import layout_of
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline, waveforms_from_counts
from echolume_processing.ultrasonic.plate_energy import GaussianFit
from echolume_processing.ultrasonic.poses import plate_poses
from echolume_processing.ultrasonic.witness import EnergyCurve, energy_curve, energy_witness

PITCH_MM, DISTANCE_MM, SIGMA_MM, WAVELENGTH_MM = 37.5, 400.0, 0.2, 8.58
GRID = np.array([(x, y, 0.0) for y in (-1, 0, 1) for x in (-1, 0, 1) if (x, y) != (0, 0)]) * PITCH_MM
PINGS = 2000


def images_of(rng: np.random.Generator, pings: int = PINGS, tilt: float = 0.1) -> np.ndarray:
    """Emitter's images in planes at 400 mm, (pings, 3)."""
    normals = np.column_stack([rng.uniform(-2 * tilt, 2 * tilt, (pings, 2)), np.ones(pings)])
    return 2 * DISTANCE_MM * normals / np.linalg.norm(normals, axis=1)[:, None]


def plane_paths(images: np.ndarray, receivers: np.ndarray = GRID) -> np.ndarray:
    return np.linalg.norm(images[:, None] - receivers, axis=2)


def point_paths(points: np.ndarray, receivers: np.ndarray = GRID) -> np.ndarray:
    return np.linalg.norm(points, axis=-1)[:, None] + np.linalg.norm(points[:, None] - receivers, axis=2)


def true_contacts(images: np.ndarray, receivers: np.ndarray = GRID) -> np.ndarray:
    """Where the lines image -> receiver meet the planes."""
    squares = np.sum(images**2, axis=1)
    share = 0.5 * squares[:, None] / (squares[:, None] - images @ receivers.T)
    return images[:, None] + share[..., None] * (receivers - images[:, None])


def nees(errors: np.ndarray, covariances: np.ndarray) -> float:
    """Normalised squared error per dimension: 1 if the covariances are honest."""
    solved = np.linalg.solve(covariances, errors[..., None])[..., 0]
    return float(np.mean(np.sum(errors * solved, axis=-1)) / errors.shape[-1])


def bound(images: np.ndarray, receivers: np.ndarray, sigma: np.ndarray) -> np.ndarray:
    """Cramer-Rao bound of the feet of planes, (pings, 3, 3)."""
    ways = images[:, None] - receivers
    j = 2 * ways / np.linalg.norm(ways, axis=2)[..., None] / sigma[..., None]
    return np.linalg.inv(np.einsum("pri,prj->pij", j, j))


def rms(errors: np.ndarray) -> float:
    return float(np.sqrt(np.mean(np.sum(errors**2, axis=-1))))


def angle_deg(normals: np.ndarray, images: np.ndarray) -> np.ndarray:
    truth = -images / np.linalg.norm(images, axis=1)[:, None]
    return np.degrees(2 * np.arcsin(0.5 * np.linalg.norm(normals - truth, axis=1)))


# Layouts


def test_one_transducer_measures_the_range_and_nothing_else():
    found = contacts(np.zeros((1, 3)), np.array([[300.0]]), np.array([0.2]), untested=True)
    np.testing.assert_allclose(found.points_mm[0], [[0, 0, 150.0]], atol=1e-12)
    assert found.rank.tolist() == [1]
    assert found.foot_covariance[0, [0, 3]].tolist() == [np.inf, np.inf]
    assert found.foot_covariance[0, 5] == pytest.approx(0.1**2)
    np.testing.assert_array_equal(found.layout.undetermined, [[1, 0, 0], [0, 1, 0]])


def test_emitter_and_receiver_measure_along_their_bisector():
    receiver = np.array([[60.0, 0.0, 0.0]])
    found = contacts(receiver, np.array([[100.0]]), np.array([0.2]), untested=True)
    np.testing.assert_allclose(found.points_mm[0, 0], [30.0, 0.0, 40.0], atol=1e-12)  # a 3-4-5 triangle twice
    assert found.rank.tolist() == [1]


def test_r_e_r_measures_in_its_own_plane_and_says_what_it_leaves_open():
    receivers = np.array([[-50.0, 0.0, 0.0], [50.0, 0.0, 0.0]])
    image = np.array([[400 * np.sin(0.2), 0.0, 400 * np.cos(0.2)]])
    found = contacts(receivers, plane_paths(image, receivers), np.full(2, 0.2), untested=True)
    assert (found.kind[0], found.rank[0]) == (EchoKind.PLANE, 2)
    np.testing.assert_allclose(found.foot_mm, image / 2, atol=1e-9)
    np.testing.assert_allclose(np.abs(found.layout.undetermined), [[0, 1, 0]], atol=1e-15)
    assert found.normal_covariance[0, 3] == np.inf
    assert np.isfinite(found.normal_covariance[0, [0, 2, 5]]).all()
    assert np.isnan(found.plane_chi_squared[0])
    unasked = contacts(receivers, plane_paths(image, receivers), np.full(2, 0.2))
    assert unasked.kind[0] == EchoKind.NONE


@given(st.floats(0, np.pi), st.floats(-0.3, 0.3), st.floats(-30, 30))
def test_a_line_of_receivers_may_lie_anyhow_and_beside_the_emitter(turn: float, tilt: float, aside_mm: float):
    along = np.array([np.cos(turn), np.sin(turn), 0.0])
    receivers = np.outer([-50.0, -20.0, 30.0, 60.0], along) + aside_mm * np.array([-along[1], along[0], 0.0])
    image = 400 * (np.sin(tilt) * along + np.cos(tilt) * np.array([0, 0, 1.0]))[None]
    found = contacts(receivers, plane_paths(image, receivers), np.full(4, 0.05))
    assert (found.kind[0], found.rank[0]) == (EchoKind.PLANE, 2)
    np.testing.assert_allclose(found.foot_mm, image / 2, atol=1e-6)


@settings(deadline=None)
@given(st.integers(0, 10_000), st.integers(4, 12))
def test_planes_and_points_are_recovered_by_random_layouts_in_space(seed: int, receivers_count: int):
    rng = np.random.default_rng(seed)
    receivers = rng.uniform(-60, 60, (receivers_count, 3)) * [1, 1, rng.choice([0.0, 0.02, 0.5])]
    receivers += [0, 0, rng.choice([0.0, -40.0])]  # the emitter ahead of its receivers
    assume(np.linalg.svd(receivers[:, :2] - receivers[:, :2].mean(axis=0))[1][1] > 20)  # spread both ways
    image = images_of(rng, 1, 0.14)
    sigma = np.full(receivers_count, 1e-6)
    flat = contacts(receivers, plane_paths(image, receivers), sigma, model="plane", max_chi_squared=1e4)
    assert flat.kind[0] == EchoKind.PLANE
    np.testing.assert_allclose(flat.foot_mm, image / 2, atol=1e-5)
    np.testing.assert_allclose(flat.points_mm, true_contacts(image, receivers), atol=1e-5)
    target = contacts(receivers, point_paths(image / 4, receivers), sigma, model="point", max_chi_squared=1e4)
    assert target.kind[0] == EchoKind.POINT
    np.testing.assert_allclose(target.foot_mm, image / 4, atol=1e-5)


def test_receivers_one_behind_the_other_are_refused():
    with pytest.raises(ValueError, match="one behind the other"):
        layout_of(np.array([[0.0, 0.0, 0.0], [0.0, 0.0, -20.0]]))


def test_a_calibrated_array_in_which_every_receiver_sits_elsewhere_is_on_the_bound():
    rng = np.random.default_rng(0)
    receivers = GRID + rng.normal(0, [2, 2, 15], GRID.shape)
    images = images_of(rng)
    sigma = np.full(8, SIGMA_MM)
    found = contacts(
        receivers, plane_paths(images, receivers) + rng.normal(0, SIGMA_MM, (PINGS, 8)), sigma, model="plane"
    )
    expected = np.sqrt(np.mean(np.trace(bound(images, receivers, np.full((PINGS, 8), SIGMA_MM)), axis1=1, axis2=2)))
    assert rms(found.foot_mm - images / 2) / expected == pytest.approx(1, abs=0.03)


# Accuracy


def noisy(seed: int, sigma: float = SIGMA_MM) -> tuple[np.ndarray, Contacts]:
    rng = np.random.default_rng(seed)
    images = images_of(rng)
    paths = plane_paths(images) + rng.normal(0, sigma, (PINGS, 8))
    return images, contacts(GRID, paths, np.full(8, sigma), model="plane")


def test_normal_and_foot_are_on_the_cramer_rao_bound_at_400_mm():
    images, found = noisy(1)
    assert np.sqrt(np.mean(angle_deg(found.normals, images) ** 2)) < 0.19
    error = rms(found.foot_mm - images / 2)
    assert error < 1.3
    limits = bound(images, GRID, np.full((PINGS, 8), SIGMA_MM))
    assert error / np.sqrt(np.mean(np.trace(limits, axis1=1, axis2=2))) == pytest.approx(1, abs=0.03)
    np.testing.assert_allclose(full(found.foot_covariance), limits, rtol=0.2, atol=0.02)


def test_covariances_of_feet_normals_and_contact_points_are_honest():
    images, found = noisy(2)
    assert nees(found.foot_mm - images / 2, full(found.foot_covariance)) == pytest.approx(1, abs=0.05)
    errors = found.points_mm - true_contacts(images)
    assert nees(errors, full(found.point_covariance)) == pytest.approx(1, abs=0.05)
    covariance = full(found.normal_covariance)
    np.testing.assert_allclose(np.einsum("pij,pj->pi", covariance, found.normals), 0, atol=1e-12)
    across = found.normals + images / np.linalg.norm(images, axis=1)[:, None]
    assert nees(across[:, :2], covariance[:, :2, :2]) == pytest.approx(1, abs=0.06)


def test_points_have_honest_covariances_too():
    rng = np.random.default_rng(3)
    points = images_of(rng) / 4  # at 200 mm
    found = contacts(GRID, point_paths(points) + rng.normal(0, 0.05, (PINGS, 8)), np.full(8, 0.05))
    assert (found.kind == EchoKind.POINT).all()
    assert nees(found.foot_mm - points, full(found.foot_covariance)) == pytest.approx(1, abs=0.06)


def test_channels_weigh_by_their_sigma():
    rng = np.random.default_rng(4)
    images = images_of(rng)
    sigma = 0.05 * np.exp(rng.normal(0, 1, (PINGS, 8)))
    paths = plane_paths(images) + sigma * rng.normal(size=sigma.shape)
    found = contacts(GRID, paths, sigma, model="plane")
    alike = contacts(GRID, paths, np.full(8, 0.5), model="plane", max_chi_squared=np.inf)
    expected = np.sqrt(np.mean(np.trace(bound(images, GRID, sigma), axis1=1, axis2=2)))
    assert rms(found.foot_mm - images / 2) / expected == pytest.approx(1, abs=0.04)
    assert rms(alike.foot_mm - images / 2) / expected > 1.3
    assert nees(found.foot_mm - images / 2, full(found.foot_covariance)) == pytest.approx(1, abs=0.05)


def test_an_error_that_all_paths_share_is_in_the_covariance_when_it_is_told():
    rng = np.random.default_rng(5)
    images = images_of(rng)
    paths = plane_paths(images) + rng.normal(0, 0.02, (PINGS, 8)) + rng.normal(0, 0.2, (PINGS, 1))
    untold = contacts(GRID, paths, np.full(8, 0.02))
    told = contacts(GRID, paths, np.full(8, 0.02), common_sigma_mm=0.2)
    errors = told.foot_mm - images / 2
    assert nees(errors, full(told.foot_covariance)) == pytest.approx(1, abs=0.06)
    assert nees(errors, full(untold.foot_covariance)) > 10


def test_missing_channels_are_done_without_and_their_absence_is_in_the_covariance():
    rng = np.random.default_rng(6)
    images = images_of(rng)
    paths = plane_paths(images) + rng.normal(0, SIGMA_MM, (PINGS, 8))
    missing = np.argsort(rng.random((PINGS, 8)), axis=1) < 2
    paths[missing] = np.nan
    found = contacts(GRID, paths, np.full(8, SIGMA_MM), model="plane", max_chi_squared=np.inf)
    np.testing.assert_array_equal(found.used, ~missing)
    assert nees(found.foot_mm - images / 2, full(found.foot_covariance)) == pytest.approx(1, abs=0.06)
    assert np.isfinite(found.points_mm).all()


# Choice, slips


def test_chi_squared_tells_planes_from_points_at_400_mm():
    rng = np.random.default_rng(7)
    images, noise, sigma = images_of(rng), rng.normal(0, 0.05, (PINGS, 8)), np.full(8, 0.05)
    flat, small = (
        contacts(GRID, plane_paths(images) + noise, sigma),
        contacts(GRID, point_paths(images / 2) + noise, sigma),
    )
    assert np.mean(flat.kind == EchoKind.PLANE) > 0.999
    assert np.mean(small.kind == EchoKind.POINT) > 0.999
    assert np.mean(flat.plane_chi_squared) == pytest.approx(1, abs=0.05)
    assert np.mean(small.point_chi_squared) == pytest.approx(1, abs=0.05)


@pytest.mark.parametrize("slips", [1, 2])
@pytest.mark.parametrize("paths_of", [plane_paths, point_paths])
def test_slips_of_any_one_or_two_channels_are_left_out(slips: int, paths_of: object):
    rng = np.random.default_rng(8)
    images = images_of(rng, tilt=0.05)
    clean = plane_paths(images) if paths_of is plane_paths else point_paths(images / 4)
    slipped = np.argsort(rng.random((PINGS, 8)), axis=1) < slips
    paths = clean + rng.normal(0, 0.05, (PINGS, 8)) + slipped * WAVELENGTH_MM * rng.choice([-1, 1], (PINGS, 8))
    found = contacts(GRID, paths, np.full(8, 0.05))
    right = (found.used == ~slipped).all(axis=1)
    assert right.mean() > (0.999 if slips == 1 else 0.99)
    if paths_of is plane_paths and slips == 1:
        assert np.sqrt(np.mean(angle_deg(found.normals, images)[right] ** 2)) < 0.06
    assert np.count_nonzero(~right & (found.kind != EchoKind.NONE)) <= 0.002 * PINGS


def test_leaving_one_out_by_the_hat_matrix_is_refitting():
    rng = np.random.default_rng(9)
    image = images_of(rng, 1)
    paths = (plane_paths(image) + rng.normal(0, 0.05, (1, 8)))[0]
    paths[3] += WAVELENGTH_MM
    found = contact(GRID, paths, np.full(8, 0.05))
    others = np.arange(8) != 3
    refitted = contact(GRID[others], paths[others], np.full(7, 0.05))
    assert found.used.tolist() == others.tolist()
    np.testing.assert_allclose(found.foot_mm, refitted.foot_mm, atol=1e-9)
    assert found.chi_squared == pytest.approx(refitted.chi_squared, rel=1e-6)


def test_echoes_of_another_surface_60_mm_nearer_are_left_out_though_no_plane_has_such_paths():
    rng = np.random.default_rng(19)
    receivers = 0.4 * GRID
    images = images_of(rng, tilt=0.05) * 150 / DISTANCE_MM
    other = np.argsort(rng.random((PINGS, 8)), axis=1) < 2
    paths = plane_paths(images, receivers) + rng.normal(0, 0.05, (PINGS, 8)) - 60 * other
    found = contacts(receivers, paths, np.full(8, 0.05))
    assert sum(fit_plane(receivers, path, np.ones(8, bool)) is None for path in paths[:100]) > 30
    right = (found.used == ~other).all(axis=1) & (found.kind == EchoKind.PLANE)
    assert right.mean() > 0.999
    assert not np.any((found.kind != EchoKind.NONE) & ~right)


def test_of_four_channels_none_can_be_left_out():
    paths = plane_paths(images_of(np.random.default_rng(10), 1))[:, [0, 2, 5, 7]]
    paths[0, 1] += WAVELENGTH_MM
    found = contacts(GRID[[0, 2, 5, 7]], paths, np.full(4, 0.05))
    assert found.kind[0] == EchoKind.NONE
    assert np.isnan(found.foot_covariance).all()
    assert found.used.all()


# Invariance


@given(st.integers(0, 10_000))
def test_a_turn_of_the_array_about_its_axis_turns_the_answer(seed: int):
    rng = np.random.default_rng(seed)
    turn = rotation_from_vector(np.array([0.0, 0.0, rng.uniform(-3, 3)]))
    paths = plane_paths(images_of(rng, 1)) + rng.normal(0, 0.1, (1, 8))
    here = contacts(GRID, paths, np.full(8, 0.1), model="plane")
    there = contacts(GRID @ turn.T, paths, np.full(8, 0.1), model="plane")
    np.testing.assert_allclose(there.points_mm, here.points_mm @ turn.T, atol=1e-8)
    np.testing.assert_allclose(
        full(there.point_covariance), turn @ full(here.point_covariance) @ turn.T, rtol=1e-6, atol=1e-9
    )


@given(st.permutations(range(8)))
def test_the_order_of_receivers_does_not_matter(order: list[int]):
    rng = np.random.default_rng(11)
    paths = plane_paths(images_of(rng, 1)) + rng.normal(0, 0.1, (1, 8))
    paths[0, 2] += WAVELENGTH_MM
    here, there = contacts(GRID, paths, np.full(8, 0.1)), contacts(GRID[order], paths[:, order], np.full(8, 0.1))
    np.testing.assert_array_equal(there.used, here.used[:, order])
    np.testing.assert_allclose(there.foot_mm, here.foot_mm, atol=1e-8)
    np.testing.assert_allclose(there.points_mm, here.points_mm[:, order], atol=1e-8)


def test_one_ping_is_a_batch_of_one_and_a_fit_a_batch_without_a_test():
    rng = np.random.default_rng(12)
    images = images_of(rng, 5)
    paths = plane_paths(images) + rng.normal(0, 0.05, (5, 8))
    batch = contacts(GRID, paths, np.full(8, 0.05))
    for k in range(5):
        alone = contact(GRID, paths[k], np.full(8, 0.05))
        np.testing.assert_array_equal(alone.points_mm, batch.points_mm[k])
        np.testing.assert_array_equal(alone.point_covariances, full(batch.point_covariance[k]))
    plane, point = fit_plane(GRID, paths[0], np.ones(8, bool)), fit_point(GRID, paths[0], np.ones(8, bool))
    assert plane is not None
    assert point is not None
    np.testing.assert_allclose(plane.image_mm / 2, batch.foot_mm[0], atol=1e-9)
    assert np.linalg.norm(point[0] - batch.foot_mm[0]) > 0.1


def test_read_only_and_single_precision_paths_are_taken():
    paths = plane_paths(images_of(np.random.default_rng(20), 3))
    paths.flags.writeable = False
    found = contacts(GRID, paths, np.broadcast_to(0.1, paths.shape))
    single = contacts(GRID, paths.astype(np.float32), np.full(8, 0.1, dtype=np.float32))
    assert found.points_mm.dtype == single.points_mm.dtype == np.float64
    np.testing.assert_allclose(single.points_mm, found.points_mm, atol=0.01)


def test_wrong_shapes_are_named():
    with pytest.raises(ValueError, match="paths_mm"):
        contacts(GRID, np.zeros((3, 7)), np.full(8, 0.1))
    with pytest.raises(ValueError, match="sigma_mm"):
        contacts(GRID, np.zeros((3, 8)), np.full((2, 8), 0.1))
    with pytest.raises(ValueError, match="rows"):
        contacts(GRID, np.zeros((3, 8)), np.full(8, 0.1), rows=np.zeros((3, 5)))


# Cycles, energy


def test_slips_of_most_channels_are_resolved_together():
    """At 10 dB a quarter of all channels slips, and one ping in ten has none that did."""
    rng = np.random.default_rng(13)
    envelope_sigma, sigma = np.full(8, 3.7), np.full(8, 0.1)
    right = wrong = clean = 0
    for image in images_of(rng, 60):
        truth = np.linalg.norm(image - GRID, axis=1)
        phase, envelope = truth + rng.normal(0, 0.1, 8), truth + rng.normal(0, 3.7, 8)
        slips = np.rint((envelope - phase) / WAVELENGTH_MM).astype(int)
        found = resolve_cycles(GRID, phase + WAVELENGTH_MM * slips, sigma, WAVELENGTH_MM, envelope, envelope_sigma)
        clean += not slips.any()
        right += found.resolved and np.array_equal(found.cycles, slips)
        wrong += found.resolved and not np.array_equal(found.cycles, slips)
    assert clean < 12
    assert right >= 50
    assert wrong <= 1


def test_another_echo_in_one_channel_is_no_cycle():
    paths = plane_paths(images_of(np.random.default_rng(14), 1))[0]
    paths[4] += 0.5 * WAVELENGTH_MM
    found = resolve_cycles(GRID, paths, np.full(8, 0.05), WAVELENGTH_MM, paths, np.full(8, 2.0))
    assert found.kind == EchoKind.NONE
    assert not found.resolved


def test_cycles_of_an_array_with_a_silent_channel_are_resolved():
    paths = plane_paths(images_of(np.random.default_rng(15), 1))[0]
    envelope = paths + np.random.default_rng(16).normal(0, 1.0, 8)
    paths[[1, 6]] += [WAVELENGTH_MM, -WAVELENGTH_MM]
    paths[3] = np.nan
    found = resolve_cycles(GRID, paths, np.full(8, 0.05), WAVELENGTH_MM, envelope, np.full(8, 1.5))
    assert found.cycles.tolist() == [0, 1, 0, 0, 0, 0, -1, 0]
    assert found.resolved


def test_three_echoes_are_too_few_for_cycles():
    paths = np.full(8, np.nan)
    paths[:3] = 800
    with pytest.raises(ValueError, match="four channels"):
        resolve_cycles(GRID, paths, np.full(8, 0.05), WAVELENGTH_MM, paths, np.full(8, 1.5))


CURVE = EnergyCurve(GaussianFit(1.0, 0.0, np.radians(18.0)), 0.05)


def test_energy_and_paths_agree_about_a_whole_plate_at_any_angle():
    rng = np.random.default_rng(17)
    sigmas = []
    for angle in np.radians(np.linspace(0, 20, 400)):
        energy = float(np.exp(-((angle / CURVE.fit.c_rad) ** 2) + 0.05 * rng.normal()))
        seen = angle + rng.normal(0, np.radians(0.5))
        normal = -np.array([np.sin(seen), 0, np.cos(seen)])
        covariance = np.diag([np.radians(0.5) ** 2, np.radians(0.5) ** 2, 0])
        sigmas.append(energy_witness(energy, CURVE, normal, covariance).sigmas)
    assert np.std(sigmas) == pytest.approx(1, abs=0.15)
    assert abs(np.mean(sigmas)) < 0.3


def test_half_a_plate_returns_too_little():
    normal, covariance = np.array([0, -np.sin(0.1), -np.cos(0.1)]), 1e-6 * np.eye(3)
    found = energy_witness(0.25, CURVE, normal, covariance)
    assert not found.agree
    assert found.sigmas < -10
    assert found.energy_angle_rad > found.path_angle_rad == pytest.approx(0.1)


def test_the_sigma_of_the_energys_angle_is_what_noise_does_to_it():
    rng = np.random.default_rng(18)
    energy = np.exp(-((0.2 / CURVE.fit.c_rad) ** 2) + 0.05 * rng.normal(size=500))
    found = [energy_witness(float(e), CURVE, np.array([0, 0, -1.0]), 1e-6 * np.eye(3)) for e in energy]
    assert np.std([f.energy_angle_rad for f in found]) == pytest.approx(found[0].energy_sigma_rad, rel=0.15)


# End to end

ARRAY = ArraySettings(port="none")
AIR_C = 22.0
CHANNEL_SIGMA_MM, COMMON_SIGMA_MM = 0.02, 0.05
"""Moving air between channels; the robot's repeatability and the air as a whole."""


def take(poses: list[Pose6], seed: int) -> list[Ping]:
    truth = array_truth(3, ARRAY)
    rng = np.random.default_rng(seed)
    out: list[Ping] = []
    for number, (x, y, z, rx, ry, rz) in enumerate(poses):
        pose = np.array([x, y, z, *np.radians([rx, ry, rz])])
        echoes = simulate_ping(plate(), truth.rig_from_array(pose), ARRAY, truth, AIR_C, rng)
        out.append(Ping(number, echoes, pose, ARRAY.sample_rate_hz, ARRAY.start_s, AIR_C))
    return out


@pytest.fixture(scope="module")
def pipeline() -> UltrasonicPipeline:
    return UltrasonicPipeline(calibrate_plate(take(plate_poses(), 1), ARRAY).calibration)


@pytest.fixture(scope="module")
def tilted() -> list[Ping]:
    """Pings over the plate at four heights and random tilts up to 12 degrees about both axes."""
    rng = np.random.default_rng(2)
    poses = [(*rng.uniform(-40, 40, 2), z, *rng.uniform(-12, 12, 2), 0.0) for z in (110.0, 150.0, 200.0, 250.0) * 6]
    return take(poses, 3)


def test_contacts_of_emulated_pings_are_as_good_as_they_say(pipeline: UltrasonicPipeline, tilted: list[Ping]):
    receivers = np.array(pipeline.calibration.receivers_mm) - np.array(pipeline.calibration.emitter_mm)
    errors, covariances = [], []
    for ping in tilted:
        found, paths = pipeline.arrivals(
            waveforms_from_counts(ping.echoes), ping.sample_rate_hz, ping.start_s, ping.air_temperature_c
        )
        sigma = np.hypot(CHANNEL_SIGMA_MM, found.sigma_s * 343e3)
        one = contacts(receivers, paths[None], sigma, common_sigma_mm=COMMON_SIGMA_MM)
        assert one.kind[0] == EchoKind.PLANE
        pose = pipeline.rig_from_array(ping.robot_pose)
        above = float((pose[:3, :3] @ np.array(pipeline.calibration.emitter_mm) + pose[:3, 3])[2])
        errors.append(one.foot_mm[0] + above * pose[2, :3])  # the plate is the rig's z = 0
        covariances.append(full(one.foot_covariance[0]))
    assert 0.5 < nees(np.array(errors), np.array(covariances)) < 1.6
    assert rms(np.array(errors)) < 0.35


def test_published_points_carry_covariances_that_hold(pipeline: UltrasonicPipeline, tilted: list[Ping]):
    """Points lie within the plate, whose height alone is known: z."""
    ratios = []
    for ping in tilted:
        points = pipeline.process(ping)
        rows = [[points[f"{a}{b}_mm2"] for b in "xyz"] for a in "x"] + [
            [points["xy_mm2"], points["yy_mm2"], points["yz_mm2"]],
            [points["xz_mm2"], points["yz_mm2"], points["zz_mm2"]],
        ]
        covariance = np.array(rows, dtype=float).transpose(2, 0, 1)
        assert (np.linalg.eigvalsh(covariance) > 0).all()
        ratios.append(points["z_mm"].astype(float) ** 2 / points["zz_mm2"])
    assert 0.3 < np.concatenate(ratios).mean() < 1.6


def test_the_energy_of_emulated_pings_witnesses_their_normals(pipeline: UltrasonicPipeline, tilted: list[Ping]):
    """Scaled by distance squared; the curve is from one half of the pings, the witness heard on the other."""
    angles, energies, normals = [], [], []
    for ping in tilted:
        found = pipeline.process(ping)
        normal = np.array([found["nx"][0], found["ny"][0], found["nz"][0]], dtype=float)
        axis = pipeline.rig_from_array(ping.robot_pose)[:3, :3]
        normals.append(normal @ axis)
        angles.append(np.arccos(-normals[-1][2]))
        energies.append(float(found["energy"].mean()) * (float(found["path_mm"].mean()) / 300) ** 2)
    curve = energy_curve(np.array(angles[::2]), np.array(energies[::2]))
    assert 8 < np.degrees(curve.fit.c_rad) < 40
    covariance = np.radians(0.1) ** 2 * np.diag([1.0, 1.0, 0.0])
    heard = [energy_witness(e, curve, n, covariance) for e, n in zip(energies[1::2], normals[1::2], strict=True)]
    assert sum(w.agree for w in heard) >= len(heard) - 1
    assert not energy_witness(0.3 * energies[1], curve, normals[1], covariance).agree
