"""The bounds that numerical tests ask for, and the settings they are run under."""

from pathlib import Path

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from matrix import LEFT_OUT, NUMERICAL
from tolerance import assert_within, gamma, of_functions, of_sums


def test_one_rounding_is_half_of_eps():
    assert gamma(1, torch.float32) == pytest.approx(torch.finfo(torch.float32).eps / 2)


@given(st.integers(1, 2000), st.integers(0, 10**6))
def test_sums_in_any_order_are_within_their_bound(count, seed):
    a, b = torch.randn(2, count, generator=torch.Generator().manual_seed(seed))
    terms = a * b
    bound = of_sums(terms.abs().double().sum(), count, torch.float32).float()
    one_by_one = torch.stack([*terms.unbind()]).cumsum(0)[-1]
    assert_within(a @ b, one_by_one, bound)
    assert_within(a.flip(0) @ b.flip(0), (a.double() @ b.double()).float(), bound)


def test_a_term_that_is_missing_is_seen():
    terms = torch.rand(100) + 0.1
    with pytest.raises(AssertionError, match="times the bound"):
        assert_within(terms[1:].sum(), terms.sum(), of_sums(terms.sum(), 100))


@pytest.mark.parametrize("value", [1e-30, 0.3, 1.0, 700.0])
def test_functions_are_within_units_of_the_last_place(value):
    x = torch.full((33,), value)  # a vector's lanes, and one that is left
    for function in (torch.sin, torch.sigmoid, torch.log):
        exact = function(x.double()).float()
        assert_within(function(x), exact, of_functions(exact))


def test_no_number_is_within_no_bound():
    with pytest.raises(AssertionError):
        assert_within(torch.tensor(torch.nan), torch.tensor(1.0), 1.0)


@pytest.mark.parametrize("test", [*NUMERICAL, *LEFT_OUT])
def test_the_matrix_names_what_is_there(test):
    path, _, name = test.partition("::")
    path = Path(__file__).parents[1] / path
    assert path.exists()
    assert not name or f"def {name}(" in path.read_text()
