"""Rig file, plan and calibration file: what is wrong is named with its path, and nothing is guessed."""

from __future__ import annotations

import itertools
import math
from pathlib import Path

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st

from echolume_messages import calibration, plan, rig
from echolume_messages.calibration import ArrayCalibration, Calibration, CameraCalibration, LaserCalibration
from echolume_messages.errors import CalibrationMissingError, ConfigError

PLANS = Path(__file__).resolve().parents[2] / "app" / "echolume" / "plans"
RIG = """
name = "demo"
[guide]
port = "/dev/guide"
[trigger]
port = "/dev/trigger"
[cameras.left]
address = "127.0.0.1:1"
[cameras.right]
address = "127.0.0.1:2"
[robot]
[array]
port = "socket://127.0.0.1:3"
[recorder]
directory = "/var/lib/echolume"
"""
PLAN = """
name = "p"
[[pass]]
name = "light"
kind = "optical"
start_mm = -10.0
stop_mm = 10.0
pitch_mm = 0.5
"""
EYE = [[1.0, 0, 0, 0], [0, 1.0, 0, 0], [0, 0, 1.0, 0], [0, 0, 0, 1.0]]


def some_calibration(name: str = "demo", rms_mm: float = 0.1) -> Calibration:
    camera = CameraCalibration(
        width_px=1280,
        height_px=1024,
        camera_matrix=[[2850.0, 0, 640], [0, 2850.0, 512], [0, 0, 1.0]],
        distortion=[-0.1, 0, 0, 0, 0],
        camera_from_rig=EYE,
        rms_px=0.1,
    )
    array = ArrayCalibration(
        emitter_mm=(0, 0, 0),
        receivers_mm=[(15.0, 0, 0)] * 8,
        radius_mm=6.2,
        low_hz=30e3,
        high_hz=60e3,
        delays_s=[0.0] * 8,
        gains=[1.0] * 8,
        templates=[[0.0, 1.0]] * 8,
        template_origin=0.0,
        sample_rate_hz=250e3,
        reference_mm=150.0,
        speed_of_sound_mps=343.0,
        temperature_c=20.0,
        flange_from_array=EYE,
        rig_from_robot=EYE,
        path_rms_mm=0.1,
    )
    laser = LaserCalibration(normal=(1.0, 0, 0), offset_mm=0.0, guide_direction=(1.0, 0, 0), rms_mm=rms_mm)
    return Calibration(rig=name, left=camera, right=camera, stereo_rms_px=0.2, laser=laser, array=array)


def test_a_rig_file_is_read_with_its_defaults() -> None:
    found = rig.parse(RIG)
    assert found.name == "demo"
    assert found.bus.endpoint == "tcp/127.0.0.1:7447"
    assert len(found.array.layout.receivers_mm) == 8
    assert found.recorder.sync_ms == 50.0


@pytest.mark.parametrize(
    ("wrong", "right", "named"),
    [
        ('port = "/dev/guide"', 'prot = "/dev/guide"', r"rig\.toml: .*`(prot|port)`.*\$\.guide"),
        ('port = "/dev/guide"', "port = 5", r"\$\.guide\.port"),
        ('address = "127.0.0.1:2"', "", r"missing required field `address`.*\$\.cameras\.right"),
        ("[robot]", '[robot]\ninterface = "usb"', r"\$\.robot\.interface"),
        ("[robot]", "[robot]\nnodes = [1, 2, 3]", r"\$\.robot\.nodes"),
        ('name = "demo"', 'name = "demo"\ncolour = "red"', "unknown field `colour`"),
        ('name = "demo"', "", "missing required field `name`"),
        ("[robot]", "[robot", r"rig\.toml: "),
    ],
)
def test_what_is_wrong_in_a_rig_file_is_named(wrong: str, right: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        rig.parse(RIG.replace(wrong, right, 1), "rig.toml")


def test_a_rig_file_that_is_not_there_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"none\.toml: cannot read the rig file: No such file"):
        rig.load(tmp_path / "none.toml")


@pytest.mark.parametrize("path", sorted(PLANS.glob("*.toml")), ids=lambda p: p.stem)
def test_the_plans_that_come_with_it_are_valid(path: Path) -> None:
    steps = plan.expand(plan.load(path))
    assert [step.trigger for step in steps] == list(range(len(steps)))


