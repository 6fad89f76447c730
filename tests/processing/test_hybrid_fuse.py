"""The forward-model gate on a small emulated scene: glass, black, and no false alarm on matte."""

from __future__ import annotations

import msgspec
import numpy as np
import pytest
from scipy import ndimage

from echolume_drivers.emulated import scene_file
from echolume_drivers.emulated.scene import Material, SceneBuilder
from echolume_messages.calibration import Calibration
from echolume_messages.types import NO_TRIGGER, OPTICAL_POINT, Label, Provenance
from echolume_processing.hybrid import cell_kernels, kernels, surface, tile_kernels
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.fuse import fuse
from echolume_processing.hybrid.model import HybridMap
from echolume_processing.hybrid.warm_up import warm_up
from processing.hybrid_scan import FIELD, FIRST_PING, SmallScan, all_matte, glass_and_black, small_scan, triggers

RIM = 120 - 48


@pytest.fixture(scope="module")
def scan() -> SmallScan:
    return small_scan(glass_and_black())


@pytest.fixture(scope="module")
def found(scan: SmallScan) -> HybridMap:
    return fuse(scan.optical, scan.pings, scan.calibration, FIELD, triggers(scan.optical))


def cut(image: np.ndarray) -> np.ndarray:
    return image[RIM:-RIM, RIM:-RIM]


def test_glass_is_found_and_has_two_layers(scan: SmallScan, found: HybridMap) -> None:
    glass = cut(scan.scene.material) == Material.GLASS
    named = found.image("label") == Label.TRANSPARENT
    assert (glass & named).sum() / glass.sum() > 0.85
    assert (glass & named).sum() / named.sum() > 0.9
    assert np.abs(found.image("front_mm")[glass & named] - 24.0).max() < 0.3
    assert np.abs(found.image("behind_mm")[glass & named]).max() < 1.0
    assert (found.image("provenance")[named] & Provenance.ULTRASONIC).all()
    assert (found.image("ultrasonic_n")[named] > 0).all()


def test_the_black_block_gets_its_height_from_sound(scan: SmallScan, found: HybridMap) -> None:
    black = cut(scan.scene.material) == Material.BLACK
    named = found.image("label") == Label.ABSORBING
    assert (black & named).sum() / (black | named).sum() > 0.95
    assert np.abs(found.image("front_mm")[black & named] - 17.0).max() < 0.3
    assert (found.image("provenance")[named] == Provenance.ULTRASONIC).all()
    assert np.isnan(found.image("behind_mm")[named]).all()


def test_every_cell_with_a_height_names_its_source_and_no_other_does(found: HybridMap) -> None:
    claimed = np.isfinite(found.cells["front_mm"])
    assert (found.cells["provenance"][claimed] != Provenance.NONE).all()
    assert (found.cells["label"][~claimed] == Label.UNKNOWN).all()
    unnamed = found.cells["provenance"][claimed & (found.cells["label"] == Label.UNKNOWN)]
    assert (unnamed & Provenance.ULTRASONIC).all()  # only sound knows heights without knowing what is there


def test_every_claimed_cell_has_witnesses_and_a_probability(found: HybridMap) -> None:
    cells = found.cells
    claimed, sound = cells["label"] != Label.UNKNOWN, (cells["provenance"] & Provenance.ULTRASONIC) != 0
    stripes, pings = found.stripes.count, found.pings.count
    assert claimed.any()
    assert (stripes + pings > 0)[claimed].all()
    assert (pings[sound] > 0).all()
    assert ((stripes > 0) == (cells["optical_n"] > 0)).all()
    assert (cells["probability"][claimed] > 0).all()
    assert (cells["probability"][~claimed] == 0).all()
    assert (cells["probability"] <= 1).all()


def test_the_triggers_in_a_cell_are_those_of_its_tables(found: HybridMap) -> None:
    cells = found.cells
    np.testing.assert_array_equal(cells["stripe_first"], found.stripes.first)
    np.testing.assert_array_equal(cells["stripe_last"], found.stripes.last)
    assert ((cells["ping"] == NO_TRIGGER) == (found.pings.count == 0)).all()
    for k in np.flatnonzero(cells["ping"] != NO_TRIGGER)[::97]:
        assert cells["ping"][k] in found.pings.of(k)


