"""The network in one pass against torch's layers in float64."""

from itertools import pairwise

import numpy as np
import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.kernels import compiled as compiled_module
from ctm_plugin.kernels.compiled import compiled
from ctm_plugin.kernels.mlp import GAP, GROUPS, SHARES, TILE, fused_mlp
from ctm_plugin.kernels.multiply import COLUMNS, product


def layers(table, offsets, ray, weights, biases):
    """What goes into the ReLUs, and into the sigmoid."""
    found = [table @ weights[0].T + offsets[ray]]
    for weight, bias in zip(weights[1:], biases, strict=True):
        found.append(F.linear(found[-1].relu(), weight, bias))
    return found


def plain(*given):
    return layers(*given)[-1].sigmoid()


def inputs(rows: int, rays: int, sizes: list[int], seed: int = 0) -> list:
    """No hidden unit is within rounding of its ReLU's kink: on which side rounding puts one, the gradients see."""
    rng = torch.Generator().manual_seed(seed)
    ray = torch.randint(rays, (rows,), generator=rng).sort().values
    weights = [torch.randn(outer, inner, generator=rng) / inner**0.5 for inner, outer in pairwise(sizes)]
    biases = [torch.randn(size, generator=rng) for size in sizes[2:]]
    biases = [bias + 0.01 * bias.sign() for bias in biases]  # what a unit is where all before are off
    table, offsets = torch.randn(rows, sizes[0], generator=rng), torch.randn(rays, sizes[1], generator=rng)
    near = torch.ones(rows, dtype=torch.bool)
    while near.any():
        table[near] = torch.randn(int(near.sum()), sizes[0], generator=rng)
        in_float64 = [[each.double() for each in part] for part in (weights, biases)]
        *hidden, _ = layers(table.double(), offsets.double(), ray, *in_float64)
        near = torch.cat([values.abs() < 1e-5 for values in (torch.ones(rows, 1), *hidden)], 1).any(1)
    return [table, offsets, ray, weights, biases]


def of_loss(out):
    """Gradient of the loss for the output."""
    return torch.arange(1.0, out.numel() + 1, dtype=out.dtype).view_as(out).cos()


def results(function, given, dtype=torch.float32) -> list[torch.Tensor]:
    """The output and all gradients."""
    table, offsets, ray, weights, biases = given
    leaves = [each.to(dtype, copy=True).requires_grad_() for each in (table, offsets, *weights, *biases)]
    out = function(*leaves[:2], ray, leaves[2 : 2 + len(weights)], leaves[2 + len(weights) :])
    (out * of_loss(out.detach())).sum().backward()
    return [out.detach(), *(each.grad for each in leaves)]


def sizes_of_terms(table, offsets, ray, weights, biases) -> list[torch.Tensor]:
    """Of each gradient the sum of its terms' sizes, which is what rounding goes by where they cancel."""
    table, offsets, *weights = (each.double() for each in (table, offsets, *weights))
    *hidden, last = layers(table, offsets, ray, weights, [bias.double() for bias in biases])
    out = last.sigmoid()
    of_above = of_loss(out).abs() * (out * (1 - out) + 0.01)  # of a sigmoid near 1 the slope is rounded by more
    of_weights, of_biases = [], []
    for weight, above in zip(weights[:0:-1], hidden[::-1], strict=True):
        of_weights.insert(0, of_above.T @ (above.relu() + 1))
        of_biases.insert(0, of_above.sum(0))
        of_above = of_above @ weight.abs() * (above > 0)
    of_weights.insert(0, of_above.T @ (table.abs() + 1))
    of_offsets = torch.zeros_like(offsets).index_add(0, ray, of_above)
    return [of_above @ weights[0].abs(), of_offsets, *of_weights, *of_biases]


def assert_close(found, exact, tolerance):
    for ours, theirs in zip(found, exact, strict=True):
        assert ours.shape == theirs.shape
        assert (ours - theirs).norm() <= tolerance * theirs.norm() + 1e-9


