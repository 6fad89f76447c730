"""Evaluation of maps against the truth: what was imposed is recovered, and what nothing supports is None."""

from __future__ import annotations

import io
import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm

from echolume.evaluation import evaluate as evaluation
from echolume.evaluation.evaluate import Evaluation
from echolume.evaluation.fits import fit_plane, fit_sphere, without_worst
from echolume.evaluation.images import Claimed, Reference, reference
from echolume.evaluation.picture import picture
from echolume.evaluation.regions import regions
from echolume.evaluation.reliability import right
from echolume.evaluation.steps import height_of_step
from echolume.evaluation.table import table
from echolume.main import main
from echolume.results import score_maps
from echolume_drivers.emulated.scene import Material, Scene, SceneBuilder, demo
from echolume_messages.errors import ConfigError
from echolume_messages.plan import MapField
from echolume_messages.types import Label, Provenance
from echolume_processing.export import formats
from echolume_processing.hybrid.model import HybridMap, Registration, empty_cells
from echolume_processing.hybrid.stored import StoredMap

FIELD = MapField()
SIGMA_MM = 0.03
OF_3_IN_1000 = 2 * float(norm.ppf(1 - 0.0015))
"""Range of normal deviates without the three in a thousand furthest off, in sigmas."""
LABELS = {Material.MATTE: Label.MATTE, Material.BLACK: Label.ABSORBING, Material.GLASS: Label.TRANSPARENT}


def truth_file(scene: Scene, path: Path) -> Path:
    np.savez(
        path, front_mm=scene.front_mm, optical_mm=scene.optical_mm, material=scene.material, x0_mm=scene.x0_mm,
        y0_mm=scene.y0_mm, cell_mm=scene.cell_mm,
    )  # fmt: skip
    return path


@dataclass
class Case:
    """A scene's truth, and a map made from it that is right but for noise of the sigma that it states."""

    folder: Path
    truth_path: Path
    truth: Reference
    cells: NDArray[Any]
    image: dict[str, NDArray[Any]]

    @classmethod
    def of(cls, scene: Scene, folder: Path, sigma_mm: float = SIGMA_MM, field: MapField = FIELD) -> Case:
        path = truth_file(scene, folder / "truth.npz")
        real = reference(path, field)
        cells = empty_cells(field)
        image = {name: cells[name].reshape(field.shape) for name in cells.dtype.names or ()}
        rng = np.random.default_rng(5)
        image["front_mm"][:] = real.front_mm + rng.normal(0, sigma_mm, field.shape)
        image["behind_mm"][:] = real.behind_mm
        image["sigma_mm"][:] = sigma_mm
        image["label"][:] = np.where(real.label < 0, Label.MATTE, real.label)
        sound = np.isin(image["label"], (Label.ABSORBING, Label.TRANSPARENT))
        image["provenance"][:] = np.where(sound, Provenance.ULTRASONIC, Provenance.STEREO | Provenance.ACTIVE_LEFT)
        return cls(folder, path, real, cells, image)

    def map_file(self, name: str = "map.npz", field: MapField = FIELD) -> Path:
        path = self.folder / name
        found = HybridMap(field, self.cells, Registration())
        layers = {"optical_mm": self.image["front_mm"]} if name.endswith(".npz") else {}
        formats.format_of(path).write(StoredMap(found, "scan-1", "c0ffee", layers), path)
        return path

    def scores(self, layer: str | None = None, field: MapField = FIELD) -> Evaluation:
        return evaluation.evaluate(*evaluation.load(self.map_file(field=field), self.truth_path, layer))


@pytest.fixture
def case(tmp_path: Path) -> Case:
    return Case.of(demo(), tmp_path)


def test_a_map_with_the_noise_that_it_states_has_nees_one_and_coverage_95(case: Case) -> None:
    rng = np.random.default_rng(3)
    case.image["sigma_mm"][:] = rng.uniform(0.01, 0.2, FIELD.shape)
    case.image["front_mm"][:] = case.truth.front_mm + rng.normal(0, case.image["sigma_mm"])
    rows = case.scores()["consistency"]
    for row in (rows["all"], rows["non_edge"]):
        assert row["nees"] == pytest.approx(1.0, abs=4 * np.sqrt(2 / row["cells"]))
        assert row["nees_median"] == pytest.approx(1.0, abs=0.03)
        assert row["coverage95"] == pytest.approx(0.95, abs=0.004)
        assert row["nees_interval95"] == pytest.approx((1 - 0.0142, 1 + 0.0142), abs=0.001)


