"""Named optimizers against the same ones stepped by hand; Adam on voxel tables against torch's and a loop."""

import io
import math

import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from torch.optim import SGD, Adam

from ctm_plugin.optim.grid_adam import GridAdam, step_table
from ctm_plugin.optim.named_optimizers import NamedOptimizers
from ctm_plugin.optim.schedules import exponential

SHAPE = (6, 3)


def rand(*shape: int, seed: int = 0) -> torch.Tensor:
    return torch.randn(*shape, generator=torch.Generator().manual_seed(seed))


def sparse(seed: int, shape: tuple[int, int] = SHAPE) -> torch.Tensor:
    """A gradient with whole rows of zeros, and zeros in other rows."""
    generator = torch.Generator().manual_seed(seed)
    grad = torch.randn(shape, generator=generator)
    return (
        grad * torch.randint(0, 2, shape, generator=generator) * torch.randint(0, 2, (shape[0], 1), generator=generator)
    )


def reloaded(state: dict) -> dict:
    """What a checkpoint gives back."""
    file = io.BytesIO()
    torch.save(state, file)
    file.seek(0)
    return torch.load(file, weights_only=True)


class Run:
    """Three members of different kinds with two schedules."""

    schedules = {"net": exponential(0.1, 10), "table": exponential(0.5, 4)}  # noqa: RUF012

    def __init__(self):
        self.parameters = {name: torch.nn.Parameter(rand(*SHAPE, seed=9)) for name in ("net", "table", "ctm")}
        self.members = {
            "net": Adam([self.parameters["net"]], 0.02, (0.8, 0.95)),
            "table": GridAdam([self.parameters["table"]], 0.1),
            "ctm": SGD([self.parameters["ctm"]], 0.3, momentum=0.9),
        }

    def gradients(self, step: int) -> None:
        for index, parameter in enumerate(self.parameters.values()):
            parameter.grad = sparse(10 * step + index)

    def named(self) -> NamedOptimizers:
        return NamedOptimizers(self.members, self.schedules)

    def train(self, optimizer: NamedOptimizers, steps: range) -> None:
        for step in steps:
            self.gradients(step)
            optimizer.set_rates(step)
            optimizer.step()

    def same_as(self, other: "Run") -> bool:
        pairs = zip(self.parameters.values(), other.parameters.values(), strict=True)
        return all(torch.equal(a, b) for a, b in pairs)


def test_exponential():
    schedule = exponential(0.1, 20)
    assert [schedule(step) for step in (0, 10, 20, 40)] == pytest.approx([1, math.sqrt(0.1), 0.1, 0.01])


def test_members_step_as_they_do_alone():
    together, alone = Run(), Run()
    together.train(together.named(), range(5))
    for step in range(5):
        alone.gradients(step)
        alone.members["net"].param_groups[0]["lr"] = 0.02 * 0.1 ** (step / 10)
        alone.members["table"].param_groups[0]["lr"] = 0.1 * 0.5 ** (step / 4)
        for member in alone.members.values():
            member.step()
    assert together.same_as(alone)
    assert not together.same_as(Run())


def test_round_trip_through_a_checkpoint():
    whole, first, second = Run(), Run(), Run()
    whole.train(whole.named(), range(6))
    before = first.named()
    first.train(before, range(3))
    after = second.named()
    after.load_state_dict(reloaded(before.state_dict()))
    for name, parameter in second.parameters.items():
        parameter.data = first.parameters[name].data.clone()
    second.train(after, range(3, 6))
    assert second.same_as(whole)
    assert [group["name"] for group in after.param_groups] == ["net", "table", "ctm"]
    assert [group["initial_lr"] for group in after.param_groups] == [0.02, 0.1, 0.3]


@pytest.mark.parametrize("names", [("net", "table"), ("net", "table", "ctm", "more"), ("net", "table", "CTM")])
def test_checkpoint_with_other_names(names):
    run = Run()
    state = run.named().state_dict()
    with pytest.raises(KeyError, match=r"in the checkpoint, .* in the model"):
        run.named().load_state_dict(dict(zip(names, [*state.values(), {}], strict=False)))


def grouped(*names: str | None) -> Adam:
    groups = [{"params": [torch.nn.Parameter(torch.zeros(1))]} | ({"name": name} if name else {}) for name in names]
    return Adam(groups)


