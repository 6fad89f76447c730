"""Smooth bent surfaces: from the ways of pings to arcs, and to a map."""

from __future__ import annotations

from dataclasses import dataclass
from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from echolume_drivers.emulated import scene_file
from echolume_messages.types import Label
from echolume_processing.hybrid.arcs import STEEPEST_SINE, Arc
from echolume_processing.hybrid.curved import curved_seed, first_height_mm
from echolume_processing.hybrid.fuse import fuse
from echolume_processing.hybrid.heard import Heard
from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.predict import Aperture
from echolume_processing.hybrid.sounding import Sounding
from processing.hybrid_scan import FIELD, small_scan
from processing.test_hybrid_fuse import cut

DOWN = np.array([0.0, 0.0, -1.0])
RECEIVERS_MM = np.array([(15.0 * i, 15.0 * j, 0.0) for i in (-1, 0, 1) for j in (-1, 0, 1) if (i, j) != (0, 0)])
bends = st.floats(-0.04, 0.0)
slopes = st.floats(-0.2, 0.2)


@dataclass(frozen=True)
class Ball:
    """A ball, and the paths over it by Fermat's principle, from a fine raster of its surface."""

    radius_mm: float
    top_mm: float

    def path_mm(self, emitter_mm: np.ndarray, receivers_mm: np.ndarray) -> np.ndarray:
        x, y = np.meshgrid(np.linspace(-13, 13, 521), np.linspace(-13, 13, 521))
        z = self.top_mm - self.radius_mm + np.sqrt(self.radius_mm**2 - x**2 - y**2)
        places = np.column_stack((x.ravel(), y.ravel(), z.ravel()))
        there = np.linalg.norm(places - emitter_mm, axis=1)
        return np.array([(there + np.linalg.norm(places - r, axis=1)).min() for r in receivers_mm])


class Trough(Ball):
    """Half a pipe lying along y."""

    def path_mm(self, emitter_mm: np.ndarray, receivers_mm: np.ndarray) -> np.ndarray:
        x, y = np.meshgrid(np.linspace(-15, 15, 601), np.linspace(-30, 30, 301))
        z = self.top_mm - self.radius_mm + np.sqrt(self.radius_mm**2 - x**2)
        places = np.column_stack((x.ravel(), y.ravel(), z.ravel()))
        there = np.linalg.norm(places - emitter_mm, axis=1)
        return np.array([(there + np.linalg.norm(places - r, axis=1)).min() for r in receivers_mm])


class Point(Ball):
    """What is no larger than a point returns every ping from there."""

    def path_mm(self, emitter_mm: np.ndarray, receivers_mm: np.ndarray) -> np.ndarray:
        place = np.array([0.0, 0.0, self.top_mm])
        return np.linalg.norm(emitter_mm - place) + np.linalg.norm(receivers_mm - place, axis=1)


def pings_over(ball: Ball, noise_mm: float) -> tuple[Sounding, Heard]:
    """Pings every 10 mm over a ball, 150 mm up."""
    rng = np.random.default_rng(1)
    centres = [np.array([x, y, 150.0]) for x in range(-20, 21, 10) for y in range(-20, 21, 10)]
    apertures = tuple(Aperture(np.vstack((c, c + RECEIVERS_MM)), DOWN) for c in centres)
    paths = np.array([ball.path_mm(c, c + RECEIVERS_MM) for c in centres])
    nowhere = np.full((len(centres), 3), np.nan)
    found = cast("Sounding", SimpleNamespace(apertures=apertures))
    return found, Heard(nowhere, nowhere, paths + noise_mm * rng.normal(size=paths.shape))


@given(slopes, slopes, bends, bends, st.floats(-40, 40), st.floats(-40, 40))
@example(0.0, 0.0, 0.0, -2.2e-311, 0.0, 0.0)
def test_the_nearest_place_stands_upright_below_its_point(
    sx: float, sy: float, xx: float, yy: float, x_mm: float, y_mm: float
) -> None:
    surface = Plane(0.0, 0.0, 20.0, sx, sy, xx, 0.3 * float(np.sqrt(xx * yy)), yy)
    centre = np.array([[x_mm, y_mm, 150.0]])
    x, y = surface.mirror_points(centre).T
    normal = np.array([*(-s[0] for s in surface.slope_at(x, y)), 1.0])
    ray = centre[0] - np.array([x[0], y[0], surface.at(x, y)[0]])
    assert np.linalg.norm(np.cross(normal, ray)) / np.linalg.norm(ray) < 1e-3


@pytest.mark.parametrize("radius_mm", [12.0, 20.0, 30.0])
@pytest.mark.parametrize("aside_mm", [60.0, 110.0, 160.0])
def test_the_nearest_place_is_found_from_far_aside(radius_mm: float, aside_mm: float) -> None:
    pipe = Plane(0.0, 0.0, 30.0, 0.0, 0.0, -1 / radius_mm)
    ray = np.array([aside_mm, 150.0 - (30.0 - radius_mm)])
    foot_mm = radius_mm * ray[0] / np.hypot(*ray)
    (x, y) = pipe.mirror_points(np.array([[aside_mm, 7.0, 150.0]]))[0]
    assert x == pytest.approx(foot_mm, abs=0.01)
    assert y == pytest.approx(7.0, abs=1e-6)


