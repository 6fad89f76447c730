"""Scene files: the shipped ones are what they say, wrong ones are refused by path, and a map is held against them."""

from __future__ import annotations

import dataclasses
from pathlib import Path

import cv2
import msgspec
import numpy as np
import pytest

from echolume_drivers.emulated import scene_file
from echolume_drivers.emulated.array_truth import array_truth
from echolume_drivers.emulated.echoes import simulate_ping
from echolume_drivers.emulated.expectations import judge
from echolume_drivers.emulated.optics import optical_truth
from echolume_drivers.emulated.scene import SCENES, Expectation, Material, Scene, SceneBuilder, named
from echolume_drivers.emulated.stripe_image import render_stripe
from echolume_messages.errors import ConfigError
from echolume_messages.rig import ArraySettings
from echolume_messages.types import Label

BEFORE = Path(__file__).parent / "data" / "four_scenes.npz"
POSES = {"wideband": (-50, -40, 150, 0, 0, 0), "paper": (40, -50, 120, 0.1, -0.1, 0)}


EXPECT = '[[expect]]\nregion = "{}"\nmay = ["{}"]\n'
HEIGHTS = '[[piece]]\nkind = "heights"\nfile = "{}"\ncorner_mm = [0.0, 0.0]\n'


def built(text: str) -> Scene:
    return scene_file.build(scene_file.parse('name = "x"\n' + text))


def box(more: str = "") -> str:
    return '[[piece]]\nkind = "box"\nname = "b"\nx_mm = [-20.0, 20.0]\ny_mm = [-10.0, 10.0]\nz_mm = 5.0\n' + more


def by_hand(name: str) -> Scene:
    scene = SceneBuilder(name)
    if name == "plate":
        return scene.box((-120, 120), (-120, 120), 0.0).build()
    if name == "block":
        return scene.box((-22, 38), (-16, 28), 25.0).build()
    for k in range(4):
        scene.box((-90 + 20 * k, -70 + 20 * k), (30, 85), 10.0 * (k + 1))
    scene.box((25, 45), (30, 85), 20.0).box((65, 77), (30, 85), 20.0)
    kinds = (Material.GLASS, Material.BLACK) if name == "demo" else (Material.MATTE, Material.MATTE)
    return scene.box((-85, -15), (-75, -15), 30.0, kinds[0]).box((20, 70), (-75, -25), 20.0, kinds[1]).build()


@pytest.mark.parametrize("name", ["demo", "plate", "block", "matte"])
def test_the_file_of_a_scene_is_the_scene_that_hands_would_build(name: str) -> None:
    found, expected = SCENES[name](), by_hand(name)
    for field in ("front_mm", "optical_mm", "material", "light_ground", "glass"):
        assert np.array_equal(getattr(found, field), getattr(expected, field)), field
    assert (found.name, found.x0_mm, found.y0_mm, found.cell_mm) == (name, -120.0, -120.0, 1.0)


@pytest.mark.parametrize("name", ["demo", "plate", "block", "matte"])
def test_the_first_scenes_look_and_sound_as_they_always_did(name: str) -> None:
    """Against what was recorded when scenes were level boxes only.

    Equal bit for bit where the compiler fuses the same operations; elsewhere a rounding may fall otherwise.
    """
    scene, optics = SCENES[name](), optical_truth(7)
    with np.load(BEFORE) as before:
        for pulse, pose in POSES.items() if name == "demo" else [("wideband", POSES["wideband"])]:
            array = ArraySettings(port="n", pulse=pulse)
            truth = dataclasses.replace(array_truth(3, array), placement_mm=np.zeros((8, 3)))
            at = truth.rig_from_array(np.array(pose, dtype=float))
            ping = simulate_ping(scene, at, array, truth, 22.0, np.random.default_rng(5)).astype(int)
            off = ping - before[f"{name}-{pulse}"]
            assert np.abs(off).max() <= 1
            assert np.mean(off != 0) < 1e-3
        for side, x_mm in (("left", -55.3), ("right", 33.0)):
            frame = render_stripe(scene, optics, side, x_mm, np.random.default_rng(5), 4e-3, True).astype(np.int32)
            sums = np.stack([frame.sum(axis=1), (frame * np.arange(1280)).sum(axis=1)])
            assert np.mean(sums != before[f"{name}-{side}-{x_mm}"]) < 1e-2


