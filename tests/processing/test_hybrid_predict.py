"""The echo predictor against closed forms."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from echolume_messages.plan import MapField
from echolume_processing.hybrid.predict import Aperture, Band, Predictor
from echolume_processing.hybrid.surface import AZIMUTHS, reshaped, surface

FIELD = MapField(x_mm=(-120.0, 120.0), y_mm=(-120.0, 120.0), cell_mm=1.0)
BAND = Band(250e3, 1024, 28e3, 63e3)
SPEED_MPS = 343.2
RECEIVERS = [(x, y) for y in (-15.0, 0.0, 15.0) for x in (-15.0, 0.0, 15.0) if (x, y) != (0.0, 0.0)]


def looking_down(z_mm: float) -> Aperture:
    elements = np.array([(0.0, 0.0, z_mm), *((x, y, z_mm) for x, y in RECEIVERS)])
    return Aperture(elements, np.array([0.0, 0.0, -1.0]))


@pytest.mark.parametrize("height_mm", [110.0, 150.0])
def test_a_plate_returns_the_echo_of_the_emitters_image(height_mm: float) -> None:
    predicted = Predictor(0.01, SPEED_MPS, BAND).spectra(surface(np.zeros(FIELD.shape), FIELD), looking_down(height_mm))
    path_mm = np.hypot(2 * height_mm, np.linalg.norm(RECEIVERS, axis=1))[:, None]
    image = np.exp(-2j * np.pi * BAND.frequency_hz * path_mm / (SPEED_MPS * 1e3)) / path_mm
    residual = np.sum(np.abs(predicted - image) ** 2) / np.sum(np.abs(image) ** 2)
    assert 10 * np.log10(residual) < -20


def test_a_step_of_a_quarter_wavelength_turns_the_echo_around() -> None:
    predictor = Predictor(6.2, SPEED_MPS, BAND)
    low = predictor.spectra(surface(np.zeros(FIELD.shape), FIELD), looking_down(150.0))
    quarter_mm = 1e3 * SPEED_MPS / 45e3 / 4
    high = predictor.spectra(surface(np.full(FIELD.shape, quarter_mm), FIELD), looking_down(150.0))
    at = int(np.argmin(np.abs(BAND.frequency_hz - 45e3)))
    np.testing.assert_allclose(np.abs(np.angle(high[:, at] / low[:, at])), np.pi, atol=0.05)


def test_a_wall_and_its_floor_return_what_neither_does_alone() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[:, 160:] = 30.0  # wall at x = 40 that faces the array
    scene = surface(height_mm, FIELD)
    predictor = Predictor(6.2, SPEED_MPS, BAND)
    both = predictor.spectra(scene, looking_down(150.0))
    without = predictor.spectra(replace(scene, walls=scene.walls[:0]), looking_down(150.0))
    share = np.sum(np.abs(both - without) ** 2) / np.sum(np.abs(both) ** 2)
    assert 0.01 < share < 1.0


def test_what_stands_high_shadows_what_lies_behind_it() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[:, 150:153] = 40.0
    scene = surface(height_mm, FIELD)
    west = AZIMUTHS // 2
    assert scene.horizon[120, 160, west] == pytest.approx(40.0 / 7.5, rel=0.1)
    assert scene.horizon[120, 160, 0] == 0.0


def test_a_reshaped_surface_is_the_same_as_one_made_anew() -> None:
    rng = np.random.default_rng(4)
    before = np.where(rng.random(FIELD.shape) < 0.001, 20.0, 0.0)
    after = before.copy()
    after[100:130, 90:125] = 30.0
    anew, changed = surface(after, FIELD), reshaped(surface(before, FIELD), after)
    np.testing.assert_array_equal(anew.horizon, changed.horizon)
    np.testing.assert_array_equal(anew.walls, changed.walls)
    np.testing.assert_array_equal(anew.slope, changed.slope)


def test_a_surface_with_a_hole_is_refused() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[3, 4] = np.nan
    with pytest.raises(ValueError, match="finite heights"):
        surface(height_mm, FIELD)