@pytest.mark.parametrize(
    ("names", "labels"),
    [
        ([None], ["a"]),
        ([None, None], ["a", "a"]),
        (["density", "color"], ["a/density", "a/color"]),
        (["a"], ["a"]),
        (["a/x"], ["a/x"]),
        (["ab"], ["a/ab"]),
    ],
    ids=str,
)
def test_labels(names, labels):
    optimizer = NamedOptimizers({"a": grouped(*names), "b": grouped(None)})
    for _ in range(2):
        assert [group["name"] for group in optimizer.param_groups] == [*labels, "b"]
        optimizer.load_state_dict(optimizer.state_dict())


def test_replace():
    run = Run()
    both = run.named()
    run.train(both, range(2))
    kept = {name: reloaded(member.state_dict()) for name, member in run.members.items()}
    grown = torch.nn.Parameter(rand(9, 3))
    both.replace("table", GridAdam([{"params": [grown], "name": "density"}], 0.7))
    assert [group["name"] for group in both.param_groups] == ["net", "table/density", "ctm"]
    assert both.param_groups[1]["initial_lr"] == 0.7
    assert run.parameters["table"] not in both.state
    for name in ("net", "ctm"):
        state, before = both.state_dict()[name]["state"][0], kept[name]["state"][0]
        assert all(torch.equal(torch.as_tensor(state[key]), torch.as_tensor(before[key])) for key in before)
    table, net, moved = run.parameters["table"].clone(), run.parameters["net"].clone(), grown.detach().clone()
    run.gradients(2)
    grown.grad = torch.ones(9, 3)
    both.set_rates(4)
    both.step()
    assert torch.equal(run.parameters["table"], table)
    assert not torch.equal(run.parameters["net"], net)
    torch.testing.assert_close(grown.detach(), moved - 0.7 * 0.5)


# Voxel tables.


def table_optimizer(lr=0.1, betas=(0.9, 0.99), **group) -> tuple[torch.nn.Parameter, GridAdam]:
    table = torch.nn.Parameter(rand(*SHAPE))
    return table, GridAdam([{"params": [table]} | group], lr, betas)


def adam_by_hand(table, gradients, lr, betas, eps, rates=None) -> tuple[list, list, list]:
    """Adam of each row alone, which rests while its gradient is 0; the bias correction counts all steps."""
    values, first, second = table.tolist(), torch.zeros(SHAPE).tolist(), torch.zeros(SHAPE).tolist()
    for step, grad in enumerate(gradients, start=1):
        for row in range(SHAPE[0]):
            for channel in range(SHAPE[1]):
                g = grad[row, channel].item()
                if grad[row].any():
                    first[row][channel] = m = betas[0] * first[row][channel] + (1 - betas[0]) * g
                    second[row][channel] = v = betas[1] * second[row][channel] + (1 - betas[1]) * g * g
                    m, v = m / (1 - betas[0] ** step), v / (1 - betas[1] ** step)
                    rate = lr * (1.0 if rates is None else rates[row].item())
                    values[row][channel] -= rate * m / (math.sqrt(v) + eps)
    return values, first, second


@given(st.integers(0, 10**6), st.integers(1, 5), st.floats(0.1, 0.9), st.booleans())
def test_loop_over_rows(seed, steps, beta, rated):
    rates = rand(SHAPE[0], 1, seed=seed).abs() if rated else None
    table, optimizer = table_optimizer(betas=(beta, 0.97), rates=rates, eps=1e-3)
    gradients = [sparse(seed + step) for step in range(steps)]
    expected = adam_by_hand(table.detach(), gradients, 0.1, (beta, 0.97), 1e-3, rates)
    for grad in gradients:
        table.grad = grad.clone()
        optimizer.step()
    state = optimizer.state[table]
    for ours, theirs in zip((table.detach(), state["exp_avg"], state["exp_avg_sq"]), expected, strict=True):
        torch.testing.assert_close(ours, torch.tensor(theirs), atol=2e-6, rtol=1e-5)