def test_a_sensor_whose_sigma_is_half_of_what_it_should_be_has_nees_four(case: Case) -> None:
    sound = case.image["provenance"] == Provenance.ULTRASONIC
    case.image["sigma_mm"][sound] = SIGMA_MM / 2
    sensors = case.scores()["consistency"]["sensors"]
    assert sensors is not None
    assert sensors["ultrasonic"]["nees"] == pytest.approx(4.0, rel=0.1)
    assert sensors["ultrasonic"]["coverage95"] == pytest.approx(2 * norm.cdf(0.98) - 1, abs=0.02)
    assert sensors["stereo"]["nees"] == pytest.approx(1.0, rel=0.05)
    assert sensors["filled"]["nees"] is None


def test_shares_of_the_sensors_and_of_cells_that_name_none(case: Case) -> None:
    case.image["provenance"][:50] = 0
    shares = case.scores()["provenance"]
    assert shares is not None
    assert shares["none"] == 0.25
    assert shares["stereo"] == shares["active_left"]
    assert shares["ultrasonic"] == (70 * 35 + 50 * 25) / 40000
    assert shares["filled"] == 0.0


def test_a_step_that_is_too_high_is_found_to_be_so_whatever_the_tilt(case: Case) -> None:
    x_mm = np.linspace(-99.5, 99.5, 200)
    case.image["front_mm"] += (0.002 * x_mm[None, :] - 0.001 * x_mm[:, None]).astype(np.float32)
    case.image["front_mm"][130:185, 30:50] += np.float32(0.123)
    steps = {(round(s["x_mm"]), round(s["nominal_mm"])): s for s in case.scores()["metrology"]["steps"]}
    for (x, nominal), step in steps.items():
        imposed = {(-70, 10): 0.123, (-50, 10): -0.123, (-60, 20): 0.123}.get((x, nominal), 0.0)
        assert step["error_mm"] == pytest.approx(imposed, abs=3 * step["sigma_mm"]), (x, nominal)
        assert step["sigma_mm"] < 0.012
        assert step["residual_mm"] == pytest.approx(SIGMA_MM, rel=0.1)
    assert {nominal for _, nominal in steps} == {10, 20, 30, 40}


def test_steps_are_summed_up_by_the_sense_that_both_sides_rest_on(case: Case) -> None:
    by_sense = case.scores()["metrology"]["steps_by_sense"]
    assert (by_sense["light"]["count"], by_sense["mixed"]["count"]) == (9, 2)
    assert by_sense["light"]["rms_mm"] <= by_sense["light"]["worst_mm"] < 0.02
    case.image["provenance"][:] = Provenance.ULTRASONIC
    assert list(case.scores()["metrology"]["steps_by_sense"]) == ["sound"]


def test_the_middle_third_of_a_flat_counts_and_nothing_next_to_an_edge(case: Case) -> None:
    step_mm = np.abs(np.gradient(case.truth.front_mm)).max(axis=0)
    case.image["front_mm"][step_mm > 0.5] += 7.0
    assert case.scores()["metrology"]["steps_by_sense"]["light"]["worst_mm"] < 0.02
    assert case.scores()["metrology"]["flatness_mm"] == pytest.approx(OF_3_IN_1000 * SIGMA_MM, rel=0.05)


def test_the_sigma_of_a_step_is_how_far_it_strays() -> None:
    rng = np.random.default_rng(1)
    x, y = (v.ravel() for v in np.meshgrid(np.r_[0:7.0, 13:20.0], np.arange(30.0)))
    tries = [
        height_of_step(np.stack([x, y, 5.0 * (x > 9) + rng.normal(0, 0.1, x.size)], axis=1), x > 9) for _ in range(400)
    ]
    heights_mm, sigmas_mm, _ = np.array(tries).T
    assert heights_mm.mean() == pytest.approx(5.0, abs=4 * sigmas_mm[0] / 20)
    assert heights_mm.std() == pytest.approx(sigmas_mm.mean(), rel=0.1)


