"""Adam of rows in one pass against the update of a whole table under a mask, which GPUs run."""

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.optim.grid_adam import GridAdam, step_table


def rand(*shape: int, seed: int) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


@given(st.integers(1, 300), st.sampled_from([1, 2, 3, 12]), st.booleans(), st.booleans(), st.integers(0, 10**6))
def test_a_table_under_a_mask(count, channels, rated, sparse, seed):
    table = torch.nn.Parameter(rand(count, channels, seed=seed))
    rates = rand(count, 1, seed=seed + 1).abs() if rated else None
    optimizer = GridAdam([{"params": [table], "rates": rates}], lr=0.1)
    masked = [table.detach().clone(), torch.zeros_like(table.detach()), torch.zeros_like(table.detach())]
    for step in range(1, 4):
        grad = rand(count, channels, seed=seed + 10 * step) * (rand(count, 1, seed=seed + 10 * step + 1) > 0)
        table.grad = grad.to_sparse(1).coalesce() if sparse else grad.clone()
        optimizer.step()
        step_table.reference(masked[0], grad, *masked[1:], rates, step, 0.1, (0.9, 0.99), 1e-8)
    state = optimizer.state[table]
    for found, expected in zip((table.detach(), state["exp_avg"], state["exp_avg_sq"]), masked, strict=True):
        torch.testing.assert_close(found, expected, atol=2e-6, rtol=1e-5)


def test_any_number_of_threads():
    """To the bit: a row is stepped by the same machine code, which fuses nothing, whoever does it."""
    found = []
    for threads in (1, 2):
        before = torch.get_num_threads()
        torch.set_num_threads(threads)
        try:
            table = torch.nn.Parameter(rand(5000, 12, seed=0))
            optimizer = GridAdam([table])
            for step in range(3):
                table.grad = rand(5000, 12, seed=step + 1)
                optimizer.step()
        finally:
            torch.set_num_threads(before)
        found.append(table.detach())
    assert torch.equal(*found)


@pytest.mark.parametrize("wrong", ["rates", "moments"])
def test_tables_that_do_not_fit(wrong):
    table = torch.nn.Parameter(rand(6, 3, seed=0))
    optimizer = GridAdam([{"params": [table], "rates": torch.ones(1, 1) if wrong == "rates" else None}])
    table.grad = torch.ones(6, 3)
    if wrong == "moments":
        optimizer.step()
        table.data, table.grad = rand(9, 3, seed=1), torch.ones(9, 3)
    with pytest.raises(ValueError, match="rates of"):
        optimizer.step()


@pytest.mark.parametrize("sparse", [False, True])
def test_float64(sparse):
    tables = [torch.nn.Parameter(rand(6, 3, seed=0).to(dtype)) for dtype in (torch.float32, torch.float64)]
    for table in tables:
        grad = torch.ones(6, 3, dtype=table.dtype)
        table.grad = grad.to_sparse(1) if sparse else grad
        GridAdam([table]).step()
    torch.testing.assert_close(tables[0].double(), tables[1])


def test_gradients_of_any_strides():
    """As of a sum, whose gradient is one number in memory."""
    tables = [torch.nn.Parameter(rand(6, 3, seed=0)) for _ in range(2)]
    tables[0].grad, tables[1].grad = torch.ones(1, 1).expand(6, 3), torch.ones(6, 3)
    for table in tables:
        GridAdam([table]).step()
    assert torch.equal(*tables)