def test_a_plane_without_a_bend_is_the_plane_of_before() -> None:
    flat, centre = Plane(1.0, 2.0, 30.0, 0.1, -0.2), np.array([[10.0, -5.0, 150.0], [0.0, 40.0, 149.0]])
    nearly = Plane(1.0, 2.0, 30.0, 0.1, -0.2, -1e-12)
    assert not flat.bent
    assert nearly.bent
    np.testing.assert_allclose(flat.mirror_points(centre), nearly.mirror_points(centre), atol=1e-6)


@pytest.mark.parametrize("radius_mm", [20.0, 40.0])
def test_a_ball_is_recovered_from_the_paths_over_it(radius_mm: float) -> None:
    found, spoken = pings_over(Ball(radius_mm, 25.0), 0.03)
    seed = curved_seed(found, spoken, np.arange(25))
    assert seed is not None
    assert seed.which.size == 25
    assert abs(float(seed.plane.at(np.zeros(1), np.zeros(1))[0]) - 25.0) < 0.1
    for bend in (seed.plane.bend_xx, seed.plane.bend_yy):
        assert bend == pytest.approx(-1 / radius_mm, rel=0.12)
    assert np.abs(first_height_mm(found, spoken) - 25.0).max() < 3.5


def test_a_pipe_is_known_further_out_than_pings_met_it() -> None:
    found, spoken = pings_over(Trough(30.0, 30.0), 0.02)
    seed = curved_seed(found, spoken, np.arange(25))
    assert seed is not None
    assert np.abs(seed.place_mm[:, 0]).max() < 8
    x_mm = np.arange(-25.0, 26.0)
    true_mm = np.sqrt(30.0**2 - x_mm**2)
    assert np.abs(seed.plane.at(x_mm, np.zeros_like(x_mm)) - true_mm).max() < 1.5
    parabola_mm = 30.0 - x_mm**2 / 60.0
    assert np.abs(parabola_mm - true_mm).max() > 2.5


@given(st.floats(-0.6, 0.6), st.floats(-0.05, 0.05), st.floats(-15, 15))
def test_an_arc_is_part_of_a_circle(slope: float, bend: float, along_mm: float) -> None:
    arc = Arc(slope, bend)
    height_mm, steep, bent = (float(v[0]) for v in arc.at(np.array([along_mm])))
    if abs(bend) < 1e-9:
        assert height_mm == pytest.approx(slope * along_mm, abs=1e-5)
        return
    cosine = 1 / np.hypot(1, slope)
    radius_mm = 1 / (bend * cosine**3)
    middle = np.array([-slope * cosine * radius_mm, cosine * radius_mm])
    here = np.array([along_mm, height_mm]) - middle
    if abs(slope * cosine + along_mm / radius_mm) < STEEPEST_SINE:
        exact_mm = middle[1] - np.sign(bend) * np.sqrt(radius_mm**2 - (along_mm - middle[0]) ** 2)
        assert np.hypot(*here) == pytest.approx(abs(radius_mm), rel=1e-6)
        assert height_mm == pytest.approx(exact_mm, abs=1e-6 + 1e-13 * radius_mm**2)
        assert here[0] + here[1] * steep == pytest.approx(0, abs=1e-5 * abs(radius_mm))
        assert np.sign(bent) == np.sign(bend)
    else:
        assert bent == 0


def test_the_echo_of_a_corner_is_no_bent_surface() -> None:
    found, spoken = pings_over(Point(0.0, 25.0), 0.03)
    assert curved_seed(found, spoken, np.arange(25)) is None


def test_half_a_bottle_is_transparent_at_its_own_heights() -> None:
    text = """
        name = "shell"
        [[piece]]
        kind = "cylinder"
        material = "glass"
        x_mm = 0.0
        y_mm = 0.0
        radius_mm = 28.0
        length_mm = 70.0
        along = "y"
        thickness_mm = 3.0
    """
    scan = small_scan(scene_file.build(scene_file.parse(text)), pitch_mm=10.0)
    found = fuse(scan.optical, scan.pings, scan.calibration, FIELD)
    named = found.image("label") == Label.TRANSPARENT
    y, x = np.mgrid[-47.5:48.0, -47.5:48.0]
    crest = (np.abs(x) < 9) & (np.abs(y) < 30)
    assert named[crest].mean() > 0.95
    assert np.abs(found.image("front_mm") - cut(scan.scene.front_mm))[crest & named].max() < 1.0
    assert not named[(np.abs(x) > 34) | (np.abs(y) > 41)].any()