@pytest.mark.parametrize("name", scene_file.shipped_names())
def test_every_shipped_scene_says_what_it_is_and_what_a_map_must_say(name: str) -> None:
    described = scene_file.shipped(name)
    assert described.name == name
    assert all((described.about, described.light_sees, described.sound_hears, described.map_must_say))
    scene = SCENES[name]()
    assert scene.expect
    assert np.all(scene.optical_mm <= scene.front_mm)
    assert scene.front_mm.max() < 60
    counted = {scene.regions[k] for k in np.unique(scene.region_image)}
    assert {e.region for e in scene.expect} <= counted | {"elsewhere"}


@pytest.mark.parametrize("name", scene_file.shipped_names())
def test_a_perfect_map_keeps_every_expectation(name: str) -> None:
    scene = SCENES[name]()
    label = np.full(scene.front_mm.shape, int(Label.MATTE))
    front_mm = scene.front_mm.copy()
    for expected in scene.expect:
        cells = scene.region_image == scene.regions.index(expected.region)
        says = max(expected.must, key=expected.must.__getitem__, default=expected.may[0])
        label[cells] = Label[says.upper()]
        if says == "unknown":
            front_mm[cells] = np.nan
    said = judge(scene.expect, scene.regions, scene.region_image, label, front_mm, scene.front_mm, scene.optical_mm)
    assert [s for s in said if not s.kept] == []
    assert all(s.cells > 20 for s in said if s.what == "labels" and s.region != "sheet.holes")


@pytest.mark.parametrize(
    "name", ["demo", "glass-tilt-10", "glass-steep", "glass-small", "glass-two", "mirror", "bottle", "glass-stair"]
)
def test_a_map_of_light_alone_breaks_the_expectations(name: str) -> None:
    scene = SCENES[name]()
    label = np.full(scene.front_mm.shape, int(Label.MATTE))
    said = judge(
        scene.expect, scene.regions, scene.region_image, label, scene.optical_mm, scene.front_mm, scene.optical_mm
    )
    assert any(not s.kept for s in said)


def test_judging_counts_shares_inside_the_margin() -> None:
    region = np.zeros((20, 20), dtype=np.uint8)
    region[5:15, 5:15] = 1
    label = np.full((20, 20), int(Label.MATTE))
    label[5:15, 5:10] = Label.TRANSPARENT
    front_mm = np.where(region == 1, 7.0, 0.0)
    front_mm[7:13, 7] = np.nan
    expect = [Expectation(region="p", may=["transparent"], must={"matte": 0.5}, height="top", within_mm=1.0)]
    said = judge(expect, ["elsewhere", "p"], region, label, front_mm, np.full((20, 20), 6.5), np.zeros((20, 20)))
    assert [(s.what, s.share, s.cells, s.kept) for s in said] == [
        ("labels", 0.5, 36, False),
        ("must matte", 0.5, 36, True),
        ("height", 1.0, 30, True),
    ]
    with pytest.raises(ValueError, match="no region 'q'"):
        judge([msgspec.structs.replace(expect[0], region="q")], ["p"], region, label, front_mm, front_mm, front_mm)
    with pytest.raises(ValueError, match="label"):
        judge(expect, ["elsewhere", "p"], region, label[:5], front_mm, front_mm, front_mm)


