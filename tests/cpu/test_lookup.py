"""Lookups and their gradients against torch's own, which GPUs run."""

import pytest
import torch
import torch.nn.functional as F
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.cpu import lookup
from ctm_plugin.cpu.lookup import LOG2_OWNED_ROWS, ROW_BLOCK, add_rows, numbers_at, sums_of_rows
from ctm_plugin.rays.grid import VoxelGrid, scattered

SHAPE = (21, 22, 23)
COUNT = 21 * 22 * 23


def corners_and_gradient(points: int, channels: int, seed: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
    rng = torch.Generator().manual_seed(seed)
    grid = VoxelGrid(torch.tensor([[0.0] * 3, [1.0] * 3]), SHAPE)
    return *grid.corners(torch.rand(points, 3, generator=rng)), torch.randn(points, channels, generator=rng)


@given(st.integers(0, 3000), st.sampled_from([1, 3, 12]), st.integers(0, 10**6))
def test_a_scatter(points, channels, seed):
    """Rows alone or the whole table are to the bit the same: one loop, which fuses nothing, in the points' order."""
    assert COUNT > 2 * ROW_BLOCK
    assert COUNT >> LOG2_OWNED_ROWS
    rows, weights, grad = corners_and_gradient(points, channels, seed)
    expected = scattered(rows, weights, grad.double(), torch.Size([COUNT, channels]), False)
    whole = torch.zeros(COUNT, channels)
    add_rows(rows, weights, grad, rows.new_empty(0), whole)
    torch.testing.assert_close(whole.double(), expected, atol=1e-5, rtol=1e-5)
    touched, sums = sums_of_rows(rows, weights, grad, COUNT)
    assert torch.equal(touched, rows.unique().long())
    assert torch.equal(sums, whole[touched])


@given(st.integers(0, 500), st.integers(0, 10**6))
def test_numbers(points, seed):
    (rows, weights, _), table = corners_and_gradient(points, 1, seed), torch.randn(COUNT, 1)
    expected = F.embedding_bag(rows, table.double(), per_sample_weights=weights.double(), mode="sum")
    torch.testing.assert_close(numbers_at(table, rows, weights).double(), expected, atol=2e-6, rtol=0)


@pytest.mark.parametrize("channels", [1, 12])
@pytest.mark.parametrize("threads", [2, 3, 4])
def test_any_number_of_threads(threads, channels, monkeypatch):
    """To the bit: whoever owns a row adds up its contributions in the points' order, by the same machine code."""
    monkeypatch.setattr(lookup, "SERIAL_NUMBERS", 0)
    rows, weights, grad = corners_and_gradient(4000, channels, 0)
    found, before = [], torch.get_num_threads()
    for count in (1, threads):
        torch.set_num_threads(count)
        try:
            found.append(sums_of_rows(rows, weights, grad, COUNT))
        finally:
            torch.set_num_threads(before)
    for one, several in zip(*found, strict=True):
        assert torch.equal(one, several)


def test_gradients_of_any_strides():
    rows, weights, _ = corners_and_gradient(50, 3, 0)
    one, other = (sums_of_rows(rows, weights, of, COUNT) for of in (torch.ones(1, 1).expand(50, 3), torch.ones(50, 3)))
    assert torch.equal(one[1], other[1])
