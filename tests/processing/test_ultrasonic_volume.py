"""Delay-and-sum: by convolution and by gathering, against sums written out in full."""

import numpy as np
import pytest

from echolume_processing.ultrasonic import das_gather
from echolume_processing.ultrasonic.delay_and_sum import delay_and_sum
from echolume_processing.ultrasonic.gated import Band, GatedEchoes, PathGate
from echolume_processing.ultrasonic.scan_lattice import IrregularScanError, grid_over, scan_lattice
from echolume_processing.ultrasonic.voxels import VoxelGrid

SPEED_MPS = 343.2
BAND = Band(38e3, 42e3, SPEED_MPS)
SPREAD_MM = 46.0
RECEIVERS_MM = np.array([(a, b, 0.0) for b in (-15, 0, 15) for a in (-15, 0, 15) if (a, b) != (0, 0)])
TARGETS_MM = np.array([[0.0, 0.0, 0.0], [18.0, -11.0, 9.0]])


def raster(columns: int = 9, rows: int = 8, pitch_mm: float = 6.0, height_mm: float = 200.0) -> np.ndarray:
    x, y = np.meshgrid(np.arange(columns) - (columns - 1) / 2, np.arange(rows) - (rows - 1) / 2)
    return np.column_stack([pitch_mm * x.ravel(), pitch_mm * y.ravel(), np.full(x.size, height_mm)])


def paths_mm(emitters: np.ndarray, points: np.ndarray) -> np.ndarray:
    """Emitter -> point -> receiver, (points, poses, receivers)."""
    receivers = emitters[:, None] + RECEIVERS_MM
    out = np.linalg.norm(points[:, None] - emitters, axis=2)[:, :, None]
    return out + np.linalg.norm(points[:, None, None] - receivers, axis=3)


def pulse(distance_mm: np.ndarray) -> np.ndarray:
    """Envelope of an echo at a distance from its path."""
    return np.exp(-((distance_mm / SPREAD_MM) ** 2) / 4)


def echoes_of(emitters: np.ndarray, targets: np.ndarray = TARGETS_MM, first_mm: float = 200.0) -> GatedEchoes:
    """Echoes of point targets, written down in closed form."""
    path = first_mm + BAND.step_mm * np.arange(60)
    iq = np.zeros((len(emitters), len(RECEIVERS_MM), len(path)), dtype=np.complex64)
    for arrival in paths_mm(emitters, targets):
        iq += (pulse(path - arrival[..., None]) * np.exp(-1j * BAND.wavenumber * arrival[..., None])).astype(
            np.complex64
        )
    axes = np.tile([0.0, 0.0, -1.0], (len(emitters), 1))
    receivers = emitters[:, None] + RECEIVERS_MM
    return GatedEchoes(iq, first_mm, BAND.step_mm, BAND.wavenumber, BAND.width, emitters, receivers, axes)


def grid(step_mm: float = 3.0) -> VoxelGrid:
    return VoxelGrid(np.eye(4), (-31.0, -25.0, -12.0), (step_mm, step_mm, 3.0), (9, 17, 21))


def voxels_of(where: VoxelGrid) -> np.ndarray:
    z, y, x = np.meshgrid(where.z_mm, where.y_mm, where.x_mm, indexing="ij")
    return np.column_stack([x.ravel(), y.ravel(), z.ravel()])


def terms(emitters: np.ndarray, where: VoxelGrid, targets: np.ndarray = TARGETS_MM) -> np.ndarray:
    """Every echo at every voxel's path, (nz ny nx, poses, receivers)."""
    path = paths_mm(emitters, voxels_of(where))
    out = np.zeros(path.shape, dtype=np.complex128)
    for arrival in paths_mm(emitters, targets):
        out += pulse(path - arrival) * np.exp(1j * BAND.wavenumber * (path - arrival))
    return out


@pytest.mark.parametrize(("method", "error"), [("fft", 6e-3), ("gather", 1e-3)])
def test_a_volume_is_the_mean_of_all_echoes_at_their_voxels(method, error):
    emitters, where = raster(), grid()
    found = delay_and_sum(echoes_of(emitters), where, method)
    expected = terms(emitters, where).mean(axis=(1, 2)).reshape(where.shape)
    assert found.values.dtype == np.complex64
    assert found.values.shape == where.shape
    assert np.linalg.norm(found.values - expected) < error * np.linalg.norm(expected)


def test_both_ways_agree_to_more_than_four_nines():
    emitters, where = raster(), grid()
    ways = [delay_and_sum(echoes_of(emitters), where, m).values.ravel() for m in ("fft", "gather")]
    assert np.corrcoef(np.abs(ways))[0, 1] > 0.9999
    assert abs(np.vdot(*ways)) / np.prod([np.linalg.norm(w) for w in ways]) > 0.9999


