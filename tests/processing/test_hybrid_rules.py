"""Every fusion rule: what it may claim, that order does not matter, and what each does and cannot do."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated.scene import Material
from echolume_messages.calibration import Calibration
from echolume_messages.errors import ConfigError
from echolume_messages.plan import MapField
from echolume_messages.types import (
    NO_TRIGGER,
    OPTICAL_POINT,
    ULTRASONIC_POINT,
    Label,
    OpticalSource,
    Provenance,
    Structured,
)
from echolume_processing.hybrid.baselines import baselines
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.fuse import fuse
from echolume_processing.hybrid.grid import accumulate
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.rules.band import footprint_mm, slips
from echolume_processing.hybrid.rules.gates import regions, relief, without_lines
from echolume_processing.hybrid.rules.names import DEFAULT, DESCRIPTIONS
from echolume_processing.hybrid.rules.registry import RULES, fuse_by
from echolume_processing.hybrid.rules.sound import CLEAN_MM
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline
from processing.hybrid_scan import FIELD, SmallScan, all_matte, glass_and_black, small_scan, triggers

RIM = 120 - 48
LIGHT = Provenance.STEREO | Provenance.ACTIVE_LEFT | Provenance.ACTIVE_RIGHT
SQUARE = MapField(x_mm=(-40.0, 40.0), y_mm=(-40.0, 40.0), cell_mm=1.0)


def heard(scan: SmallScan) -> Structured:
    pipeline = UltrasonicPipeline(scan.calibration)
    return np.concatenate([pipeline.process(p) for p in scan.pings])


def sound_triggers(scan: SmallScan) -> np.ndarray:
    pipeline = UltrasonicPipeline(scan.calibration)
    return np.concatenate([np.full(pipeline.process(p).size, p.trigger, np.uint32) for p in scan.pings])


def cut(image: np.ndarray) -> np.ndarray:
    return image[RIM:-RIM, RIM:-RIM]


@pytest.fixture(scope="module")
def scan() -> SmallScan:
    return small_scan(glass_and_black())


@pytest.fixture(scope="module")
def sound(scan: SmallScan) -> Structured:
    return heard(scan)


@pytest.fixture(scope="module")
def matte() -> SmallScan:
    return small_scan(all_matte(), seed=2)


@pytest.fixture(scope="module")
def maps(scan: SmallScan, sound: Structured) -> dict[str, HybridMap]:
    some = {DEFAULT: scan.pings[::4]}
    numbers = triggers(scan.optical), sound_triggers(scan)
    return {
        name: fuse_by(name, scan.optical, sound, some.get(name, scan.pings), scan.calibration, FIELD, *numbers)
        for name in RULES
    }


def light_at(height_mm: np.ndarray, seen: np.ndarray | None = None) -> Structured:
    """Four optical points in each seen cell of `SQUARE`."""
    rows, columns = np.nonzero(np.ones(SQUARE.shape) if seen is None else seen)
    points = np.zeros(4 * rows.size, dtype=OPTICAL_POINT)
    points["x_mm"] = SQUARE.x_mm[0] + np.repeat(columns, 4) + np.tile([0.2, 0.4, 0.6, 0.8], rows.size)
    points["y_mm"] = SQUARE.y_mm[0] + np.repeat(rows, 4) + 0.5
    points["z_mm"] = np.repeat(height_mm[rows, columns], 4)
    points["sigma_z_mm"], points["source"] = 0.1, OpticalSource.STEREO
    return points


def sound_at(height_mm: np.ndarray, pitch: int = 4, variance_mm2: float = 0.01) -> Structured:
    """A contact point in the middle of every few cells of `SQUARE`."""
    rows, columns = (axis.ravel() for axis in np.mgrid[2 : SQUARE.shape[0] : pitch, 2 : SQUARE.shape[1] : pitch])
    points = np.zeros(rows.size, dtype=ULTRASONIC_POINT)
    points["x_mm"], points["y_mm"] = SQUARE.x_mm[0] + columns + 0.5, SQUARE.y_mm[0] + rows + 0.5
    points["z_mm"], points["zz_mm2"] = height_mm[rows, columns], variance_mm2
    return points


def with_footprint(calibration: Calibration, radius_mm: float) -> Calibration:
    return msgspec.structs.replace(
        calibration, array=msgspec.structs.replace(calibration.array, footprint_mm=radius_mm)
    )


def test_every_rule_is_described_and_the_default_is_synthesis() -> None:
    assert list(RULES) == list(DESCRIPTIONS)
    assert RULES[DEFAULT].__name__ == "synthesis"


def test_an_unknown_rule_is_refused_with_the_names_of_those_there_are(scan: SmallScan) -> None:
    with pytest.raises(ConfigError, match="unknown fusion rule 'best'") as refused:
        fuse_by("best", scan.optical, np.zeros(0, ULTRASONIC_POINT), (), scan.calibration, FIELD)
    assert all(name in str(refused.value) for name in RULES)


@pytest.mark.parametrize("name", RULES)
def test_a_rule_claims_nothing_that_was_not_measured(name: str, maps: dict[str, HybridMap], scan: SmallScan) -> None:
    cells = maps[name].cells
    claimed = np.isfinite(cells["front_mm"])
    sources = cells["provenance"]
    assert claimed.any()
    assert (sources[claimed] != Provenance.NONE).all()
    assert (np.isfinite(cells["sigma_mm"][claimed]) & (cells["sigma_mm"][claimed] > 0)).all()
    assert (cells["label"][~claimed] == Label.UNKNOWN).all()
    lit, by_sound = (sources & LIGHT) != 0, (sources & Provenance.ULTRASONIC) != 0
    assert (accumulate(scan.optical, FIELD).count.ravel()[claimed & lit] > 0).all()
    assert (cells["optical_n"][claimed & lit] > 0).all()
    assert (cells["ultrasonic_n"][claimed & by_sound] > 0).all()
    assert (cells["label"][claimed & ((sources & Provenance.FILLED) != 0)] == Label.OCCLUDED).all()
    assert (by_sound | ~np.isin(cells["label"], (Label.TRANSPARENT, Label.ABSORBING))).all()
    assert (np.isfinite(cells["behind_mm"]) <= (cells["label"] == Label.TRANSPARENT)).all()


@pytest.mark.parametrize("name", RULES)
def test_a_rule_names_who_speaks_for_a_claim_and_how_probable_it_is(name: str, maps: dict[str, HybridMap]) -> None:
    found = maps[name]
    cells, stripes, pings = found.cells, found.stripes.count, found.pings.count
    lit, by_sound = cells["optical_n"] > 0, cells["ultrasonic_n"] > 0
    assert not lit.any() or (stripes[lit] > 0).all()
    assert not by_sound.any() or (pings[by_sound] > 0).all()
    known = cells["label"] != Label.UNKNOWN
    assert (cells["probability"][known] > 0).all()
    assert (cells["probability"][~known] == 0).all()


def test_without_triggers_a_rule_names_nobody(scan: SmallScan, sound: Structured) -> None:
    found = fuse_by("constant-gate", scan.optical, sound, (), scan.calibration, FIELD)
    assert (found.cells["optical_n"] > 0).any()
    assert found.stripes.which.size == found.pings.which.size == 0
    assert (found.cells["stripe_first"] == NO_TRIGGER).all()


@pytest.mark.parametrize("name", RULES)
def test_without_evidence_a_rule_claims_nothing(name: str, scan: SmallScan) -> None:
    nothing = fuse_by(name, np.zeros(0, OPTICAL_POINT), np.zeros(0, ULTRASONIC_POINT), (), scan.calibration, FIELD)
    assert np.isnan(nothing.cells["front_mm"]).all()
    assert (nothing.cells["label"] == Label.UNKNOWN).all()
    assert (nothing.cells["provenance"] == Provenance.NONE).all()


@pytest.mark.parametrize("name", RULES)
def test_the_order_of_points_and_pings_does_not_matter(name: str, scan: SmallScan, sound: Structured) -> None:
    rng = np.random.default_rng(5)
    pings = scan.pings[::4]
    numbers = triggers(scan.optical), sound_triggers(scan)
    light, heard_ = rng.permutation(scan.optical.size), rng.permutation(sound.size)
    one = fuse_by(name, scan.optical, sound, pings, scan.calibration, FIELD, *numbers)
    mixed = scan.optical[light], sound[heard_], pings[::-1]
    two = fuse_by(name, *mixed, scan.calibration, FIELD, numbers[0][light], numbers[1][heard_])
    assert digest(one) == digest(two)


def test_the_default_rule_is_the_fusion_itself(scan: SmallScan, sound: Structured, maps: dict[str, HybridMap]) -> None:
    alone = fuse(scan.optical, scan.pings[::4], scan.calibration, FIELD, triggers(scan.optical))
    assert digest(maps[DEFAULT]) == digest(alone)


def test_the_plain_rules_have_the_heights_of_the_baselines(
    scan: SmallScan, sound: Structured, maps: dict[str, HybridMap]
) -> None:
    plain = baselines(scan.optical, sound, FIELD)
    for name, height_mm in (("optical", plain.optical_mm), ("union", plain.union_mm)):
        np.testing.assert_array_equal(maps[name].image("front_mm"), height_mm.astype(np.float32))


def test_sound_alone_names_no_material(maps: dict[str, HybridMap]) -> None:
    cells = maps["ultrasonic"].cells
    assert np.isfinite(cells["front_mm"]).any()
    assert (cells["label"] == Label.UNKNOWN).all()


def test_the_mean_by_variance_has_the_known_value_and_sigma(scan: SmallScan) -> None:
    flat = np.zeros(SQUARE.shape)
    light, points = light_at(flat), sound_at(flat + 1.0, variance_mm2=0.25)
    own_mm = accumulate(light, SQUARE).sigma_mm
    found = fuse_by("inverse-variance", light, points, (), scan.calibration, SQUARE)
    variance = 0.25 + CLEAN_MM**2
    share = own_mm**2 / (own_mm**2 + variance)
    np.testing.assert_allclose(found.image("front_mm"), share, rtol=1e-5)
    np.testing.assert_allclose(found.image("sigma_mm"), 1 / np.sqrt(1 / own_mm**2 + 1 / variance), rtol=1e-5)


@pytest.mark.parametrize("name", ["constant-gate", "footprint-gate"])
def test_a_gate_finds_a_plate_above_flat_ground_with_both_layers(name: str, scan: SmallScan) -> None:
    flat, plate = np.zeros(SQUARE.shape), np.zeros(SQUARE.shape, dtype=bool)
    plate[20:60, 16:56] = True
    found = fuse_by(name, light_at(flat), sound_at(np.where(plate, 12.0, 0.0)), (), scan.calibration, SQUARE)
    named = found.image("label") == Label.TRANSPARENT
    assert (named == plate).mean() > 0.97
    assert (found.image("front_mm")[named] == 12.0).all()
    assert (found.image("behind_mm")[named] == 0.0).all()
    assert (found.image("label")[~named] == Label.MATTE).all()


def test_a_constant_sigma_calls_the_foot_of_a_step_transparent_and_the_footprint_does_not(scan: SmallScan) -> None:
    step, blurred = np.zeros(SQUARE.shape), np.zeros(SQUARE.shape)
    step[:, 40:] = blurred[:, 28:] = 20.0  # the step is heard 12 mm before it begins
    calibration = with_footprint(scan.calibration, 15.0)
    found = {
        name: fuse_by(name, light_at(step), sound_at(blurred), (), calibration, SQUARE).image("label")
        for name in ("constant-gate", "footprint-gate")
    }
    assert (found["constant-gate"] == Label.TRANSPARENT).sum() > 600
    assert not (found["footprint-gate"] == Label.TRANSPARENT).any()


def test_a_lone_contact_point_makes_no_glass_by_the_footprint_gate(scan: SmallScan) -> None:
    flat = np.zeros(SQUARE.shape)
    points = sound_at(flat)
    points["z_mm"][points.size // 2] = 15.0
    found = {
        name: (fuse_by(name, light_at(flat), points, (), scan.calibration, SQUARE).cells["label"]) == Label.TRANSPARENT
        for name in ("constant-gate", "footprint-gate")
    }
    assert found["constant-gate"].any()
    assert not found["footprint-gate"].any()


def test_a_gate_gives_a_dark_hole_the_height_of_sound(scan: SmallScan) -> None:
    seen = np.ones(SQUARE.shape, dtype=bool)
    seen[30:50, 30:50] = False
    flat = np.zeros(SQUARE.shape)
    found = fuse_by(
        "footprint-gate", light_at(flat, seen), sound_at(np.where(seen, 0, 9.0)), (), scan.calibration, SQUARE
    )
    assert (found.image("label")[~seen] == Label.ABSORBING).all()
    np.testing.assert_allclose(found.image("front_mm")[32:48, 32:48], 9.0)
    assert not (found.cells["label"] == Label.TRANSPARENT).any()


def test_the_footprint_is_the_calibrated_one_else_the_first_fresnel_zone(scan: SmallScan) -> None:
    array = scan.calibration.array
    wave_mm = array.speed_of_sound_mps * 1e3 / (0.5 * (array.low_hz + array.high_hz))
    assert footprint_mm(array)[0] == pytest.approx(np.sqrt(wave_mm * array.reference_mm / 2))
    assert footprint_mm(with_footprint(scan.calibration, 17.5).array) == (17.5, "as calibrated")


def test_relief_is_the_range_of_heights_within_a_disk() -> None:
    image = np.zeros((41, 41))
    image[20, 20] = 7.0
    y, x = np.mgrid[-20:21, -20:21]
    np.testing.assert_array_equal(relief(image, 4.5, 0.5), np.where(x**2 + y**2 <= 81, 7.0, 0.0))


def test_relief_does_not_see_lines_but_bars() -> None:
    image = np.zeros((40, 40))
    image[:, 10:12] = 20.0
    image[:, 25:30] = 20.0
    found = without_lines(image)
    assert (found[3:-3, :20] == 0).all()
    assert (found[3:-3, 25:30] == 20).all()


def test_a_gate_finds_a_plate_whose_rim_light_sees_and_beside_which_it_sees_nothing(scan: SmallScan) -> None:
    height_mm, plate, seen = np.zeros(SQUARE.shape), np.zeros(SQUARE.shape, dtype=bool), np.ones(SQUARE.shape, bool)
    plate[20:60, 16:46] = True
    height_mm[20:60, 45] = 20.0
    seen[20:60, 46:56] = False
    points = sound_at(np.where(plate, 20.0, 0.0))
    found = fuse_by("footprint-gate", light_at(height_mm, seen), points, (), scan.calibration, SQUARE)
    named = found.image("label") == Label.TRANSPARENT
    assert named[plate].mean() > 0.9
    assert named[~plate].mean() < 0.02


def test_regions_are_wide_and_large() -> None:
    flagged = np.zeros((60, 60), dtype=bool)
    flagged[5:25, 5:25] = flagged[40:50, 5:15] = flagged[:, 50:53] = True
    found = regions(flagged, 1.0)
    assert found[5:25, 5:25].all()
    assert found.sum() == 400


def test_the_forward_model_gate_finds_glass_and_registers_first(scan: SmallScan, maps: dict[str, HybridMap]) -> None:
    found = maps["forward-model-gate"]
    glass = cut(scan.scene.material) == Material.GLASS
    named = found.image("label") == Label.TRANSPARENT
    assert (glass & named).sum() / glass.sum() > 0.5
    assert (glass & named).sum() / named.sum() > 0.5
    assert found.registration.pings > 0
    assert found.registration.residual_db < -10


def test_the_forward_model_gate_cancels_what_steps_do_to_a_beam(matte: SmallScan) -> None:
    points = heard(matte)
    wrong = {
        name: (fuse_by(name, matte.optical, points, matte.pings, matte.calibration, FIELD).cells["label"])
        == Label.TRANSPARENT
        for name in ("constant-gate", "footprint-gate", "forward-model-gate")
    }
    assert wrong["constant-gate"].mean() > 0.02
    assert wrong["forward-model-gate"].mean() < 0.01
    assert wrong["footprint-gate"].mean() < 0.01


def test_without_pings_the_forward_model_gate_says_so(scan: SmallScan, sound: Structured) -> None:
    found = fuse_by("forward-model-gate", scan.optical, sound, (), scan.calibration, FIELD)
    assert found.notes == ("no pings: nothing was compared",)
    assert not (found.cells["label"] == Label.TRANSPARENT).any()


def test_a_gate_says_that_a_narrow_band_slips_by_half_wavelengths(scan: SmallScan, maps: dict[str, HybridMap]) -> None:
    array = msgspec.structs.replace(scan.calibration.array, low_hz=38e3, high_hz=42e3)
    assert "n x 4.3" in slips(array, pings=False)[0]
    assert "4.3" in slips(array, pings=True)[0]
    assert slips(scan.calibration.array, pings=False) == ()
    narrow = msgspec.structs.replace(scan.calibration, array=array)
    flat = np.zeros(SQUARE.shape)
    found = fuse_by("constant-gate", light_at(flat), sound_at(flat), (), narrow, SQUARE)
    assert found.notes == slips(array, pings=False)
    assert maps["constant-gate"].notes == ()