class TestShapes:
    def test_a_tilted_plate_rises_as_its_angles_say_and_ends_below(self) -> None:
        scene = built(
            '[[piece]]\nkind = "plate"\nmaterial = "glass"\nx_mm = [-40.0, 40.0]\ny_mm = [-20.0, 20.0]\nz_mm = 30.0\n'
            "thickness_mm = 4.0\ntilt_deg = [10.0, -5.0]\n"
        )
        j, i = np.nonzero(scene.material == Material.GLASS)
        x_mm, y_mm = i - 119.5, j - 119.5
        rise = np.tan(np.radians([10.0, -5.0]))
        expected = 30 + rise[0] * x_mm + rise[1] * y_mm
        np.testing.assert_allclose(scene.front_mm[j, i], expected, atol=1e-9)
        np.testing.assert_allclose(scene.front_slope[j, i], np.tile(rise, (len(i), 1)), atol=1e-12)
        down_mm = 4.0 * np.sqrt(1 + rise @ rise)
        np.testing.assert_allclose(scene.underside_mm[j, i], expected - down_mm, atol=1e-9)
        assert np.all(scene.optical_mm == 0)
        assert len(i) == 80 * 40

    def test_a_ball_and_a_lying_cylinder_have_their_radii(self) -> None:
        scene = built('[[piece]]\nkind = "sphere"\nx_mm = 10.0\ny_mm = -5.0\nz_mm = 12.0\nradius_mm = 20.0\n')
        j, i = np.nonzero(scene.front_mm)
        away = np.hypot(i - 119.5 - 10.0, j - 119.5 + 5.0)
        assert away.max() < 20
        np.testing.assert_allclose(scene.front_mm[j, i], 12 + np.sqrt(400 - away**2), atol=1e-9)
        for along, axis in (("x", 0), ("y", 1)):
            text = '[[piece]]\nkind = "cylinder"\nx_mm = 0.0\ny_mm = 0.0\nradius_mm = 15.0\nlength_mm = 60.0\n'
            lying = built(f'{text}along = "{along}"\n').front_mm
            j, i = np.nonzero(lying)
            across = (j if axis == 0 else i) - 119.5
            np.testing.assert_allclose(lying[j, i], np.sqrt(225 - across**2), atol=1e-9)
            assert np.ptp(i if axis == 0 else j) == 59

    def test_a_stair_and_a_wedge_run_along_their_axis(self) -> None:
        stair = built(
            '[[piece]]\nkind = "stair"\nx_mm = [-10.0, 10.0]\ny_mm = [-20.0, 20.0]\n'
            'steps_mm = [3.0, 6.0]\nalong = "y"\n'
        )
        assert set(stair.front_mm[100:120, 110:130].ravel()) == {3.0}
        assert set(stair.front_mm[120:140, 110:130].ravel()) == {6.0}
        assert stair.front_slope is None
        wedge = built('[[piece]]\nkind = "wedge"\nx_mm = [-10.0, 10.0]\ny_mm = [-20.0, 20.0]\nz_mm = [0.0, 10.0]\n')
        np.testing.assert_allclose(wedge.front_mm[120, 110:130], 0.25 + 0.5 * np.arange(20))
        np.testing.assert_allclose(wedge.front_slope[120, 110:130, 0], 0.5)

    def test_a_hole_shows_what_was_there_before(self) -> None:
        scene = named("glass-hole")
        hole = scene.region_image == scene.regions.index("glass.holes")
        assert hole.sum() == pytest.approx(np.pi * 20**2, rel=0.02)
        assert set(scene.front_mm[hole]) == {0.0}
        assert set(scene.material[hole]) == {Material.MATTE}

    @pytest.mark.parametrize("kind", ["npz", "png"])
    def test_a_height_field_comes_from_a_file_beside_the_scene(self, kind: str, tmp_path: Path) -> None:
        levels = np.tile(np.arange(0, 40, 2), (30, 1)) + np.arange(30)[:, None]
        if kind == "npz":
            np.savez(tmp_path / "h.npz", height_mm=levels * 0.1)
            scale = ""
        else:
            cv2.imwrite(str(tmp_path / "h.png"), levels[::-1].astype(np.uint16))
            scale = "scale_mm = 0.1\n"
        text = f'name = "f"\n[[piece]]\nkind = "heights"\nfile = "h.{kind}"\ncorner_mm = [-10.0, -15.0]\n{scale}'
        (tmp_path / "f.toml").write_text(text)
        scene = named(str(tmp_path / "f.toml"))
        np.testing.assert_allclose(scene.front_mm[105:135, 110:130], levels * 0.1, atol=1e-9)
        np.testing.assert_allclose(scene.front_slope[110, 115], (0.2, 0.1), atol=1e-9)

    def test_a_plate_above_another_is_two_panes(self) -> None:
        scene = named("glass-two")
        pair = scene.region_image == scene.regions.index("pair")
        assert set(scene.panes[pair]) == {2}
        assert set(scene.glass_mm[pair]) == {6.0}
        assert set(scene.front_mm[pair]) == {40.0}


