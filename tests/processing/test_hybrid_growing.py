"""The growing map: at any time what all of its evidence gives at once, whatever came first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_messages.plan import MapField
from echolume_messages.types import OPTICAL_POINT, OpticalSource
from echolume_processing.hybrid import fuse as fusing
from echolume_processing.hybrid.digest import digest
from echolume_processing.hybrid.fuse import fuse
from echolume_processing.hybrid.grid import OpticalGrid, accumulate
from echolume_processing.hybrid.growing import GrowingMap
from echolume_processing.hybrid.light_cells import IMAGES, LightCells
from echolume_processing.hybrid.rules.registry import fuse_by
from echolume_processing.ping import Ping
from echolume_processing.ultrasonic.pipeline import UltrasonicPipeline
from processing.hybrid_scan import FIELD, SmallScan, glass_and_black, small_scan, stripes

EVERY = 3
"""Of the small scan's pings."""
TENTHS = MapField(x_mm=(-2.0, 3.1), y_mm=(0.0, 2.0), cell_mm=0.3)


@pytest.fixture(scope="module")
def scan() -> SmallScan:
    whole = small_scan(glass_and_black())
    return replace(whole, pings=whole.pings[::EVERY])


@pytest.fixture(scope="module")
def at_once(scan: SmallScan) -> str:
    optical, triggers = numbered(stripes(scan.optical))
    return digest(fuse(optical, scan.pings, scan.calibration, FIELD, triggers))


def numbered(parts: dict[int, np.ndarray]) -> tuple[np.ndarray, np.ndarray]:
    """Points of all stripes, and the trigger of each."""
    triggers = np.repeat(np.array(list(parts), dtype=np.uint32), [part.size for part in parts.values()])
    return np.concatenate(list(parts.values())), triggers


def gate_of(scan: SmallScan, light: dict[int, np.ndarray], pings: list[Ping]) -> str:
    """Digest of the footprint gate's map of all of some evidence."""
    pipeline = UltrasonicPipeline(scan.calibration)
    optical, stripe = numbered(light)
    points, ping = numbered({p.trigger: pipeline.process(p) for p in pings})
    return digest(fuse_by("footprint-gate", optical, points, pings, scan.calibration, FIELD, stripe, ping))


def test_light_first_then_sound_as_on_the_rig(scan: SmallScan, at_once: str, monkeypatch: pytest.MonkeyPatch) -> None:
    grown = GrowingMap(scan.calibration, FIELD)
    for trigger, points in stripes(scan.optical).items():
        grown.add_stripe(trigger, points)
    assert not grown.settled
    grown.settle()
    for ping in scan.pings:
        grown.add_ping(ping)
    monkeypatch.setattr(
        fusing.Sounding, "predict", _predict_less(len(scan.pings), fusing.Sounding.predict)
    )  # what was predicted ahead is not predicted again
    assert digest(grown.finish()) == at_once


def _predict_less(whole: int, predict: object) -> object:
    seen: list[int] = []

    def guarded(self: object, scene: object, which: np.ndarray) -> object:
        if not seen:
            assert len(which) < whole, "all echoes were predicted again"
        seen.append(len(which))
        return predict(self, scene, which)  # pyright: ignore[reportCallIssue]

    return guarded


@pytest.mark.parametrize("seed", [1, 2])
def test_any_order_of_arrival_gives_the_same_bits(scan: SmallScan, at_once: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    parts: list[tuple[int, np.ndarray] | Ping] = [*stripes(scan.optical).items(), *scan.pings]
    grown = GrowingMap(scan.calibration, FIELD)
    for n, k in enumerate(rng.permutation(len(parts))):
        part = parts[k]
        if isinstance(part, Ping):
            grown.add_ping(part)
        else:
            grown.add_stripe(part[0], rng.permutation(part[1]))
        if n == len(parts) // 2:
            grown.settle()  # too early: stripes are still to come
    assert digest(grown.finish()) == at_once


def test_at_any_time_the_live_map_is_the_gate_of_what_came(scan: SmallScan) -> None:
    grown, light, pings = GrowingMap(scan.calibration, FIELD), dict[int, np.ndarray](), list[Ping]()
    beams = iter(scan.pings)
    maps = set[str]()
    for n, (trigger, points) in enumerate(stripes(scan.optical).items()):
        grown.add_stripe(trigger, points)
        light[trigger] = points
        if n % 4 == 0 and (ping := next(beams, None)) is not None:
            grown.add_ping(ping)
            pings.append(ping)
        if n % 15 == 14:
            found = digest(grown.live())
            assert found == gate_of(scan, light, pings)
            maps.add(found)
    assert len(maps) >= 3


def test_of_a_trigger_that_comes_twice_the_later_counts(scan: SmallScan) -> None:
    optical, pings = stripes(scan.optical), scan.pings[:6]
    first, other, *_ = optical
    grown, plain = GrowingMap(scan.calibration, FIELD), GrowingMap(scan.calibration, FIELD)
    grown.add_stripe(first, optical[other])
    grown.add_ping(replace(pings[1], trigger=pings[0].trigger))
    for each in (grown, plain):
        for trigger, points in optical.items():
            each.add_stripe(trigger, points)
        for ping in pings:
            each.add_ping(ping)
    assert digest(grown.live()) == digest(plain.live())
    assert digest(grown.finish()) == digest(plain.finish())


def test_with_nothing_at_all_every_cell_is_unknown(scan: SmallScan) -> None:
    grown = GrowingMap(scan.calibration, FIELD)
    grown.settle()
    assert not grown.settled
    for found in (grown.live(), grown.finish()):
        assert np.isnan(found.cells["front_mm"]).all()


def test_pings_of_two_settings_are_refused_as_they_are_at_once(scan: SmallScan) -> None:
    grown = GrowingMap(scan.calibration, FIELD)
    for trigger, points in stripes(scan.optical).items():
        grown.add_stripe(trigger, points)
    short = replace(scan.pings[1], echoes=scan.pings[1].echoes[:, :-8])
    for ping in (scan.pings[0], short):
        grown.add_ping(ping)
    with pytest.raises(ValueError, match="one length and sample rate"):
        grown.finish()


def same(one: OpticalGrid, other: OpticalGrid) -> None:
    for name in IMAGES:
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), name)
    for name in ("start", "which"):
        np.testing.assert_array_equal(getattr(one.stripes, name), getattr(other.stripes, name), name)


@settings(max_examples=60, deadline=None)
@given(
    arrivals=st.lists(
        st.tuples(
            st.integers(0, 4),
            st.lists(
                st.tuples(st.floats(-3, 4), st.floats(-1, 3), st.integers(-40, 40), st.sampled_from(OpticalSource)),
                max_size=12,
            ),
        ),
        max_size=10,
    )
)
def test_cells_stripe_by_stripe_are_those_of_all_stripes(
    arrivals: list[tuple[int, list[tuple[float, float, int, OpticalSource]]]],
) -> None:
    cells, kept = LightCells(TENTHS), dict[int, np.ndarray]()
    for trigger, rows in arrivals:
        points = np.zeros(len(rows), dtype=OPTICAL_POINT)
        for k, (x_mm, y_mm, steps, source) in enumerate(rows):
            points[k] = (x_mm, y_mm, steps / 16, 0.1, source, 0, 0)
        cells.put(trigger, points)
        kept[trigger] = points
        points, triggers = numbered(kept)
        same(cells.grid, accumulate(points, TENTHS, triggers))