@given(
    st.integers(0, 3 * TILE), st.integers(1, 9), st.integers(1, 40),
    st.lists(st.integers(1, 70), min_size=1, max_size=4), st.integers(1, 70), st.integers(0, 10**6),
)  # fmt: skip
def test_torch_in_float64(rows, rays, channels, hidden, outputs, seed):
    given_ = inputs(rows, rays, [channels, *hidden, outputs], seed)
    found, exact = results(fused_mlp, given_), results(plain, given_, torch.float64)
    assert_close(found[:1], exact[:1], 2e-6)
    for ours, theirs, size in zip(found[1:], exact[1:], sizes_of_terms(*given_), strict=True):
        assert ours.shape == size.shape
        assert ((ours - theirs).abs() <= 3e-5 * size).all()


@pytest.mark.parametrize("rows", [5000, GROUPS * TILE, GROUPS * TILE + 1])
def test_gradients_of_many_rows(rows):
    """Of DVGO's sizes, on rays that several groups have rows of."""
    given_ = inputs(rows, 7, [12, 128, 128, 3])
    assert_close(results(fused_mlp, given_), results(plain, given_, torch.float64), 1e-5)


def test_rays_without_rows_have_no_gradient():
    given_ = inputs(300, 5, [4, 8, 8, 3])
    given_[2] = torch.tensor([1] * 100 + [3] * 200)
    of_offsets = results(fused_mlp, given_)[2]
    assert not of_offsets[[0, 2, 4]].any()
    assert of_offsets[[1, 3]].abs().sum(1).gt(0).all()


def test_any_number_of_threads():
    """To the bit: the same machine code goes through the same tiles, sums are of groups that threads do not change."""
    given_, found = inputs(3000, 40, [12, 64, 64, 3]), []
    before = torch.get_num_threads()
    for threads in (1, 2, 3):
        torch.set_num_threads(threads)
        try:
            found.append(results(fused_mlp, given_))
        finally:
            torch.set_num_threads(before)
    for others in found[1:]:
        assert all(torch.equal(*pair) for pair in zip(found[0], others, strict=True))


def test_without_gradients_nothing_is_kept(monkeypatch):
    """The output to the bit: of every tile by the same machine code."""
    given_ = inputs(3000, 40, [12, 64, 64, 3])
    kept = []
    monkeypatch.setattr(compiled_module, "listeners", [lambda name, arguments: kept.append(arguments[-2].numel())])
    expected = results(fused_mlp, given_)[0]
    with torch.no_grad():
        assert torch.equal(fused_mlp(*given_), expected)
        fused_mlp(*inputs(30_000, 40, [12, 64, 64, 3]))
    assert kept[0] >= 3000 * 64
    assert kept[-1] == SHARES * TILE * (64 + GAP)


def test_a_table_that_needs_no_gradient():
    """The others' to the bit: by the same machine code."""
    given_ = inputs(100, 3, [5, 8, 8, 2])
    table, offsets, ray, weights, biases = given_
    all_of_them = results(fused_mlp, given_)
    out = fused_mlp(table, offsets, ray, [weight.requires_grad_() for weight in weights], biases)
    (out * torch.arange(1.0, out.numel() + 1).view_as(out).cos()).sum().backward()
    assert all(torch.equal(weight.grad, expected) for weight, expected in zip(weights, all_of_them[3:6], strict=True))


def test_strides_do_not_matter():
    table, *rest = inputs(100, 3, [5, 8, 8, 2])
    turned = table.T.contiguous().T
    assert not turned.is_contiguous()
    assert torch.equal(fused_mlp(turned, *rest), fused_mlp(table, *rest))


def test_what_is_no_number_is_seen():
    given_ = inputs(100, 3, [5, 8, 8, 2])
    given_[0][50, 2] = torch.nan
    out, of_table, of_offsets, *of_layers = results(fused_mlp, given_)
    for rows in (out, of_table):
        assert rows[50].isnan().all()
        assert rows.isfinite().all(1).sum() == 99
    assert of_offsets.isnan().all(1).sum() == 1
    assert all(each.isnan().any() for each in of_layers)


def test_one_layer_is_none():
    table, offsets, ray, weights, _ = inputs(10, 3, [5, 2])
    with pytest.raises(ValueError, match="1 layers, expected two"):
        fused_mlp(table, offsets, ray, weights, [])