@pytest.mark.parametrize(
    ("wrong", "right", "named"),
    [
        ("pitch_mm = 0.5", "pich_mm = 0.5", r"plan\.toml: .*`(pich_mm|pitch_mm)`.*\$\.pass\[0\]"),
        ("pitch_mm = 0.5", "", r"missing required field `pitch_mm`.*\$\.pass\[0\]"),
        ("pitch_mm = 0.5", 'pitch_mm = "fine"', r"\$\.pass\[0\]\.pitch_mm"),
        ("pitch_mm = 0.5", "pitch_mm = 0.0", r"plan\.toml: .*> 0\.0 - at `\$\.pass\[0\]\.pitch_mm"),
        ("stop_mm = 10.0", "stop_mm = -11.0", "before it starts"),
        ('kind = "optical"', 'kind = "magnetic"', r"magnetic.*\$\.pass\[0\]\.kind"),
        ('name = "p"', 'name = "p"\ncolour = 1', "unknown field `colour`"),
        (PLAN, 'name = "p"\npass = []', "no passes"),
        (PLAN, PLAN + PLAN.split("\n", 2)[2], "pass names must differ: light"),
        (PLAN, 'name = "p"\n[[pass]]\nname = "sound"\nkind = "ultrasonic"', "give `poses`, or all of"),
    ],
)
def test_what_is_wrong_in_a_plan_is_named(wrong: str, right: str, named: str) -> None:
    with pytest.raises(ConfigError, match=named):
        plan.parse(PLAN.replace(wrong, right, 1), "plan.toml")


@given(st.floats(-100, 100), st.floats(0, 200), st.floats(0.1, 10))
def test_an_optical_pass_covers_its_range_and_no_more(start_mm: float, span_mm: float, pitch_mm: float) -> None:
    item = plan.OpticalPass("o", start_mm, start_mm + span_mm, pitch_mm)
    positions = [step.guide_x_mm for step in plan.expand(plan.Plan("p", [item]))]
    assert positions[0] == pytest.approx(start_mm, abs=1e-6)
    last = positions[-1]
    assert last is not None
    assert last <= start_mm + span_mm + 1e-5
    assert last + pitch_mm > start_mm + span_mm - 1e-5


@given(st.integers(1, 8), st.integers(1, 8))
def test_a_raster_visits_each_position_once_and_never_jumps(columns: int, rows: int) -> None:
    item = plan.UltrasonicPass("u", (0.0, 10.0 * (columns - 1)), (0.0, 10.0 * (rows - 1)), 10.0, 150.0)
    poses = [(pose[0], pose[1]) for pose in plan.raster(item)]
    assert len(poses) == len(set(poses)) == columns * rows
    assert all(math.dist(a, b) == pytest.approx(10.0) for a, b in itertools.pairwise(poses))


def test_robot_angles_of_a_plan_are_degrees_and_of_a_step_radians() -> None:
    item = plan.UltrasonicPass("u", poses=[(0, 0, 150, 90, 0, -45)])
    (step,) = plan.expand(plan.Plan("p", [item]))
    assert step.pose == pytest.approx((0, 0, 150, math.pi / 2, 0, -math.pi / 4))


def test_only_the_first_trigger_of_a_pass_asks_for_the_operator() -> None:
    item = plan.SnapPass("board", frames=3, prompt="turn the board")
    assert [step.prompt for step in plan.expand(plan.Plan("p", [item]))] == ["turn the board", "", ""]


def test_a_calibration_is_saved_and_loaded_as_it_was(tmp_path: Path) -> None:
    made = some_calibration()
    calibration.save(made, tmp_path / "c.json")
    found = calibration.load(tmp_path / "c.json", "demo")
    assert found == made
    assert found.digest == made.digest


def test_the_digest_says_whether_two_calibrations_are_the_same() -> None:
    assert some_calibration().digest == some_calibration().digest
    assert some_calibration(rms_mm=0.1).digest != some_calibration(rms_mm=0.1000001).digest
    assert len(some_calibration().digest) == 16
    as_text = msgspec.json.format(msgspec.json.encode(some_calibration()), indent=4)
    assert calibration.parse(as_text, "c.json").digest == some_calibration().digest


def test_the_calibration_of_another_rig_is_refused(tmp_path: Path) -> None:
    calibration.save(some_calibration("north"), tmp_path / "c.json")
    with pytest.raises(CalibrationMissingError, match="is of rig 'north', this is 'south'"):
        calibration.load(tmp_path / "c.json", "south")


@pytest.mark.parametrize(
    ("change", "named"),
    [
        (lambda c: c.pop("laser"), "missing required field `laser`"),
        (lambda c: c.update(colour=1), "unknown field `colour`"),
        (lambda c: c["array"].pop("gains"), r"`gains`.*\$\.array"),
        (lambda c: c["left"].update(rms_px="good"), r"\$\.left\.rms_px"),
    ],
)
def test_what_is_wrong_in_a_calibration_is_named(change: object, named: str) -> None:
    raw = msgspec.to_builtins(some_calibration())
    change(raw)  # type: ignore[operator]
    with pytest.raises(CalibrationMissingError, match=named):
        calibration.parse(msgspec.json.encode(raw), "c.json")


def test_a_calibration_that_is_not_there_says_what_to_do(tmp_path: Path) -> None:
    with pytest.raises(CalibrationMissingError, match=r"none\.json: No such file.*run `echolume calibrate`"):
        calibration.load(tmp_path / "none.json")


def test_there_are_plans_that_come_with_it() -> None:
    assert list(PLANS.glob("*.toml"))