def test_the_stripes_of_a_cell_are_those_whose_line_runs_through_it(found: HybridMap) -> None:
    x_mm = FIELD.x_mm[0] + (found.cells["ix"][found.stripes.cell] + 0.5) * FIELD.cell_mm
    np.testing.assert_allclose(found.stripes.which.astype(float) - 200, x_mm, atol=0.51)


def test_the_pings_of_a_cell_stood_near_to_it(scan: SmallScan, found: HybridMap) -> None:
    cells = found.cells[found.pings.cell]
    x_mm, y_mm = (start + (cells[name] + 0.5) * FIELD.cell_mm for name, start in (("ix", -48.0), ("iy", -48.0)))
    pose = (
        np.array([scan.calibration.array.rig_from_robot])
        @ np.array([[*scan.pings[k - FIRST_PING].robot_pose[:3], 1.0] for k in found.pings.which])[:, :, None]
    )
    away_mm = np.hypot(pose[:, 0, 0] - x_mm, pose[:, 1, 0] - y_mm)
    assert np.quantile(away_mm, 0.99) < 25


def test_in_the_middle_of_a_plate_the_label_is_surer_than_at_its_rim(found: HybridMap) -> None:
    named = found.image("label") == Label.TRANSPARENT
    rim = named & ~ndimage.binary_erosion(named)
    inner = ndimage.binary_erosion(named, iterations=5)
    assert found.image("probability")[inner].min() > 0.97
    assert found.image("probability")[rim].max() < 0.9


def test_most_cells_are_right_to_a_millimetre(scan: SmallScan, found: HybridMap) -> None:
    error_mm = np.abs(found.image("front_mm") - cut(scan.scene.front_mm))
    assert (error_mm <= 1.0).mean() > 0.95


def test_the_order_of_arrival_does_not_matter(scan: SmallScan) -> None:
    order = np.random.default_rng(3).permutation(scan.optical.size)
    light, number = scan.optical, triggers(scan.optical)
    one = fuse(light, scan.pings[::3], scan.calibration, FIELD, number)
    two = fuse(light[order], scan.pings[::3][::-1], scan.calibration, FIELD, number[order])
    assert one.stripes.which.size
    assert one.pings.which.size
    assert digest(one) == digest(two)


def test_a_matte_scene_has_nothing_transparent_and_registration_finds_an_imposed_offset() -> None:
    scan = small_scan(all_matte(), seed=2)
    pose = scan.calibration.array.array_pose
    pose[2, 3] += 0.4  # array z looks down: the calibration now says 0.4 mm too low
    moved = msgspec.structs.replace(scan.calibration.array, flange_from_array=pose.tolist())
    found = fuse(scan.optical, scan.pings, msgspec.structs.replace(scan.calibration, array=moved), FIELD)
    assert not np.isin(found.cells["label"], (Label.TRANSPARENT, Label.ABSORBING, Label.UNKNOWN)).any()
    assert abs(abs(found.registration.dz_mm) - 0.4) < 0.25
    assert found.registration.residual_db < -16
    assert len(found.notes) == 1
    assert "its own echoes moved it: dz_mm" in found.notes[0]


def test_without_pings_there_is_a_map_of_light_that_says_so(scan: SmallScan) -> None:
    found = fuse(scan.optical, [], scan.calibration, FIELD)
    assert not (found.cells["label"] == Label.TRANSPARENT).any()
    assert (found.cells["label"] == Label.UNKNOWN).sum() > 900  # the black block
    assert any("no pings" in note for note in found.notes)


def test_without_light_everything_stays_unknown(scan: SmallScan) -> None:
    found = fuse(np.zeros(0, dtype=OPTICAL_POINT), scan.pings[:3], scan.calibration, FIELD)
    assert (found.cells["label"] == Label.UNKNOWN).all()
    assert np.isnan(found.cells["front_mm"]).all()


