"""The rim of a plate as light sees it."""

from __future__ import annotations

from typing import cast

import numpy as np
import pytest
from numpy.typing import NDArray

from echolume_messages.plan import MapField
from echolume_processing.hybrid.plates import Plane
from echolume_processing.hybrid.rims import LitRim, lit_rim
from echolume_processing.hybrid.scipy_typed import Mask
from echolume_processing.hybrid.sounding import Sounding
from echolume_processing.hybrid.state import State
from echolume_processing.hybrid.surface import surface

FIELD = MapField(x_mm=(0.0, 60.0), y_mm=(0.0, 60.0), cell_mm=1.0)
PLATE = Plane(30.0, 30.0, 25.0)


class Silent(State):
    """A state that nobody listens to."""

    def with_heights(self, height_mm: NDArray[np.float64], changed: Mask) -> State:
        """The other heights, without echoes."""
        return Silent(self.found, surface(height_mm, self.scene.field), self.predicted)


def believed(height_mm: NDArray[np.float64]) -> State:
    return Silent(cast("Sounding", None), surface(height_mm, FIELD), np.zeros((0, 1, 1), dtype=np.complex64))


def plate() -> Mask:
    mask = np.zeros(FIELD.shape, dtype=np.bool_)
    mask[15:45, 15:45] = True
    return mask


def test_a_line_at_the_height_of_the_plate_is_its_rim_and_ground_below() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[15:45, 15] = 25.2
    rim = lit_rim(believed(height_mm), plate(), PLATE, np.ones(FIELD.shape, dtype=np.bool_))
    assert rim.lit.sum() == 30
    assert rim.lit[15:45, 15].all()
    assert (rim.state.scene.height_mm == 0.0).all()


def test_a_surface_as_high_as_the_plate_is_no_rim() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[:, 47:] = 25.0
    rim = lit_rim(believed(height_mm), plate(), PLATE, np.ones(FIELD.shape, dtype=np.bool_))
    assert not rim.lit.any()


def test_ground_that_is_seen_aslant_through_the_plate_goes_down_to_that_beside_it() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[13:47, 15:45] = 1.5
    rim = lit_rim(believed(height_mm), plate(), PLATE, np.ones(FIELD.shape, dtype=np.bool_))
    assert rim.bent[13:15, 20:40].all()
    assert (rim.state.scene.height_mm[13:15] == 0.0).all()
    assert (rim.state.scene.height_mm[25:35, 25:35] == 1.5).all()


def test_a_low_step_beside_a_plate_stays() -> None:
    height_mm = np.zeros(FIELD.shape)
    height_mm[11:14, 15:45] = 3.0
    rim = lit_rim(believed(height_mm), plate(), PLATE, np.ones(FIELD.shape, dtype=np.bool_))
    assert not rim.bent.any()
    assert (rim.state.scene.height_mm == height_mm).all()


@pytest.mark.parametrize(("share", "cut"), [(0.7, 0.7), (1.0, 0.9), (0.1, 0.3)])
def test_the_outline_is_cut_where_light_sees_the_rim(share: float, cut: float) -> None:
    lit = np.zeros(FIELD.shape, dtype=np.bool_)
    state = believed(np.zeros(FIELD.shape))
    assert LitRim(lit, lit, state).share_at(np.full(FIELD.shape, share)) == 0.5
    lit[10:40, 20] = True
    assert LitRim(lit, lit, state).share_at(np.full(FIELD.shape, share)) == pytest.approx(cut)