@given(st.integers(0, 10**6), st.sampled_from([20, 3000]), st.booleans(), st.integers(1, 4), st.booleans())
def test_rows_equal_masked(seed, count, rated, channels, all_seen):
    """The loop against the update of a whole table under a mask, which GPUs run; sparse and dense to the bit."""
    shape = (count, channels)
    rates = rand(count, 1, seed=seed).abs() if rated else None
    tables = [[rand(*shape, seed=seed), torch.zeros(shape), torch.zeros(shape)] for _ in range(3)]
    largest = [table.abs() + 0.1 for table in tables[0]]  # of each number on its way, and a step
    for step in range(3):
        grad = rand(*shape, seed=seed + step) if all_seen else sparse(seed + step, shape)
        rows = grad.any(1).nonzero().squeeze(1)
        rest = rates, step + 1, 0.1, (0.9, 0.99), 1e-8
        told = torch.sparse_coo_tensor(rows[None], grad[rows], shape, check_invariants=True)
        before = tables[0][0].clone()
        step_table(tables[0][0], grad.clone(), *tables[0][1:], *rest)
        step_table.reference(tables[1][0], grad.clone(), *tables[1][1:], *rest)
        step_table(tables[2][0], told, *tables[2][1:], *rest)
        still = ~grad.any(1)
        assert torch.equal(tables[0][0][still], before[still])
        largest = [torch.maximum(most, table.abs()) for most, table in zip(largest, tables[1], strict=True)]
    for rows, masked, told, most in zip(*tables, largest, strict=True):
        assert ((rows - masked).abs() <= 6 * torch.finfo(torch.float32).eps * most).all()  # two roundings a step
        assert torch.equal(told, rows)


@pytest.mark.parametrize("wrong", ["rates", "moments"])
def test_tables_that_do_not_fit(wrong):
    table, optimizer = table_optimizer(rates=torch.ones(1, 1) if wrong == "rates" else None)
    table.grad = torch.ones(SHAPE)
    if wrong == "moments":
        optimizer.step()
        table.data, table.grad = rand(9, 3, seed=1), torch.ones(9, 3)
    with pytest.raises(ValueError, match="rates of"):
        optimizer.step()


def test_gradients_of_any_strides_and_type():
    """As of a sum, whose gradient is one number in memory; in float64 too."""
    found = []
    for grad in (torch.ones(1, 1).expand(SHAPE), torch.ones(SHAPE), torch.ones(SHAPE).double()):
        table = torch.nn.Parameter(rand(*SHAPE).to(grad.dtype))
        table.grad = grad
        GridAdam([table]).step()
        found.append(table.detach())
    assert torch.equal(*found[:2])
    torch.testing.assert_close(found[0].double(), found[2])


@given(st.integers(0, 10**6))
def test_sparse_gradients_are_dense_ones(seed):
    """Zeros inside rows, rows of zeros among those given, sums of two backward passes."""
    dense, of_dense = table_optimizer()
    other, of_other = table_optimizer()
    for step in range(3):
        dense.grad = sparse(seed + step) + sparse(seed + step + 100)
        rows = torch.arange(SHAPE[0])[None]
        parts = [torch.sparse_coo_tensor(rows, sparse(seed + step + of), SHAPE) for of in (0, 100)]
        other.grad = parts[0] + parts[1]
        of_dense.step()
        of_other.step()
    torch.testing.assert_close(other, dense)
    for name in ("exp_avg", "exp_avg_sq"):
        torch.testing.assert_close(of_other.state[other][name], of_dense.state[dense][name])


def test_rates_are_not_saved_and_stay():
    rates = torch.rand(SHAPE[0], 1)
    table, optimizer = table_optimizer(rates=rates)
    table.grad = rand(*SHAPE)
    optimizer.step()
    saved = reloaded(optimizer.state_dict())
    assert saved["param_groups"][0]["rates"] is None
    assert optimizer.param_groups[0]["rates"] is rates
    _, other = table_optimizer(rates=2 * rates)
    other.load_state_dict(saved)
    torch.testing.assert_close(other.param_groups[0]["rates"], 2 * rates)


def test_nan_is_not_hidden():
    table, optimizer = table_optimizer()
    table.grad = torch.zeros(SHAPE)
    table.grad[3, 1] = math.nan
    optimizer.step()
    assert table[3, 1].isnan()
    assert table.isnan().sum() == 1


def test_moments_of_another_shape():
    run = Run()
    named = run.named()
    run.train(named, range(1))
    state = reloaded(named.state_dict())
    (moments, *_) = state["net"]["state"].values()
    moments["exp_avg"] = torch.zeros(1, 99)
    with pytest.raises(ValueError, match=r"exp_avg of shape \[1, 99\]"):
        run.named().load_state_dict(state)