def test_two_planes_through_exact_points_are_their_distance_apart() -> None:
    x, y = (v.ravel() for v in np.meshgrid(np.arange(20.0), np.arange(10.0)))
    upper = x > 9
    height_mm, _, residual_mm = height_of_step(np.stack([x, y, 0.1 * x - 0.3 * y + 4 + 2.5 * upper], axis=1), upper)
    assert height_mm == pytest.approx(2.5, abs=1e-12)
    assert residual_mm == pytest.approx(0.0, abs=1e-12)


def test_flatness_is_the_range_of_the_noise_and_three_in_a_thousand_are_left_out(case: Case) -> None:
    case.image["front_mm"][105:108, 100:110] += 5.0
    base, *others = case.scores()["metrology"]["flats"]
    assert base["label"] == "matte"
    assert base["sense"] == "light"
    stay = 2 * norm.ppf(1 - (0.003 - 30 / base["cells"]) / 2)
    assert base["flatness_mm"] == pytest.approx(stay * SIGMA_MM, rel=0.05)
    assert base["range_mm"] == pytest.approx(5.0, abs=0.3)
    assert base["measured"] == 1.0
    assert {row["label"] for row in others} == {"matte", "transparent", "absorbing"}
    assert all(row["rms_mm"] == pytest.approx(SIGMA_MM, rel=0.1) for row in others)
    assert case.scores()["metrology"]["flatness_mm"] == base["flatness_mm"]


def test_a_bowed_flat_is_as_flat_as_its_bow(tmp_path: Path) -> None:
    case = Case.of(SceneBuilder("bench").build(), tmp_path, sigma_mm=0.0)
    x_mm = np.linspace(-1, 1, 200)
    case.image["front_mm"] += (0.4 * x_mm**2).astype(np.float32)[None, :]
    (flat,) = case.scores()["metrology"]["flats"]
    assert flat["range_mm"] == pytest.approx(0.4, rel=0.001)
    assert flat["tilt_error_mrad"] == pytest.approx(0.0, abs=0.05)


def test_a_tilted_plate_is_a_flat_but_no_step_is_measured_on_it(tmp_path: Path) -> None:
    scene = SceneBuilder("tilted").box((-40, 40), (-30, 30), 30.0, Material.GLASS).build()
    y_mm = np.arange(-119.5, 120)[:, None]
    scene.front_mm[scene.material == Material.GLASS] += np.broadcast_to(
        np.tan(np.radians(10)) * y_mm, scene.front_mm.shape
    )[scene.material == Material.GLASS]
    case = Case.of(scene, tmp_path, sigma_mm=0.01)
    made = case.scores()["metrology"]
    assert [(flat["shape"], flat["label"]) for flat in made["flats"]] == [("level", "matte"), ("tilted", "transparent")]
    assert made["flats"][1]["rms_mm"] == pytest.approx(0.01 * np.cos(np.radians(10)), rel=0.05)
    assert made["steps"] == []


def sphere_scene(radius_mm: float) -> Scene:
    scene = SceneBuilder("sphere").build()
    x_mm, y_mm = np.meshgrid(np.arange(-119.5, 120), np.arange(-119.5, 120))
    square = radius_mm**2 - (x_mm - 10.3) ** 2 - (y_mm + 20.1) ** 2
    scene.front_mm[:] = np.where(square > 0, radius_mm + np.sqrt(np.maximum(square, 0)), 0.0)
    return replace(scene, optical_mm=scene.front_mm)


def test_the_probing_error_is_the_size_and_the_form_that_were_imposed(tmp_path: Path) -> None:
    case = Case.of(sphere_scene(40.0), tmp_path)
    larger = sphere_scene(40.0 + 0.15).front_mm[20:220, 20:220]
    case.image["front_mm"][:] = larger + np.random.default_rng(2).normal(0, 0.01, FIELD.shape)
    (sphere,) = case.scores()["metrology"]["spheres"]
    assert (sphere["x_mm"], sphere["y_mm"]) == (pytest.approx(10.3, abs=1e-6), pytest.approx(-20.1, abs=1e-6))
    assert sphere["radius_mm"] == pytest.approx(40.0, abs=1e-6)
    assert sphere["size_mm"] == pytest.approx(0.3, abs=0.02)
    assert sphere["form_mm"] == pytest.approx(OF_3_IN_1000 * 0.01 * 0.85, rel=0.15)