@pytest.mark.parametrize(("method", "error"), [("fft", 0.02), ("gather", 0.01)])
def test_the_coherence_factor_is_that_of_its_definition(method, error):
    emitters, where = raster(), grid()
    found = delay_and_sum(echoes_of(emitters), where, method, coherence=True).coherence
    every = terms(emitters, where)
    expected = np.abs(every.sum(axis=(1, 2))) ** 2 / (every[0].size * (np.abs(every) ** 2).sum(axis=(1, 2)))
    assert found.dtype == np.float32
    assert np.abs(found - expected.reshape(where.shape)).max() < error


@pytest.mark.parametrize("method", ["fft", "gather"])
def test_poses_beyond_the_half_angle_are_left_out_of_sum_and_count(method):
    emitters, where, limit_rad = raster(), grid(), 0.031
    found = delay_and_sum(echoes_of(emitters), where, method, half_angle_rad=limit_rad)
    away = voxels_of(where)[:, None] - emitters
    seen = -away[..., 2] >= np.cos(limit_rad) * np.linalg.norm(away, axis=2)
    total = (terms(emitters, where) * seen[..., None]).sum(axis=(1, 2))
    expected = (total / np.maximum(8 * seen.sum(axis=1), 1)).reshape(where.shape)
    nobody = ~seen.any(axis=1).reshape(where.shape)
    assert nobody.any()
    assert np.abs(found.values[nobody]).max() < 1e-5
    assert np.linalg.norm(found.values - expected) < 0.03 * np.linalg.norm(expected)


@pytest.mark.parametrize("method", ["fft", "gather"])
def test_a_point_is_brightest_where_it_is(method):
    target = np.array([[-4.0, 5.0, 3.0]])
    where = VoxelGrid(np.eye(4), (-16.0, -13.0, -9.0), (2.0, 2.0, 1.0), (25, 15, 16))
    found = np.abs(delay_and_sum(echoes_of(raster(), target), where, method).values)
    z, y, x = np.unravel_index(np.argmax(found), found.shape)
    assert (where.x_mm[x], where.y_mm[y]) == (-4.0, 5.0)
    assert abs(where.z_mm[z] - 3.0) <= 2.0
    assert found.max() > 0.99


def test_lost_and_repeated_pings_do_not_break_the_lattice():
    emitters = np.delete(raster(), [3, 20, 21], axis=0)
    emitters = np.concatenate([emitters, emitters[10:12]])[np.random.default_rng(0).permutation(len(emitters) + 2)]
    ways = [delay_and_sum(echoes_of(emitters), grid(), m).values for m in ("fft", "gather")]
    assert np.linalg.norm(ways[0] - ways[1]) < 6e-3 * np.linalg.norm(ways[1])


def test_poses_off_the_raster_are_refused_by_convolution_and_gathered_with_a_note():
    off = raster() + np.random.default_rng(1).normal(0, 0.3, (72, 3))
    with pytest.raises(IrregularScanError, match=r"from its place on a regular grid .* use the gather"):
        delay_and_sum(echoes_of(off), grid(), "fft")
    found = delay_and_sum(echoes_of(off), grid())
    assert found.method == "gather"
    assert "gathered, because an element" in found.notes[0]
    expected = terms(off, grid()).mean(axis=(1, 2)).reshape(grid().shape)
    assert np.linalg.norm(found.values - expected) < 1e-3 * np.linalg.norm(expected)


def test_the_robots_own_error_is_no_hindrance():
    off = raster() + np.random.default_rng(1).normal(0, 0.02, (72, 3))
    found = delay_and_sum(echoes_of(off), grid())
    assert found.method == "fft"
    expected = terms(off, grid()).mean(axis=(1, 2)).reshape(grid().shape)
    assert np.linalg.norm(found.values - expected) < 0.02 * np.linalg.norm(expected)


def test_steps_that_do_not_divide_the_pitch_are_refused():
    with pytest.raises(IrregularScanError):
        delay_and_sum(echoes_of(raster()), grid(step_mm=3.3), "fft")


def test_a_single_row_of_poses_is_gathered():
    row = raster(rows=1)
    with pytest.raises(IrregularScanError, match="9 columns and 1 rows"):
        delay_and_sum(echoes_of(row), grid(), "fft")
    assert delay_and_sum(echoes_of(row), grid()).method == "gather"