@pytest.mark.parametrize(
    ("text", "complaint"),
    [
        ('[[piece]]\nkind = "ball"\n', r"Invalid value 'ball' - at `\$\.piece\[0\]\.kind`"),
        (box().replace("z_mm = 5.0", 'z_mm = "high"'), r"Expected `float`, got `str` - at `\$\.piece\[0\]\.z_mm`"),
        (box().replace("z_mm = 5.0\n", ""), r"missing required field `z_mm` - at `\$\.piece\[0\]`"),
        (box("colour = 3\n"), r"unknown field `colour` - at `\$\.piece\[0\]`"),
        (box('material = "cheese"\n'), r"'cheese' - at `\$\.piece\[0\]\.material`"),
        (box() + box().replace("z_mm = 5.0", "z_mm = 2.0"), r"up to 3 mm below .* - at `\$\.piece\[1\]`"),
        (box().replace("-20.0, 20.0", "20.0, -20.0"), r"x_mm runs from 20 to -20 - at `\$\.piece\[0\]`"),
        (box().replace("-20.0, 20.0", "500.0, 600.0"), r"covers no cell .* - at `\$\.piece\[0\]`"),
        (box(EXPECT.format("c", "matte")), r"no region 'c'; known: elsewhere, b - at `\$\.expect\[0\]"),
        (box(EXPECT.format("b", "free")), r"'free' - at `\$\.expect\[0\]\.may\[0\]`"),
        (box(EXPECT.format("b", "matte") + "at_least = 2.0\n"), r"<= 1.0 - at `\$\.expect\[0\]\.at_least`"),
        ("[air]\nsmoke_per_m = -1.0\n", r">= 0.0 - at `\$\.air\.smoke_per_m`"),
        ('room = "green"\n', r"'green' - at `\$\.room`"),
        (HEIGHTS.format("no.npz"), r"no.npz: cannot read .* `\$\.piece\[0\]`"),
        (HEIGHTS.format("no.png"), r"no.png: expected finite .*piece\[0\]"),
        ("pieces = [\n", r"Invalid TOML|[Ii]nvalid|Unclosed|Expected"),
    ],
)
def test_a_wrong_file_is_refused_with_its_name_and_the_place_in_it(text: str, complaint: str, tmp_path: Path) -> None:
    path = tmp_path / "wrong.toml"
    path.write_text('name = "wrong"\n' + text)
    with pytest.raises(ConfigError, match=complaint) as refused:
        named(str(path))
    assert str(refused.value).startswith(str(path))


def test_a_missing_file_or_name_is_refused_with_what_there_is(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"no\.toml: cannot read the scene"):
        named(str(tmp_path / "no.toml"))
    with pytest.raises(ConfigError, match=r"unknown scene 'moon'; known: .*demo.*smoke.* or a scene file"):
        named("moon")


def test_the_page_says_of_every_scene_what_its_file_says() -> None:
    page = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text(encoding="utf-8")
    for name in scene_file.shipped_names():
        d = scene_file.shipped(name)
        assert f"| {name} | {d.about} | {d.light_sees} | {d.sound_hears} | {d.map_must_say} |" in page


def test_the_pages_example_is_a_scene() -> None:
    page = (Path(__file__).parents[2] / "docs" / "scenes.md").read_text(encoding="utf-8")
    example = page.split("```toml\n")[1].split("```")[0]
    scene = scene_file.build(scene_file.parse(example, "scenes.md"), "scenes.md")
    assert scene.regions == ("elsewhere", "ball", "glass", "glass.holes")
    for kind in ("box", "plate", "stair", "wedge", "cylinder", "sphere", "heights"):
        assert f"| `{kind}` |" in page