def test_a_cylinder_is_no_sphere_and_a_truth_without_one_has_no_probing_error(tmp_path: Path) -> None:
    scene = SceneBuilder("bottle").build()
    x_mm = np.arange(-119.5, 120)
    scene.front_mm[80:160] = np.where(np.abs(x_mm) < 30, np.sqrt(np.maximum(30.0**2 - x_mm**2, 0)), 0.0)
    made = Case.of(scene, tmp_path).scores()["metrology"]
    assert (made["spheres"], made["probing_form_mm"], made["probing_size_mm"]) == ([], None, None)


def test_fits_return_what_was_put_in_and_refuse_what_holds_nothing() -> None:
    rng = np.random.default_rng(0)
    direction = rng.normal(size=(500, 3))
    on_sphere = [3, -2, 50] + 20 * direction / np.linalg.norm(direction, axis=1, keepdims=True)
    sphere = fit_sphere(on_sphere)
    assert sphere is not None
    np.testing.assert_allclose([*sphere.centre_mm, sphere.radius_mm], [3, -2, 50, 20], atol=1e-9)
    flat = np.column_stack([rng.normal(size=(50, 2)), np.zeros(50)])
    assert fit_sphere(flat) is None
    with pytest.raises(ValueError, match="on a line"):
        fit_plane(np.column_stack([np.arange(5.0)] * 3))
    assert without_worst(np.array([0.0, -9.0, 1.0, 5.0]), 0.5).tolist() == [True, False, True, False]
    assert without_worst(np.zeros(300), 0.003).all()


def test_labels_as_right_as_they_say_have_no_calibration_error(case: Case) -> None:
    rng = np.random.default_rng(8)
    stated = rng.choice([0.25, 0.75, 0.97, 0.9992], FIELD.shape)
    wrong = rng.random(FIELD.shape) > stated
    case.image["probability"][:] = stated
    case.image["label"][wrong] = (case.image["label"][wrong] % 3) + 1
    found = case.scores()["reliability"]
    assert found is not None
    assert found["cells"] == stated.size
    assert found["right"] == pytest.approx(1 - wrong.mean())
    assert found["label_ece"] < 0.006
    assert found["label_brier"] == pytest.approx(float(np.mean(stated * (1 - stated))), rel=0.03)
    assert [(row["low"], row["high"]) for row in found["bins"]] == [(0.2, 0.3), (0.7, 0.8), (0.95, 0.98), (0.999, 1.0)]
    for row in found["bins"]:
        assert row["right"] == pytest.approx(row["stated"], abs=0.02)
    assert "calibration error" in table(case.scores())


def test_labels_that_are_surer_than_right_have_that_calibration_error(case: Case) -> None:
    case.image["probability"][:] = 1.0
    case.image["label"][:, :50] = Label.ABSORBING
    share = float((case.truth.label[:, :50] != Label.ABSORBING).sum() / case.truth.label.size)
    found = case.scores()["reliability"]
    assert found is not None
    assert found["label_ece"] == pytest.approx(share)
    assert found["label_brier"] == pytest.approx(share)


def test_probabilities_of_unknown_cells_and_those_not_stated_do_not_count(case: Case) -> None:
    case.image["probability"][:] = np.nan
    assert case.scores()["reliability"] is None
    case.image["probability"][0, :30] = 0.5
    case.image["label"][0, :10] = Label.UNKNOWN
    found = case.scores()["reliability"]
    assert found is not None
    assert found["cells"] == 20


def test_occluded_is_right_over_what_light_should_have_seen() -> None:
    label = np.array([Label.OCCLUDED, Label.OCCLUDED, Label.OCCLUDED, Label.MATTE, Label.MATTE, Label.TRANSPARENT])
    truth = np.array([Label.MATTE, Label.TRANSPARENT, Label.ABSORBING, Label.OCCLUDED, Label.MATTE, Label.UNKNOWN])
    assert right(label, truth).tolist() == [True, False, False, True, True, False]


