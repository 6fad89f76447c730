"""Planes, points, edges, corners, cylinders and spheres across poses: recovered, honest, and told apart by motion."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_messages.geometry import rotation_from_vector, transform
from echolume_processing.ultrasonic.primitives import Primitive, SurfaceKind, over_circle
from echolume_processing.ultrasonic.surface_fit import scan_of
from echolume_processing.ultrasonic.surfaces import classify, motions, separating_motions

GRID = np.array([(x, y, 0.0) for y in (-1, 0, 1) for x in (-1, 0, 1) if (x, y) != (0, 0)]) * 37.5
SIGMA_MM = 0.05
EVERY = [kind for kind in SurfaceKind if kind]


def poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """Array poses some 200 mm above, looking down, (count, 4, 4)."""
    down = rotation_from_vector(np.array([np.pi, 0, 0]))
    return np.array(
        [
            transform(
                down @ rotation_from_vector(np.array([*rng.normal(0, 0.1, 2), rng.normal()])),
                np.array([*rng.uniform(-40, 40, 2), rng.uniform(180, 250)]),
            )
            for _ in range(count)
        ]
    )


def primitive(kind: SurfaceKind, rng: np.random.Generator) -> Primitive:
    if kind == SurfaceKind.PLANE:
        normal = np.array([*rng.normal(0, 0.1, 2), 1.0])
        return Primitive(kind, np.zeros(3), normal / np.linalg.norm(normal))
    position, radius = rng.uniform(-10, 10, 3), float(rng.uniform(20, 60))
    if kind in (SurfaceKind.POINT, SurfaceKind.SPHERE):
        return Primitive(kind, position, np.zeros(3), radius if kind == SurfaceKind.SPHERE else 0.0)
    turn = rng.uniform(0, np.pi)
    along = np.array([np.cos(turn), np.sin(turn), rng.normal(0, 0.1)])
    return Primitive(kind, position, along / np.linalg.norm(along), radius if kind == SurfaceKind.CYLINDER else 0.0)


def paths(truth: Primitive, at: np.ndarray, rng: np.random.Generator | None = None) -> tuple[np.ndarray, np.ndarray]:
    """Paths and their sigmas, (poses, 8)."""
    ones = np.ones((len(at), len(GRID)))
    rows = scan_of(at, GRID, ones, ones)
    out = truth.paths_mm(rows.emitter_mm, rows.receiver_mm).reshape(ones.shape)
    return out + (0.0 if rng is None else rng.normal(0, SIGMA_MM, ones.shape)), SIGMA_MM * ones


def shortest(a: np.ndarray, b: np.ndarray, on: np.ndarray) -> float:
    """By trying: the shortest way from a to b over the points."""
    return float((np.linalg.norm(on - a, axis=1) + np.linalg.norm(on - b, axis=1)).min())


def test_paths_over_an_edge_and_a_cylinder_are_the_shortest_ways():
    a, b = np.array([10.0, -30.0, 200.0]), np.array([40.0, 20.0, 190.0])
    z, turn = np.meshgrid(np.linspace(-60, 60, 2401), np.linspace(-0.6, 0.6, 601))
    edge = np.column_stack([z[0], 0 * z[0], 0 * z[0]])
    skin = np.column_stack([z.ravel(), 30 * np.sin(turn).ravel(), 30 * np.cos(turn).ravel()])
    along = np.array([1.0, 0.0, 0.0])
    for kind, radius, on in ((SurfaceKind.EDGE, 0.0, edge), (SurfaceKind.CYLINDER, 30.0, skin)):
        found = Primitive(kind, np.zeros(3), along, radius).paths_mm(a[None], b[None])[0]
        assert found == pytest.approx(shortest(a, b, on), abs=1e-3)


def test_the_path_over_a_sphere_is_the_shortest_way():
    a, b = np.array([10.0, -30.0, 200.0]), np.array([40.0, 20.0, 190.0])
    x, y = (v.ravel() for v in np.meshgrid(np.linspace(-15, 15, 1201), np.linspace(-15, 15, 1201)))
    skin = np.column_stack([x, y, np.sqrt(50.0**2 - x**2 - y**2)])
    assert over_circle(a[None], b[None], 50.0)[0] == pytest.approx(shortest(a, b, skin), abs=1e-3)


def test_the_path_in_a_corner_is_that_of_two_reflections():
    a, b = np.array([10.0, -30.0, 200.0]), np.array([40.0, 20.0, 190.0])
    image = a * [1, -1, -1]  # in the planes y = 0 and z = 0, one after the other
    found = Primitive(SurfaceKind.CORNER, np.zeros(3), np.array([1.0, 0, 0])).paths_mm(a[None], b[None])[0]
    assert found == pytest.approx(np.linalg.norm(image - b))


@given(st.floats(0, 1.0), st.floats(100, 400), st.floats(100, 400))
def test_a_vast_sphere_is_a_plane_and_one_of_no_radius_a_point(angle: float, a_mm: float, b_mm: float):
    radius = 1e6
    a, b = np.array([[0.0, 0.0, a_mm]]), np.array([[200 * np.sin(angle), 0.0, b_mm]])
    up = np.array([0.0, 0.0, radius])
    plane = Primitive(SurfaceKind.PLANE, np.zeros(3), np.array([0.0, 0.0, 1.0])).paths_mm(a, b)
    assert over_circle(a + up, b + up, radius)[0] == pytest.approx(plane[0], abs=0.1)
    point = Primitive(SurfaceKind.POINT, np.zeros(3), np.zeros(3)).paths_mm(a, b)
    assert over_circle(a, b, 0.0)[0] == pytest.approx(point[0])


@pytest.mark.parametrize("kind", EVERY)
def test_five_poses_tell_every_kind_and_recover_it(kind: SurfaceKind):
    rng = np.random.default_rng(kind)
    at, truth = poses(rng, 5), primitive(kind, rng)
    found = classify(at, GRID, *paths(truth, at, rng))
    assert found.kind == kind
    assert not found.ambiguous
    assert found.best.determined
    clean = classify(at, GRID, *paths(truth, at)).best.primitive
    seen = paths(clean, at)[0] - paths(truth, at)[0]
    assert np.abs(seen).max() < 1e-4
    assert clean.radius_mm == pytest.approx(truth.radius_mm, abs=1e-2)


def test_one_pose_cannot_tell_a_plane_from_a_corner_and_says_so():
    rng = np.random.default_rng(1)
    at = poses(rng, 1)
    for kind, other in ((SurfaceKind.PLANE, SurfaceKind.CORNER), (SurfaceKind.CORNER, SurfaceKind.CORNER)):
        found = classify(at, GRID, *paths(primitive(kind, rng), at, rng))
        assert (found.kind, found.rivals) == (SurfaceKind.PLANE, (other,))
        assert not found.fits[SurfaceKind.CORNER].determined  # it may turn about the way to it


def test_a_step_across_its_line_tells_a_corner_from_a_plane_and_a_step_along_does_not():
    rng = np.random.default_rng(2)
    truth = Primitive(SurfaceKind.CORNER, np.zeros(3), np.array([0.0, 1.0, 0.0]))
    first = transform(rotation_from_vector(np.array([np.pi, 0, 0])), np.array([0.0, 0.0, 200.0]))
    for step, kind in ((np.array([20.0, 0, 0]), SurfaceKind.CORNER), (np.array([0, 20.0, 0]), SurfaceKind.PLANE)):
        at = np.array([first, first @ transform(np.eye(3), step)])
        found = classify(at, GRID, *paths(truth, at, rng))
        assert found.kind == kind
        assert found.ambiguous == (kind == SurfaceKind.PLANE)


def test_over_a_plane_two_poses_leave_the_corner_through_both_feet_and_three_do_not():
    rng = np.random.default_rng(3)
    truth, at = primitive(SurfaceKind.PLANE, rng), poses(rng, 3)
    measured = paths(truth, at, rng)
    two = classify(at[:2], GRID, measured[0][:2], measured[1][:2])
    assert (two.kind, two.rivals) == (SurfaceKind.PLANE, (SurfaceKind.CORNER,))
    assert classify(at, GRID, *measured).rivals == ()


def test_the_motion_that_would_tell_is_two_steps_across_and_no_turn():
    rng = np.random.default_rng(4)
    at = poses(rng, 1)
    found = classify(at, GRID, *paths(primitive(SurfaceKind.PLANE, rng), at, rng))
    told = {
        m.name: m.sigmas
        for m in separating_motions(
            found, SurfaceKind.CORNER, at, GRID, np.full(8, SIGMA_MM), motions(step_mm=20.0, turn_rad=0.1)
        )
    }
    assert next(iter(told)) == "steps x and y"
    assert told["steps x and y"] > 10
    assert max(told[name] for name in ("turn x", "turn y", "step z")) < 3


@settings(max_examples=8, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([SurfaceKind.PLANE, SurfaceKind.EDGE, SurfaceKind.POINT]))
def test_a_rigid_motion_of_everything_moves_the_answer(seed: int, kind: SurfaceKind):
    rng = np.random.default_rng(seed)
    at, truth = poses(rng, 4), primitive(kind, rng)
    measured = paths(truth, at, rng)
    moved = transform(rotation_from_vector(rng.normal(size=3)), rng.normal(0, 100, 3))
    here = classify(at, GRID, *measured, kinds=[kind]).best
    there = classify(moved @ at, GRID, *measured, kinds=[kind]).best
    assert there.chi_squared == pytest.approx(here.chi_squared, rel=1e-6)
    assert abs(there.primitive.direction @ moved[:3, :3] @ here.primitive.direction) == pytest.approx(
        float(here.primitive.direction.any()), abs=1e-6
    )


def test_the_covariance_of_a_point_across_poses_is_honest():
    rng = np.random.default_rng(5)
    squares = []
    for _ in range(60):
        at, truth = poses(rng, 3), primitive(SurfaceKind.POINT, rng)
        found = classify(at, GRID, *paths(truth, at, rng), kinds=[SurfaceKind.POINT]).best
        off = found.primitive.position_mm - truth.position_mm
        squares.append(off @ np.linalg.solve(found.position_covariance, off) / 3)
    assert np.mean(squares) == pytest.approx(1, abs=0.25)


def test_paths_of_no_primitive_are_none_of_them():
    rng = np.random.default_rng(6)
    at = poses(rng, 3)
    found = classify(at, GRID, rng.uniform(380, 420, (3, 8)), np.full((3, 8), SIGMA_MM))
    assert found.kind == SurfaceKind.NONE
    with pytest.raises(ValueError, match="no primitive"):
        _ = found.best
