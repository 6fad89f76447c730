"""Probabilities of labels: what raises them, what lowers them, and that they are probabilities."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from echolume_messages.types import Label
from echolume_processing.hybrid import certainty
from echolume_processing.hybrid.certainty import Verdict, probability

FAR_MM = np.inf


def of(label: Label, off_mm: float = FAR_MM, left: float = np.nan, verdict: Verdict = Verdict.AGREES) -> float:
    return float(
        probability(np.array([label], np.uint8), np.array([off_mm]), np.array([left]), np.array([verdict], np.uint8))[0]
    )


@settings(max_examples=200, deadline=None)
@given(
    st.sampled_from(list(Label)),
    st.one_of(st.just(np.inf), st.floats(-0.5, 400.0)),
    st.one_of(st.just(np.nan), st.floats(0.0, 5.0)),
    st.sampled_from(list(Verdict)),
)
def test_it_is_a_probability_and_none_for_the_unknown(
    label: Label, off_mm: float, left: float, verdict: Verdict
) -> None:
    found = of(label, off_mm, left, verdict)
    assert 0.0 <= found <= 1.0
    assert (label != Label.UNKNOWN) or found == 0.0


@pytest.mark.parametrize("label", [Label.MATTE, Label.TRANSPARENT, Label.ABSORBING, Label.OCCLUDED])
def test_next_to_a_rim_a_label_is_less_sure_than_further_off(label: Label) -> None:
    found = [of(label, off_mm, left=0.02) for off_mm in (0.5, 1.5, 2.5, 20.0)]
    assert found == sorted(found)
    assert found[0] < 0.9 < found[2]


def test_on_the_rim_itself_both_sides_are_as_probable() -> None:
    assert certainty.other_side(np.array([0.0]))[0] == pytest.approx(0.5)
    assert certainty.other_side(np.array([np.inf]))[0] == 0.0


@pytest.mark.parametrize("label", [Label.MATTE, Label.TRANSPARENT, Label.OCCLUDED])
def test_a_ping_that_agrees_makes_a_label_surer_than_none_and_than_one_that_does_not(label: Label) -> None:
    agrees = of(label, verdict=Verdict.AGREES)
    assert agrees > of(label, verdict=Verdict.NOTHING)
    assert agrees > of(label, verdict=Verdict.CONTRADICTS)


def test_no_echo_is_not_free() -> None:
    assert of(Label.MATTE, verdict=Verdict.NOTHING) == pytest.approx(1 - certainty.MATTE_DOUBT[Verdict.NOTHING])


def test_a_dark_surface_is_as_sure_as_it_explains_its_echoes() -> None:
    found = [of(Label.ABSORBING, left=left) for left in (0.02, 0.1, certainty.LEFT_HALF, 0.3, 0.6)]
    assert found == sorted(found, reverse=True)
    assert found[2] == pytest.approx(0.5)
    assert of(Label.ABSORBING) == pytest.approx(1 - certainty.CONFIRMED_ABSORBING_DOUBT)


def test_a_rule_that_compares_heights_states_one_number_a_label() -> None:
    said = certainty.by_rule(np.arange(len(Label), dtype=np.uint8))
    assert said.tolist() == [certainty.BY_RULE[kind] for kind in Label]
    assert said[Label.UNKNOWN] == 0.0
