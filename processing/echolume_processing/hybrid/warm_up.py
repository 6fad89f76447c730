"""Compiles or loads the fusion's kernels ahead of the first scan."""

from __future__ import annotations

import numpy as np

from echolume_messages.plan import MapField
from echolume_processing.hybrid import cell_kernels, tile_kernels
from echolume_processing.hybrid.predict import Aperture, Band, Predictor
from echolume_processing.hybrid.surface import WALL_MM, surface


def warm_up() -> None:
    """Predict one ping over a small step, lay one tile, sort one point: after this, `fuse` compiles nothing more."""
    field = MapField(x_mm=(-8.0, 8.0), y_mm=(-8.0, 8.0), cell_mm=1.0)
    height_mm = np.zeros(field.shape)
    height_mm[:, 8:] = 2 * WALL_MM
    where = Aperture(np.array([[0.0, 0.0, 150.0], [15.0, 0.0, 150.0]]), np.array([0.0, 0.0, -1.0]))
    predictor = Predictor(6.0, 343.0, Band(250e3, 512, 30e3, 60e3))
    predictor.spectra(surface(height_mm, field), where)
    tile_kernels.warm_up()
    cell_kernels.warm_up()
