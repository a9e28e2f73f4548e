"""The bounds that numerical tests ask for, and the settings they are run under."""

from pathlib import Path

import pytest
import torch
import torch.nn.functional as F
from forked import Command, execute
from hypothesis import given
from hypothesis import strategies as st
from matrix import LEFT_OUT, NUMERICAL, TRAINING
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


def sums(a: torch.Tensor, b: torch.Tensor) -> list[torch.Tensor]:
    """Sums of 1100 products at most, of ``a`` ``[40, 300]`` and ``b`` ``[300, 20]``."""
    row, rows = torch.arange(300) % 7, b.clone().requires_grad_()
    picture, line = a[None, None, :, :30].clone().requires_grad_(), b[None, None, :5, :3].clone().requires_grad_()
    blurred = F.conv2d(picture, line)
    (rows[row] * b).sum().backward()
    blurred.backward(picture.detach()[..., 4:, 2:])
    return [
        a @ b, a[None] @ b[None], F.linear(a, b.T, b[0]), a @ b[:, 0], a[0] @ b[:, 0], a.sum(1), b.mean(0),
        b.cumsum(0), torch.zeros(7, 20).index_add_(0, row, b), torch.zeros(7).scatter_add_(0, row, b[:, 0]),
        rows.grad, blurred.detach(), picture.grad, line.grad,
    ]  # fmt: skip


def test_sums_in_another_order(tmp_path):
    """Each has other bits, the same whenever it is asked for, and is off by no more than rounding."""
    given = [torch.randn(40, 300), torch.randn(300, 20)]
    torch.save(given, tmp_path / "given")
    script = "import reordered, torch; from test_matrix import sums; given = torch.load('given'); "
    child = Command(script + "torch.save([sums(*given), sums(*given)], 'found')", told=tmp_path / "told", main=execute,
                    folder=tmp_path)  # fmt: skip
    assert child.communicate()[1] == ""
    for plain, found, again, size in zip(
        sums(*given), *torch.load(tmp_path / "found"), sums(*(each.abs() for each in given)), strict=True
    ):
        assert torch.equal(found, again)
        assert not torch.equal(found, plain)
        assert_within(found, plain, of_sums(size, 1100))


@pytest.mark.parametrize("test", [*NUMERICAL, *LEFT_OUT, *TRAINING])
def test_the_matrix_names_what_is_there(test):
    path, _, name = test.partition("::")
    path = Path(__file__).parents[1] / path
    assert path.exists()
    assert not name or f"def {name}(" in path.read_text()