def test_a_hanging_plate_is_found_and_its_hole_stays_open() -> None:
    scan = small_scan(
        scene_file.build(
            scene_file.parse(
                """
                name = "holed"
                [[piece]]
                kind = "plate"
                material = "glass"
                x_mm = [-40.0, 34.0]
                y_mm = [-36.0, 36.0]
                z_mm = 26.0
                thickness_mm = 3.0
                holes = [{ x_mm = 0.0, y_mm = 0.0, diameter_mm = 30.0 }]
                """
            )
        ),
        seed=3,
        pitch_mm=10.0,
    )
    found = fuse(scan.optical, scan.pings, scan.calibration, FIELD)
    glass = cut(scan.scene.material) == Material.GLASS
    named = found.image("label") == Label.TRANSPARENT
    assert (glass & named).sum() / glass.sum() > 0.9
    assert (glass & named).sum() / named.sum() > 0.9
    assert np.abs(found.image("front_mm")[named] - 26.0).max() < 0.3
    y, x = np.mgrid[-47.5:48.0, -47.5:48.0]
    hole = np.hypot(x, y) < 11
    assert np.isin(found.image("label")[hole], (Label.MATTE, Label.UNKNOWN)).all()
    assert np.abs(found.image("front_mm")[hole]).max() < 1.0


def test_a_plate_too_small_for_any_contact_point_is_found() -> None:
    scan = small_scan(SceneBuilder("small").box((-10, 10), (-12, 8), 20.0, Material.GLASS).build(), pitch_mm=10.0)
    found = fuse(scan.optical, scan.pings, scan.calibration, FIELD)
    glass = cut(scan.scene.material) == Material.GLASS
    named = found.image("label") == Label.TRANSPARENT
    assert (glass & named).sum() / glass.sum() > 0.9
    assert (glass & named).sum() / named.sum() > 0.9
    assert np.abs(found.image("front_mm")[named] - 20.0).max() < 0.5


def test_where_light_sees_next_to_nothing_sound_speaks_alone_and_is_not_registered() -> None:
    scan = small_scan(SceneBuilder("dark").box((-70, 70), (-70, 70), 18.0, Material.GLASS).build())
    beyond = np.abs(scan.optical["x_mm"]) > 66
    ghosts = scan.optical[beyond | (np.abs(scan.optical["y_mm"]) > 66)]
    found = fuse(ghosts, scan.pings, scan.calibration, FIELD)
    claimed = np.isfinite(found.image("front_mm"))
    assert claimed.mean() > 0.9
    assert np.abs(found.image("front_mm")[claimed] - 18.0).max() < 0.5
    assert (found.image("label")[claimed] == Label.ABSORBING).all()
    assert found.registration.pings == 0
    assert any("not registered" in note for note in found.notes)


def test_beside_a_rim_cells_are_less_sure(scan: SmallScan, found: HybridMap) -> None:
    named = found.image("label") == Label.TRANSPARENT
    inner = ndimage.binary_erosion(named, iterations=8)
    rim = named & ~ndimage.binary_erosion(named)
    assert np.median(found.image("sigma_mm")[inner]) < 0.2
    assert np.median(found.image("sigma_mm")[rim]) > 3.0


def test_a_narrow_band_says_what_it_cannot_decide(scan: SmallScan) -> None:
    array = msgspec.structs.replace(scan.calibration.array, low_hz=38e3, high_hz=42e3)
    narrow: Calibration = msgspec.structs.replace(scan.calibration, array=array)
    found = fuse(scan.optical, scan.pings[::6], narrow, FIELD)
    assert any("narrow band" in note for note in found.notes)


def test_the_warm_up_compiles_what_fusing_uses(found: HybridMap) -> None:
    assert found.cells.size
    warm_up()
    for kernel in (
        kernels.lay_facets,
        kernels.lay_walls,
        surface._horizons,
        tile_kernels.tile_spectra,
        tile_kernels.solve_box,
        cell_kernels.occupied,
        cell_kernels.twice_medians,
        cell_kernels.lower_ground,
    ):
        assert len(kernel.signatures) == 1, f"{kernel.__name__}: fusing and warm-up call it with other types"