def test_a_turned_and_tilted_raster_is_found_again():
    rng = np.random.default_rng(5)
    for turn_rad in (-0.6, -0.05, 0.0, 0.004, 0.7):
        poses = raster(7, 11, 5.0)
        poses[:, 1] *= 1.4
        c, s = np.cos(turn_rad), np.sin(turn_rad)
        tilt = np.array([[1, 0, 0.01], [0, 1, -0.02], [-0.01, 0.02, 1]])
        turned = poses @ (np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T @ np.linalg.qr(tilt)[0] * -1)
        turned *= np.sign(turned[:, 2].mean())
        order = rng.permutation(len(poses))
        down = -np.linalg.svd(turned - turned.mean(axis=0), full_matrices=False)[2][2]
        down *= -np.sign(down[2])
        found = scan_lattice(turned[order], np.tile(down, (len(poses), 1)))
        assert (found.columns, found.rows) == (7, 11)
        assert found.pitch_mm == pytest.approx((5.0, 7.0), abs=1e-3)
        there = found.first_mm + np.pad(found.index, ((0, 0), (0, 1))) * [*found.pitch_mm, 0]
        back = there @ found.rig_from_lattice[:3, :3].T + found.rig_from_lattice[:3, 3]
        np.testing.assert_allclose(back, turned[order], atol=1e-3)


def test_a_grid_over_a_scan_has_whole_voxels_to_the_pitch_and_covers_the_field():
    lattice = scan_lattice(raster(), np.tile([0.0, 0.0, -1.0], (72, 1)))
    where = grid_over(lattice, (-10.0, 20.0), 2.5, margin_mm=7.0)
    assert where.step_mm == pytest.approx((2.0, 2.0, 2.5))
    assert (where.x_mm[0], where.x_mm[-1]) == pytest.approx((-30.0, 30.0))
    assert (where.y_mm[0], where.y_mm[-1]) == pytest.approx((-27.0, 27.0))
    assert (where.z_mm[0], where.z_mm[-1]) == pytest.approx((-10.0, 20.0))
    assert delay_and_sum(echoes_of(raster()), where, "fft").method == "fft"


def test_baseband_keeps_amplitude_and_phase_of_an_echo_whatever_delay_and_speed():
    rate_hz, start_s, speed_mps = 1e6, 2e-4, 345.1
    delays_s = np.array([3e-5, 5.2e-5])
    gate = PathGate(BAND, (300.0, 600.0), delays_s)
    time_s = start_s + np.arange(3000) / rate_hz
    paths = np.array([431.7, 455.2])
    late_s = time_s - paths[:, None] / (1e3 * speed_mps) - delays_s[:, None]
    analytic = np.exp(-((late_s / 2e-4) ** 2)) * np.exp(2j * np.pi * 40.2e3 * late_s)
    found = gate.baseband(analytic.astype(np.complex64), rate_hz, start_s, speed_mps)
    path = gate.first_mm + gate.step_mm * np.arange(gate.samples)
    away_s = (path - paths[:, None]) / (1e3 * speed_mps)
    expected = np.exp(-((away_s / 2e-4) ** 2)) * np.exp(2j * np.pi * 40.2e3 * away_s - 1j * BAND.wavenumber * path)
    inside = (path > 330) & (path < 570)
    assert found.dtype == np.complex64
    np.testing.assert_allclose(found[:, inside], expected[:, inside], atol=2e-3)
    assert np.abs(found[:, [0, -1]]).max() == 0


def test_the_carriers_polynomials_are_good_to_a_millionth_of_a_turn():
    turn = np.linspace(-0.5, 0.5, 1001)
    cosine, sine = das_gather.turn_weights().astype(np.float64) @ (turn ** (2 * np.arange(6)[:, None]))
    np.testing.assert_allclose(cosine, np.cos(2 * np.pi * turn), atol=2e-6)
    np.testing.assert_allclose(turn * sine, np.sin(2 * np.pi * turn), atol=2e-6)


def test_silence_gives_an_empty_volume_with_no_coherence():
    quiet = echoes_of(raster(), np.zeros((0, 3)))
    for method in ("fft", "gather"):
        found = delay_and_sum(quiet, grid(), method, coherence=True)
        assert not found.values.any()
        assert not found.coherence.any()


def test_progress_is_told_and_errors_name_what_was_expected():
    told: list[tuple[str, int, int]] = []
    delay_and_sum(echoes_of(raster()), grid(), "fft", progress=lambda *a: told.append(a))
    assert told[0] == ("delay-and-sum", 0, 9)
    assert [t[1] for t in told] == list(range(9))
    with pytest.raises(ValueError, match="half_angle_rad: expected above 0"):
        delay_and_sum(echoes_of(raster()), grid(), half_angle_rad=0.0)
    with pytest.raises(ValueError, match="there are no echoes"):
        echoes_of(np.zeros((0, 3)))
    with pytest.raises(ValueError, match="voxels: expected one or more"):
        VoxelGrid(np.eye(4), (0.0, 0.0, 0.0), (1.0, 1.0, 1.0), (0, 4, 4))
