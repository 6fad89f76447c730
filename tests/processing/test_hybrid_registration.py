"""Self-registration: what is wrong in a set-up is found, what the echoes do not tell is left, nothing is guessed."""

from __future__ import annotations

import json
from dataclasses import replace

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.scene import Scene, SceneBuilder
from echolume_messages.calibration import ArrayCalibration
from echolume_messages.geometry import rotation_from_vector, transform
from echolume_messages.plan import MapField, UltrasonicPass, raster
from echolume_messages.rig import ArraySettings
from echolume_processing.hybrid.alignment import at_assumed_speed
from echolume_processing.hybrid.heard import Heard, heard
from echolume_processing.hybrid.model import MOVES, Registration
from echolume_processing.hybrid.predict import Aperture
from echolume_processing.hybrid.registration import ANEW_MM, register
from echolume_processing.hybrid.setup_error import DRIFT, MAY_BE_OFF, NAMES, displacements, moved, prior_sigma
from echolume_processing.hybrid.sounding import Sounding, Spectra, sounding
from echolume_processing.hybrid.surface import Surface, surface
from echolume_processing.ping import Ping
from processing.hybrid_scan import TEMPERATURE_C, calibration_of

FIELD = MapField(x_mm=(-165.0, 165.0), y_mm=(-165.0, 165.0), cell_mm=1.0)
PER_KELVIN_MPS = 0.585
"""Slope of the speed of sound at 22 degrees."""


class Scan:
    """Pings over a scene, in air of any temperature, and a calibration that may be put wrong."""

    def __init__(self, scene: Scene, warmer_k: float = 0.0, seed: int = 1) -> None:
        rng = np.random.default_rng(seed)
        settings = ArraySettings(port="")
        truth = array_truth(seed, settings)
        poses = np.array(raster(UltrasonicPass(name="s", x_mm=(-60, 60), y_mm=(-60, 60), pitch_mm=20, height_mm=150)))
        warmer = 0.5 * np.linspace(-warmer_k, warmer_k, len(poses))
        self.pings = [
            Ping(
                k,
                simulate_ping(scene, truth.rig_from_array(pose), settings, truth, TEMPERATURE_C + float(warm), rng),
                pose,
                settings.sample_rate_hz,
                0.0,
                TEMPERATURE_C + 0.5 * float(warm),  # a slow thermometer
            )
            for k, (pose, warm) in enumerate(zip(poses, warmer, strict=True))
        ]
        self.array = calibration_of(settings, truth, rng).array

    def heard(self, array: ArrayCalibration, lit: Surface) -> tuple[Sounding, Spectra]:
        """The pings in comparable form, beside what a surface would have returned."""
        found = sounding(self.pings, array)
        return found, found.predict(lit, np.arange(len(self.pings)))


def lit(scene: Scene) -> Surface:
    """The surface as light sees it, and the bench around it as far as sound reaches."""
    rim = round((scene.x0_mm - FIELD.x_mm[0]) / scene.cell_mm)
    return surface(np.pad(scene.optical_mm.astype(np.float64), rim), FIELD)


def wrong(array: ArrayCalibration, off: dict[str, float]) -> ArrayCalibration:
    """The calibration of a set-up that has been disturbed since: by `off`, as a registration names it."""
    by = {name: -off.get(name, 0.0) for name in MOVES}
    turn = rotation_from_vector(np.array([by["rx_rad"], by["ry_rad"], by["yaw_rad"]]))
    move = transform(turn, np.array([by["x_mm"], by["y_mm"], by["dz_mm"]]))
    kelvin = off.get("speed_mps", 0.0) / PER_KELVIN_MPS
    return msgspec.structs.replace(
        array, rig_from_robot=(move @ array.robot_pose).tolist(), temperature_c=array.temperature_c + kelvin
    )


def stairs() -> Scene:
    """Matte steps and bars, in x and in y."""
    scene = SceneBuilder("steps")
    scene.box((-55, -25), (-50, 5), 20.0)
    scene.box((-25, 5), (-50, 5), 40.0)
    scene.box((20, 50), (-40, 55), 30.0)
    scene.box((-50, -10), (25, 50), 12.0)
    return scene.build()


@pytest.fixture(scope="module")
def bench() -> Scan:
    return Scan(SceneBuilder("bench").build())


@pytest.fixture(scope="module")
def steps() -> Scan:
    return Scan(stairs())