def test_recall_precision_and_confusion_are_those_imposed(case: Case) -> None:
    label = case.image["label"]
    glass, black = (np.argwhere(case.truth.label == kind) for kind in (Label.TRANSPARENT, Label.ABSORBING))
    label[tuple(glass[:420].T)] = Label.MATTE
    label[tuple(glass[420:630].T)] = Label.UNKNOWN
    label[tuple(black[:500].T)] = Label.TRANSPARENT
    found = case.scores()
    scores, confusion = found["labels"], found["confusion"]
    assert scores is not None
    assert confusion is not None
    assert scores["transparent"]["recall"] == 0.85
    assert scores["transparent"]["precision"] == pytest.approx(3570 / 4070)
    assert scores["absorbing"]["recall"] == 0.8
    assert scores["absorbing"]["precision"] == 1.0
    assert scores["matte"]["precision"] == pytest.approx(33300 / 33720)
    assert scores["unknown"] == {"truth": 0, "named": 210, "recall": None, "precision": None}
    assert confusion["transparent"] == {
        "unknown": 210, "matte": 420, "transparent": 3570, "absorbing": 0, "occluded": 0,
    }  # fmt: skip
    assert found["all"]["glass_recall"] == scores["transparent"]["recall"]


def test_a_glossy_surface_may_have_any_label(tmp_path: Path) -> None:
    scene = SceneBuilder("glossy").box((0, 20), (0, 20), 10.0, Material.GLOSSY).build()
    found = Case.of(scene, tmp_path).scores()
    assert found["confusion"] is not None
    assert found["confusion"]["any"]["matte"] == 400
    assert found["labels"] is not None
    assert found["labels"]["matte"]["precision"] == 1.0
    assert (found["glass"], found["all"]["glass_recall"]) == (None, None)


def test_a_truth_may_ask_for_the_unknown(case: Case) -> None:
    asked = np.full((240, 240), -1)
    asked[40:60, 40:60] = Label.UNKNOWN
    with np.load(case.truth_path) as images:
        kept = dict(images)
    np.savez(case.truth_path, **kept, label=asked)
    case.image["label"][20:40, 20:30], case.image["front_mm"][20:40, 20:30] = Label.UNKNOWN, np.nan
    found = case.scores()
    assert found["labels"] is not None
    assert found["labels"]["unknown"] == {"truth": 400, "named": 200, "recall": 0.5, "precision": 1.0}
    assert found["labels"]["transparent"]["recall"] is None
    assert found["confusion"] is not None
    assert sum(found["confusion"]["any"].values()) == 40000 - 400


def test_glass_height_is_the_median_and_plates_are_told_apart(tmp_path: Path) -> None:
    scene = SceneBuilder("two").box((-60, -20), (-20, 20), 30.0, Material.GLASS)
    case = Case.of(scene.box((20, 60), (-20, 20), 10.0, Material.GLASS).build(), tmp_path, sigma_mm=0.0)
    case.image["front_mm"][80:120, 40:80] += np.float32(0.25)
    case.image["front_mm"][80:82, 40:80] += 9.0
    case.image["behind_mm"][80:120, 40:80] += np.float32(0.5)
    case.image["label"][100:120, 120:160] = Label.MATTE
    glass = case.scores()["glass"]
    assert glass is not None
    assert [(p["cells"], p["height_mm"], p["recall"], p["error_mm"]) for p in glass["plates"]] == [
        (1600, 30.0, 1.0, 0.25),
        (1600, 10.0, 0.5, 0.0),
    ]
    assert (glass["cells"], glass["median_mm"], glass["median_abs_mm"]) == (2400, 0.25, 0.25)
    assert glass["behind_rmse_mm"] == pytest.approx(0.5 * np.sqrt(2 / 3))


