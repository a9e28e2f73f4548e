"""Exponents of cost against size."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.benchmark.slopes import SLOPES, slope
from ctm_plugin.runs.compose import compose


@given(st.floats(-3, 3), st.floats(0.1, 100), st.lists(st.integers(1, 10**6), min_size=2, max_size=6, unique=True))
def test_a_power_is_found(exponent, factor, sizes):
    assert slope(sizes, [factor * size**exponent for size in sizes]) == pytest.approx(exponent, abs=1e-6)


@pytest.mark.parametrize("backbone", SLOPES)
def test_what_is_varied_exists(backbone):
    for choices in SLOPES[backbone].values():
        assert list(choices) == sorted(choices)
        for each in choices.values():
            compose(f"backbone={backbone}", *each.split())
