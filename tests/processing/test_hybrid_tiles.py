"""Tiles over a mask, and the mask that their occupancies give back."""

from __future__ import annotations

import numpy as np

from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.tiles import covered, tiles_over, without_pinholes


def test_occupancies_of_tiles_give_the_mask_back() -> None:
    mask = np.zeros((80, 90), dtype=np.bool_)
    mask[20:50, 15:70] = True
    tiles = tiles_over(np.ones_like(mask))
    share = tiles.mean(mask)[tiles.grid >= 0]
    again = covered(share, tiles, mask.shape, 1.0)
    assert (again != mask).sum() <= 12  # three cells a corner


def test_a_hole_in_a_plate_stays_a_hole() -> None:
    mask = np.zeros((60, 60), dtype=np.bool_)
    mask[10:50, 10:50] = True
    mask[22:38, 22:38] = False
    tiles = tiles_over(np.ones_like(mask))
    again = covered(tiles.mean(mask)[tiles.grid >= 0], tiles, mask.shape, 1.0)
    assert not again[26:34, 26:34].any()


def test_pinholes_are_closed_and_real_holes_are_not() -> None:
    mask = np.ones((40, 40), dtype=np.bool_)
    mask[5:9, 5:9] = False
    mask[20:32, 20:32] = False
    closed = without_pinholes(mask, 1.0)
    assert closed[5:9, 5:9].all()
    assert not closed[20:32, 20:32].any()


def test_the_mirror_point_of_a_tilted_plane_lies_uphill_of_the_array() -> None:
    plane = Plane(0.0, 0.0, 30.0, 0.2, 0.0)
    centre = np.array([[10.0, 5.0, 150.0]])
    ((x, y),) = plane.mirror_points(centre)
    z = plane.at(np.array([x]), np.array([y]))[0]
    across = centre[0] - (x, y, z)
    assert x > 10.0
    assert abs(across @ (1.0, 0.0, 0.2)) < 1e-9  # perpendicular to the plane
    assert abs(across @ (0.0, 1.0, 0.0)) < 1e-9