@pytest.mark.parametrize("wrong", ["weights", "biases", "offsets", "ray", "negative", "beyond", "order"])
def test_what_does_not_fit(wrong):
    table, offsets, ray, weights, biases = inputs(10, 3, [5, 8, 8, 2])
    weights[1] = weights[1][:, :7] if wrong == "weights" else weights[1]
    biases[0] = biases[0][:7] if wrong == "biases" else biases[0]
    offsets = offsets[:, :7] if wrong == "offsets" else offsets
    rays = {"negative": ray - 5, "beyond": ray + 3, "order": torch.tensor([1, 0] + [2] * 8)}
    ray = ray[:9] if wrong == "ray" else rays.get(wrong, ray)
    with pytest.raises(ValueError, match="not ascending" if wrong in rays else r"offsets \["):
        fused_mlp(table, offsets, ray, weights, biases)


SIGNATURE = "void(f4[:,::1], f4[:,::1], f4[:,::1], i8)"
SIX, SIX_ADDED = product(6), product(6, add=True)
FOUR_RELU, FOUR_ADDED_RELU = product(4, relu=True), product(4, add=True, relu=True)
SIX_GATED = product(6, gated=True)
FOUR_WIDE = product(4, 2 * COLUMNS)


@compiled(SIGNATURE, parallel=False)
def six(a, b, c, steps):
    SIX(a, 2, a.shape[1], 1, b, 3, b.shape[1], c, 1, c.shape[1], steps)


@compiled(SIGNATURE, parallel=False)
def six_added(a, b, c, steps):
    SIX_ADDED(a, 2, a.shape[1], 1, b, 3, b.shape[1], c, 1, c.shape[1], steps)


@compiled("void(f4[:,::1], f4[:,::1], f4[:,::1], i8, f4[:,::1])", parallel=False)
def six_gated(a, b, c, steps, gate):
    SIX_GATED(a, 2, a.shape[1], 1, b, 3, b.shape[1], c, 1, c.shape[1], steps, gate)


@compiled(SIGNATURE, parallel=False)
def four_relu(a, b, c, steps):
    FOUR_RELU(a, 2, a.shape[1], 1, b, 3, b.shape[1], c, 1, c.shape[1], steps)


@compiled(SIGNATURE, parallel=False)
def four_wide(a, b, c, steps):
    FOUR_WIDE(a, 2, a.shape[1], 1, b, 3, b.shape[1], c, 1, c.shape[1], steps)


@compiled(SIGNATURE, parallel=False)
def four_added_relu_turned(a, b, c, steps):
    FOUR_ADDED_RELU(a, 2, 1, a.shape[1], b, 3, b.shape[1], c, 1, c.shape[1], steps)


@pytest.mark.parametrize(
    "function",
    [six, six_added, six_gated, four_relu, four_wide, four_added_relu_turned],
    ids=lambda each: each.__name__,
)
@pytest.mark.parametrize("steps", [0, 1, 5])
def test_products(function, steps):
    """A part of a matrix alone is written, whatever lies round it."""
    name = function.__name__
    rows, columns = 6 if "six" in name else 4, COLUMNS * (2 if "wide" in name else 1)
    a, b = torch.randn(7, 9), torch.randn(7, columns + 5)
    c = torch.randn(8, columns + 2)
    left = a[:steps, 2 : 2 + rows].T if "turned" in name else a[:rows, 2 : 2 + steps]
    expected = left.double() @ b[:steps, 3 : 3 + columns].double()
    expected = expected + c[:rows, 1 : 1 + columns] if "added" in name else expected
    expected = expected.clamp_min(0) if "relu" in name else expected
    gate = torch.randn(8, columns + 2)
    gate[1, 2], gate[2, 3] = 0, torch.nan  # a gradient passes what is no number, which is then seen
    closed = gate[:rows, 1 : 1 + columns] <= 0
    expected = expected.masked_fill(closed, 0) if "gated" in name else expected
    whole = c.clone()
    whole[:rows, 1 : 1 + columns] = expected
    function(a, b, c, np.int64(steps), *([gate] if "gated" in name else []))
    torch.testing.assert_close(c, whole, atol=2e-6, rtol=1e-6)
