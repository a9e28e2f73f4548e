"""Positional encoding against its formula, number by number."""

import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from tolerance import assert_within, of_functions

from ctm_plugin.rays.encoding import embed


@given(st.lists(st.floats(-4, 4), min_size=3, max_size=3), st.integers(0, 10))
def test_formula(point, count):
    frequencies = 2.0 ** torch.arange(count, dtype=torch.float64)
    found = embed(torch.tensor([point], dtype=torch.float64), frequencies)
    angles = [2**p * x for p in range(count) for x in point]
    expected = [*point, *map(math.sin, angles), *map(math.cos, angles)]
    expected = torch.tensor([expected], dtype=torch.float64)
    assert_within(found, expected, of_functions(expected))


@pytest.mark.parametrize("shape", [(0, 3), (3,), (2, 5, 3)])
def test_any_shape(shape):
    assert embed(torch.zeros(shape), torch.ones(4)).shape == (*shape[:-1], 27)


def test_positions_stay_float32_under_autocast():
    with torch.autocast("cpu", torch.bfloat16):
        assert embed(torch.rand(2, 3), 2.0 ** torch.arange(10)).dtype == torch.float32