@pytest.fixture(scope="module")
def undisturbed(steps: Scan) -> Registration:
    scene = lit(stairs())
    return register(*steps.heard(steps.array, scene), scene)[2]


def test_a_disturbed_setup_is_found_again(steps: Scan, undisturbed: Registration) -> None:
    off = {"dz_mm": 0.4, "x_mm": 0.5, "y_mm": -0.5, "rx_rad": 3e-3, "ry_rad": -2e-3, "speed_mps": -1.75}
    scene = lit(stairs())
    found, predicted = steps.heard(wrong(steps.array, off), scene)
    settled, corrected, registration = register(found, predicted, scene)
    bound = {"dz_mm": 0.1, "x_mm": 0.2, "y_mm": 0.2, "rx_rad": 6e-4, "ry_rad": 6e-4, "speed_mps": 0.35}
    for name, imposed in off.items():
        assert abs(getattr(registration, name) - getattr(undisturbed, name) - imposed) < bound[name], name
    assert registration.residual_db < registration.before_db - 3
    every = np.arange(len(steps.pings))
    anew = settled.predict(scene, every)
    assert np.median(settled.residual(anew, every)) < 1.3 * np.median(settled.residual(corrected, every))


def test_heights_far_from_those_that_registered_are_right_too(steps: Scan, undisturbed: Registration) -> None:
    """What counts: how far off a plate 30 mm above the bench would be put, anywhere in the scan."""
    off = {"dz_mm": -0.3, "rx_rad": -3e-3, "ry_rad": 3e-3, "speed_mps": 1.75}
    scene = lit(stairs())
    found, predicted = steps.heard(wrong(steps.array, off), scene)
    registration = register(found, predicted, scene)[2]
    left = {name: getattr(registration, name) - getattr(undisturbed, name) - off.get(name, 0.0) for name in MOVES}
    for x_mm in (-50, 50):
        for y_mm in (-50, 50):
            height_mm = left["dz_mm"] + y_mm * left["rx_rad"] - x_mm * left["ry_rad"]
            height_mm -= 120 * left["speed_mps"] / registration.speed_of_sound_mps
            assert abs(height_mm) < 0.05


def test_what_pings_met_follows_the_setup_that_was_found(steps: Scan, undisturbed: Registration) -> None:
    """Contacts of a disturbed calibration, brought to the registered set-up, are those of the right calibration."""
    off = {"dz_mm": -0.4, "rx_rad": 3.5e-3, "ry_rad": -3.5e-3, "speed_mps": 1.75}
    scene = lit(stairs())
    right, _ = steps.heard(steps.array, scene)
    expected = heard(steps.pings, steps.array).following(right, undisturbed)
    astray = wrong(steps.array, off)
    found, predicted = steps.heard(astray, scene)
    before = heard(steps.pings, astray)
    after = before.following(found, register(found, predicted, scene)[2])
    met = expected.valid & before.valid
    assert met.sum() >= 12

    def apart(one: Heard) -> tuple[float, float, float]:
        place_mm, normal = (one.place_mm - expected.place_mm)[met], (one.normal - expected.normal)[met]
        aside_mm = np.linalg.norm(place_mm[:, :2], axis=1)  # of one, a receiver more is taken for its plane's
        return float(np.abs(place_mm[:, 2]).max()), float(np.median(aside_mm)), float(np.median(np.abs(normal)))

    before_mm, *_ = apart(before)
    height_mm, aside_mm, normal = apart(after)
    assert before_mm > 1.0
    assert height_mm < 0.05
    assert aside_mm < 0.05
    assert normal < 2e-4
    path_mm = np.abs(after.path_mm - expected.path_mm)[met]
    assert np.isfinite(path_mm).mean() > 0.8
    assert np.nanmax(path_mm) < 0.05


def test_a_registration_that_was_refused_moves_no_contact(steps: Scan) -> None:
    found, _ = steps.heard(steps.array, lit(stairs()))
    spoken = heard(steps.pings, steps.array)
    still = spoken.following(found, Registration(0.0, found.air_mps, refused="nothing to compare"))
    np.testing.assert_allclose(still.place_mm, spoken.place_mm, atol=1e-9)
    np.testing.assert_allclose(still.normal, spoken.normal, atol=1e-12)