def test_scores_of_heights_are_those_of_the_report(case: Case) -> None:
    case.image["front_mm"][:60] += 3.0
    case.image["front_mm"][150:160] = np.nan
    path = case.map_file()
    with np.load(path) as images:
        np.savez(
            case.folder / "more.npz", **dict(images), ultrasonic_mm=images["front_mm"], union_mm=images["front_mm"]
        )
    found = case.scores()
    reported = score_maps(case.folder / "more.npz", case.truth_path, FIELD)
    assert found["all"] == reported["hybrid"]
    assert case.scores("optical_mm")["all"] == reported["optical"]
    assert found["all"]["completeness"] == 0.95
    assert found["cells"] == {"scored": 40000, "non_edge": 37654, "claimed": 38000}


def test_a_layer_has_heights_only(case: Case) -> None:
    found = case.scores("optical_mm")
    assert (found["labels"], found["confusion"], found["glass"], found["provenance"]) == (None, None, None, None)
    assert found["reliability"] is None
    assert found["consistency"]["all"]["nees"] is None
    assert list(found["metrology"]["steps_by_sense"]) == ["unstated"]


def test_another_map_is_a_truth_with_sigmas_of_its_own_and_without_nominal_shapes(case: Case) -> None:
    case.image["front_mm"][:5] = np.nan
    reference_map = case.map_file("reference.las")
    case.image["front_mm"][:] = case.truth.front_mm + np.random.default_rng(9).normal(0, SIGMA_MM, FIELD.shape)
    found = evaluation.evaluate(*evaluation.load(case.map_file(), reference_map))
    assert found["sources"]["truth_kind"] == "another map"
    assert found["cells"]["scored"] == 39000
    assert found["consistency"]["non_edge"]["nees"] == pytest.approx(1.0, abs=0.04)
    assert found["labels"] is not None
    assert found["labels"]["transparent"]["recall"] == 1.0
    assert (found["metrology"]["steps"], found["metrology"]["flatness_mm"]) == ([], None)


def test_regions_of_the_demo_are_its_flats(case: Case) -> None:
    found = regions(case.truth, FIELD)
    assert [int(region.cells.sum()) for region in found] == [27140, 4200, 2500, *[1100] * 5, 660]
    assert {region.shape for region in found} == {"level"}
    assert [region.width_mm for region in found[1:3]] == [pytest.approx(60, abs=1), pytest.approx(50, abs=1)]


def test_the_table_shows_a_dash_for_what_nothing_supports(case: Case) -> None:
    text = table(case.scores("optical_mm"))
    assert "Not in the truth, so without a figure: spheres" in text
    row = next(line for line in text.splitlines() if line.startswith("non_edge"))
    assert row.split()[-2:] == ["-", "-"]
    assert "nan" not in text


def test_the_command_prints_json_without_nan_and_draws_the_error_map(
    case: Case, capsys: pytest.CaptureFixture[str]
) -> None:
    case.image["front_mm"][20:60, 100:140] += 8.0
    drawn = case.folder / "error.png"
    assert main(["evaluate", str(case.map_file()), str(case.truth_path), "--json", "--figure", str(drawn)]) == 0
    found = json.loads(capsys.readouterr().out, parse_constant=lambda name: pytest.fail(name))
    assert (found["sources"]["scan"], found["sources"]["calibration"]) == ("scan-1", "c0ffee")
    assert found["metrology"]["probing_form_mm"] is None
    assert main(["evaluate", str(case.map_file("map.e57")), str(case.truth_path)]) == 0
    assert "Glass height" in capsys.readouterr().out
    image = cv2.imread(str(drawn))
    assert image is not None
    too_high = (image == (0xD6, 0x2B, 0xFF)).all(axis=2)
    assert too_high.sum() > 2000, "cells beyond the scale stand out"
    assert (image == (224, 160, 64)).all(axis=2).sum() > 2000, "glass has the colour of its label"


def test_the_picture_of_a_layer_says_what_is_missing(case: Case) -> None:
    claimed, truth, field, sources = evaluation.load(case.map_file(), case.truth_path, "optical_mm")
    drawn = picture(claimed, truth, field, evaluation.evaluate(claimed, truth, field, sources))
    assert drawn.startswith(b"\x89PNG")


Change = Callable[[Case], tuple[Path, Path]]


def _without(name: str) -> Change:
    def change(case: Case) -> tuple[Path, Path]:
        with np.load(case.truth_path) as images:
            kept = {key: images[key] for key in images.files if key != name}
        np.savez(case.truth_path, **kept)
        return case.map_file(), case.truth_path

    return change


