"""Counted FLOPs and bytes against sums by hand."""

import pytest
import torch

from ctm_plugin.backbones.voxels import WorldField
from ctm_plugin.benchmark.counting import counted
from ctm_plugin.color.ctm import CTM, CTMConfig, LossWeights
from ctm_plugin.color.photometric import Photometric
from ctm_plugin.cpu import door
from ctm_plugin.cpu.door import listeners
from ctm_plugin.optim.grid_adam import GridAdam
from ctm_plugin.rays.cameras import Rays
from ctm_plugin.rays.grid import Corners, lookup


def test_products_and_their_gradients():
    a, b = torch.ones(5, 7, requires_grad=True), torch.ones(7, 3, requires_grad=True)
    with counted() as counts:
        (a @ b).sum().backward()
    assert counts.flops == 3 * 2 * 5 * 7 * 3


@pytest.mark.parametrize("dropped", [{}, {"img": 0.0}, {"dec": 0.0, "rand": 0.0, "latent": 0.0}], ids=str)
def test_ctm_s_loops_count_like_its_operators(dropped):
    """Which go through both networks in batches, and so compute a few gradients of inputs that nobody asks for."""
    ctm = CTM(CTMConfig(weights=LossWeights(**dropped), random_colors=50))
    given = [torch.rand(300, 3, requires_grad=True)], torch.rand(300, 3), Photometric(), torch.rand
    flops = []
    for may_run in (door.may_run, lambda _: False):
        with pytest.MonkeyPatch.context() as patch, counted() as counts:
            patch.setattr(door, "may_run", may_run)
            sum(ctm.losses(*given).terms.values()).backward()
        flops.append(counts.flops)
    asked_for_by_nobody = 2 * 27 * 64 * 50 * (dropped.get("latent") != 0.0)
    assert flops[0] == flops[1] - asked_for_by_nobody


def test_bytes_of_ctm_s_loops():
    """What comes and goes for each ray: its latent, colour, encoded colour, gradient, and both random ones."""
    ctm, counted_bytes = CTM(), []
    for rays in (100, 200):  # of one tile
        colors = torch.rand(rays, 3)
        with counted() as counts:
            ctm.losses([colors], colors, Photometric(), lambda _, __, colors=colors: colors)
        counted_bytes.append(counts.bytes)
    assert counted_bytes[1] - counted_bytes[0] == 100 * 6 * 3 * 4


def test_bytes_of_elementwise_operators():
    a, b = torch.ones(100), torch.ones(100)
    with counted() as counts:
        torch.add(a, b)
    assert counts.bytes == 3 * 400


def test_views_and_fresh_memory_move_nothing():
    table = torch.ones(10, 10)
    with counted() as counts:
        table[:5].view(-1, 5)
        torch.empty(1000)
        table.expand(7, 10, 10)
    assert counts.bytes == 0


def test_an_expanded_tensor_is_as_large_as_what_is_behind_it():
    one = torch.ones(1, 10).expand(1000, 10)
    with counted() as counts:
        one.sum()
    assert counts.bytes == 40 + 4


def test_of_a_table_the_rows_that_are_asked_for_count():
    table = torch.zeros(100_000, 4)
    rows = torch.arange(6)
    with counted() as counts:
        table[rows]
    assert counts.bytes == 6 * 16 + 6 * 8 + 6 * 16
    with counted() as counts:
        table.index_add_(0, rows, torch.ones(1, 4).expand(6, 4).clone())
    assert counts.bytes < 1000
    with counted() as counts:
        lookup(table, Corners(rows.view(1, 6).int(), torch.ones(1, 6)))
    assert counts.bytes < 1000


def test_of_a_table_of_one_channel_the_numbers_that_are_asked_for_count():
    table, at = torch.zeros(100_000, 1), Corners(torch.arange(6).view(1, 6).int(), torch.ones(1, 6))
    with counted() as counts:
        lookup(table, at)
    assert counts.bytes == 3 * 6 * 4 + 4  # numbers, rows, weights; the result


def test_a_sparse_gradient_is_as_large_as_its_rows():
    table = torch.nn.Parameter(torch.zeros(100_000, 4))
    with counted() as counts:
        lookup(table, Corners(torch.arange(8).view(1, 8).int(), torch.ones(1, 8)), sparse=True).sum().backward()
    assert table.grad.is_sparse
    flags = 100_000  # of one byte a row, set to zero
    assert 8 * 16 < counts.bytes - flags < 10_000


def test_samples_are_counted_and_not_the_space_they_are_in():
    box = torch.tensor([[-1.0] * 3, [1.0] * 3])
    field = WorldField(
        box, (100, 100, 100), 1, near=0.5, far=6.0, threshold=1e-4, alpha_init=0.01, step=0.5, base_voxel=0.02
    )
    rays = Rays(torch.tensor([[0.0, 0.0, -3.0]]), torch.tensor([[0.0, 0.0, 1.0]]))
    with counted() as counts:
        t, _, _ = field.occupied_samples(rays, 0.5)
    assert 2 * len(t) < counts.bytes < 100 * len(t) < field.occupancy.numel()


def test_loops_are_counted():
    """Which torch's dispatcher does not see: Adam of three rows of five reads and writes them in three tables."""
    table = torch.nn.Parameter(torch.zeros(5, 4))
    optimizer = GridAdam([table])
    table.grad = torch.sparse_coo_tensor(torch.tensor([[0, 2, 4]]), torch.ones(3, 4), (5, 4), is_coalesced=True)
    optimizer.step()  # makes the moments
    with counted() as counts:
        optimizer.step()
    by_row = 3 * 8 + 7 * 3 * 16
    assert by_row < counts.bytes < by_row + 200  # and torch's own look at whether rows ascend, and six numbers
    assert not listeners