def test_an_undisturbed_setup_stays(undisturbed: Registration) -> None:
    assert abs(undisturbed.dz_mm) < 0.2  # the calibration of these tests is off by 0.1 mm
    assert abs(undisturbed.rx_rad) < 1e-3
    assert abs(undisturbed.ry_rad) < 1e-3
    assert abs(undisturbed.speed_mps) < 0.5
    assert undisturbed.notes == ()


def test_a_level_bench_does_not_tell_shifts_or_speed_and_they_stay_as_calibrated(bench: Scan) -> None:
    scene = lit(SceneBuilder("bench").build())
    off = {"dz_mm": 0.4, "rx_rad": 2e-3}
    found, predicted = bench.heard(wrong(bench.array, off), scene)
    registration = register(found, predicted, scene)[2]
    assert {"x_mm", "y_mm", "yaw_rad", "speed_mps"} <= set(registration.undetermined)
    for name in registration.undetermined:
        assert getattr(registration, name) == 0
    assert registration.sigma["x_mm"] >= MAY_BE_OFF[NAMES.index("x_mm")]
    assert abs(registration.dz_mm - 0.4) < 0.2
    assert abs(registration.rx_rad - 2e-3) < 6e-4


def test_air_that_warms_during_the_scan_is_found_from_the_echoes() -> None:
    scan = Scan(stairs(), 3.0)
    scene = lit(stairs())
    found, predicted = scan.heard(scan.array, scene)
    _, _, registration = register(found, predicted, scene)
    assert "drift_mps" not in registration.undetermined
    assert abs(registration.drift_mps - 1.5 * PER_KELVIN_MPS) < 0.3
    assert abs(registration.dz_mm) < 0.25
    assert registration.residual_db < registration.before_db


def test_glass_over_everything_is_no_array_that_sits_lower(bench: Scan) -> None:
    raised = lit(SceneBuilder("bench").build())
    below = surface(raised.height_mm - 1.9, FIELD)  # light looks through glass 1.9 mm above the bench
    registration = register(*bench.heard(bench.array, below), below)[2]
    assert "would move dz_mm" in registration.refused


def test_it_refuses_where_sound_hears_nothing_of_what_light_saw(bench: Scan) -> None:
    board = SceneBuilder("board")
    board.box((-120, 120), (-120, 120), 20.0)
    found, predicted = bench.heard(bench.array, lit(board.build()))
    same, unmoved, registration = register(found, predicted, lit(board.build()))
    assert registration.refused
    assert registration.pings == 0
    assert same is found
    assert unmoved is predicted
    assert "pings hear the surface" in registration.notes[0]


def test_half_a_scan_over_something_else_does_not_pull_it_along(steps: Scan, undisturbed: Registration) -> None:
    scene = stairs()
    seen = scene.optical_mm.copy()
    x_mm = scene.x0_mm + (np.arange(seen.shape[1]) + 0.5) * scene.cell_mm
    seen[:, x_mm < 0] -= 15.0  # light looks through
    half = lit(replace(scene, optical_mm=seen))
    registration = register(*steps.heard(steps.array, half), half)[2]
    assert not registration.refused
    assert registration.pings < 0.7 * len(steps.pings)
    assert abs(registration.dz_mm - undisturbed.dz_mm) < 0.1


def test_a_pose_beyond_what_a_setup_can_be_off_is_refused(steps: Scan) -> None:
    scene = lit(stairs())
    registration = register(*steps.heard(wrong(steps.array, {"rx_rad": 0.019}), scene))[2]
    assert "would move rx_rad" in registration.refused


def test_without_the_surface_height_and_tilts_are_found_and_shifts_are_not_looked_for(steps: Scan) -> None:
    scene = lit(stairs())
    found, predicted = steps.heard(wrong(steps.array, {"dz_mm": 0.3}), scene)
    registration = register(found, predicted)[2]
    assert abs(registration.dz_mm - 0.3) < 0.25
    assert {"x_mm", "y_mm", "yaw_rad"} <= set(registration.undetermined)


def test_a_second_registration_adds_to_the_first() -> None:
    sigma = dict.fromkeys(MOVES, 0.1)
    first = Registration(0.3, 343.0, 50, -15.0, -5.0, x_mm=0.5, sigma=sigma, undetermined=("y_mm",))
    again = Registration(0.1, 343.5, 60, -17.0, -14.0, sigma=dict.fromkeys(MOVES, 0.2), undetermined=("x_mm", "y_mm"))
    both = first.then(again)
    assert (both.dz_mm, both.x_mm) == pytest.approx((0.4, 0.5))
    assert (both.pings, both.residual_db, both.before_db) == (60, -17.0, -5.0)
    assert both.undetermined == ("y_mm",)
    assert (both.sigma["x_mm"], both.sigma["dz_mm"]) == (0.1, 0.2)
    assert first.then(Registration(refused="nothing")) == first
    assert Registration(refused="nothing").then(again) == again