def _with(name: str, value: object) -> Change:
    def change(case: Case) -> tuple[Path, Path]:
        with np.load(case.truth_path) as images:
            kept = dict(images)
        np.savez(case.truth_path, **{**kept, name: np.asarray(value)})
        return case.map_file(), case.truth_path

    return change


def _cut(case: Case) -> tuple[Path, Path]:
    data = case.truth_path.read_bytes()
    case.truth_path.write_bytes(data[: len(data) // 2])
    return case.map_file(), case.truth_path


def _cut_map(case: Case) -> tuple[Path, Path]:
    path = case.map_file()
    path.write_bytes(path.read_bytes()[:50_000])
    return path, case.truth_path


def _empty(case: Case) -> tuple[Path, Path]:
    case.cells[:] = empty_cells(FIELD)
    return case.map_file(), case.truth_path


def _bare(case: Case) -> tuple[Path, Path]:
    buffer = io.BytesIO()
    np.savez(buffer, heights=np.zeros((3, 3)))
    (case.folder / "bare.npz").write_bytes(buffer.getvalue())
    return case.folder / "bare.npz", case.truth_path


BAD: dict[str, tuple[Change, str]] = {
    "truth on another raster": (_with("cell_mm", 0.5), "raster"),
    "truth shifted by half a cell": (_with("x0_mm", -119.5), "raster"),
    "truth too small": (_with("x0_mm", 0.0), "beyond the truth"),
    "truth without material": (_without("material"), "lacks material"),
    "truth without heights": (_without("front_mm"), "lacks front_mm"),
    "truth whose images differ": (_with("material", np.zeros((3, 3), np.uint8)), "material: expected an image"),
    "truth whose corner is no number": (_with("y0_mm", "left"), "y0_mm: expected a number"),
    "truth with labels that are none": (_with("label", np.full((240, 240), 9)), "label: expected -1"),
    "truth that knows nothing": (_with("front_mm", np.full((240, 240), np.nan)), "knows no height"),
    "truth cut short": (_cut, "cut short"),
    "map cut short": (_cut_map, "cut short"),
    "map without a height": (_empty, "no cell of the map has a height"),
    "map without fields": (_bare, "lacks front_mm"),
}


@pytest.mark.parametrize("name", BAD)
def test_bad_input_is_refused_by_name(name: str, case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    change, said = BAD[name]
    map_path, truth_path = change(case)
    assert main(["evaluate", str(map_path), str(truth_path)]) == 2
    error = capsys.readouterr().err
    assert said in error
    assert str(case.folder) in error


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--layer", "depth_mm"], "no layer 'depth_mm'; it has: optical_mm"),
        (["--figure", "error.jpg"], "pictures are PNG"),
        (["--figure", "nowhere/error.png"], "there is no folder"),
    ],
)
def test_bad_options_are_refused(
    options: list[str], said: str, case: Case, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(case.folder)
    assert main(["evaluate", str(case.map_file()), str(case.truth_path), *options]) == 2
    assert said in capsys.readouterr().err


def test_a_folder_and_a_file_that_is_not_there_are_refused(case: Case, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["evaluate", str(case.map_file()), str(case.folder)]) == 2
    assert "is a folder" in capsys.readouterr().err
    assert main(["evaluate", str(case.map_file()), str(case.folder / "none.npz")]) == 1
    assert "none.npz: No such file" in capsys.readouterr().err


def test_a_map_that_claims_nothing_is_refused_before_it_is_scored(case: Case) -> None:
    case.cells["front_mm"] = np.nan
    with pytest.raises(ConfigError, match="nothing to score"):
        case.scores()


def test_small_fields_have_no_regions_and_still_have_scores(tmp_path: Path) -> None:
    field = MapField(x_mm=(-1.0, 1.0), y_mm=(-1.0, 1.0), cell_mm=1.0)
    case = Case.of(demo(), tmp_path, field=field)
    found = case.scores(field=field)
    assert found["all"]["f1_at_1mm"] == 1.0
    assert found["metrology"]["flats"] == []
    assert Claimed(case.truth.front_mm).label is None