def test_what_was_moved_goes_into_the_report_and_is_said_aloud() -> None:
    registration = Registration(0.4, 343.0, 50, sigma={"dz_mm": 0.01}, undetermined=("x_mm",))
    report = json.loads(json.dumps(registration.report()))
    assert {"dz_mm", "speed_of_sound_mps", "pings", "residual_db", *MOVES} <= set(report)
    assert msgspec.convert(report, Registration) == registration
    assert "dz_mm +0.4 +- 0.01" in registration.notes[0]


def test_the_response_of_the_channels_holds_in_any_air(bench: Scan) -> None:
    cool = sounding(bench.pings, bench.array)
    warm = sounding([replace(p, air_temperature_c=TEMPERATURE_C + 10) for p in bench.pings], bench.array)
    assert warm.speed_mps > cool.speed_mps + 5
    np.testing.assert_array_equal(warm.channels.response, cool.channels.response)


def test_displacements_are_the_slopes_of_moved_apertures() -> None:
    rng = np.random.default_rng(4)
    where = [Aperture(rng.uniform(-80, 150, (4, 3)), np.array([0.0, 0.0, -1.0])) for _ in range(3)]
    slopes = displacements(np.array([a.elements_mm for a in where]))
    for j in range(len(slopes)):
        value = np.zeros(len(NAMES))
        value[j] = 1e-5
        there = np.array([a.elements_mm for a in moved(where, value)])
        np.testing.assert_allclose(
            (there - np.array([a.elements_mm for a in where])) / 1e-5, slopes[j], rtol=0, atol=5e-3
        )


def test_an_echo_in_faster_air_is_brought_to_the_assumed_speed(bench: Scan) -> None:
    found = sounding(bench.pings[:1], bench.array)
    omega = 2 * np.pi * found.band.frequency_hz
    share = 0.006
    paths_mm = np.array([230.0, 300.0])
    response = found.channels.response * found.channels.filter

    def echo(speed_mps: float) -> np.ndarray:
        spectrum = np.exp(-1j * omega * paths_mm[:, None] / (speed_mps * 1e3)).sum(axis=0)
        return found.gate.waveform((spectrum * response)[None].astype(np.complex64))

    assumed, heard = echo(found.speed_mps), echo(found.speed_mps * (1 + share))
    brought = at_assumed_speed(found.gate, response, heard, np.array([share]))
    left = [(np.abs(w - assumed) ** 2).sum() / (np.abs(assumed) ** 2).sum() for w in (heard, brought)]
    assert left[0] > 0.2
    assert left[1] < 1e-3


def test_the_prior_is_what_the_calibration_leaves_open_and_what_happens_after() -> None:
    covariance = np.diag([1.2, 0.0, 0.0, 0.0, 0.0, 0.0]) ** 2
    assert prior_sigma(covariance, 0.0, 344.0)[NAMES.index("x_mm")] == pytest.approx(1.3)
    np.testing.assert_array_equal(prior_sigma(None, 0.0, 344.0)[:DRIFT], MAY_BE_OFF[:DRIFT])
    still, warming = prior_sigma(None, 0.0, 344.0)[DRIFT], prior_sigma(None, 1.0, 344.0)[DRIFT]
    assert still < 0.1 * warming


def test_only_a_large_move_is_predicted_anew(steps: Scan, monkeypatch: pytest.MonkeyPatch) -> None:
    asked: list[int] = []
    real = Sounding.predict

    def counted(self: Sounding, scene: Surface, which: np.ndarray) -> Spectra:
        asked.append(len(which))
        return real(self, scene, which)

    scene = lit(stairs())
    heard = [steps.heard(wrong(steps.array, {"dz_mm": off_mm}), scene) for off_mm in (0.0, 3 * ANEW_MM)]
    monkeypatch.setattr(Sounding, "predict", counted)
    register(*heard[0])
    assert asked == []
    register(*heard[0], scene)
    assert len(asked) == 2  # slopes along x and y
    register(*heard[1], scene)
    assert len(asked) == 2 + 3
    assert asked[-1] == len(steps.pings)
