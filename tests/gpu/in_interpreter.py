"""Kernels beside the plain torch functions they stand for; ``test_kernels.py`` runs this in Triton's interpreter.

Their results are also those of the trial that comes before their use.
"""

import itertools
import math
import warnings

import pytest
import torch
from gaussian_scenes import SETTINGS, both_ways, certain, setting
from gaussian_scenes import close as splats_close
from pages import load
from tolerance import assert_within, gamma
from torch import Tensor
from torch.nn.functional import normalize

from ctm_plugin import door
from ctm_plugin.gpu import adam, hash_grid, kernels, lookup, samples, splats, trial, weights
from ctm_plugin.optim.grid_adam import step_table
from ctm_plugin.rays import hash_density
from ctm_plugin.rays.grid import VoxelGrid, corners, scattered, weighted
from ctm_plugin.rays.hash_grid import HashGrid, encoded, spread
from ctm_plugin.rays.occupancy import occupied_samples
from ctm_plugin.rays.volume import volume_weights
from ctm_plugin.splats.render import rasterize

CPU = torch.device("cpu")
GRID = VoxelGrid(torch.tensor([[-1.0] * 3, [1.0, 1.2, 0.9]]), (6, 7, 8))
BUFFERS = GRID.aabb[0], GRID.scale, GRID.last, GRID.offsets
COUNTS = (0, 1, 127, 130, 300)
"""No blocks at all, parts of one, one and a bit, several."""
KERNELS = {call.kernel: call for call in door.registered.values() if call.kernel}


@pytest.fixture(autouse=True)
def plain_only(monkeypatch):
    """No loops: what is compared with is plain torch."""
    monkeypatch.setattr(door, "may_run", lambda _: False)


def points_of(count: int, columns: bool) -> Tensor:
    """Points in the grid and outside it, one after another in memory or one coordinate after another."""
    points = 2.6 * torch.rand(3, count) - 1.3
    return points.T if columns else points.T.contiguous()


def close(found: Tensor, expected: Tensor, roundings: int) -> None:
    assert (found.shape, found.dtype) == (expected.shape, expected.dtype)
    largest = expected.abs().max().double() if expected.numel() else 0.0
    assert_within(found.double(), expected.double(), 2 * gamma(roundings, torch.float32) * largest)


@pytest.mark.parametrize("columns", [False, True])
@pytest.mark.parametrize("count", COUNTS)
def test_corners(count, columns):
    points = points_of(count, columns)
    (rows, shares), (plain_rows, plain_shares) = lookup.corners(points, *BUFFERS), corners.reference(points, *BUFFERS)
    assert torch.equal(rows, plain_rows)
    assert rows.dtype == plain_rows.dtype
    close(shares, plain_shares, 4)


def test_points_that_are_no_numbers_have_corners_in_the_grid():
    points = torch.tensor(list(itertools.product([math.nan, math.inf, -math.inf, 0.2], repeat=3)))
    rows, shares = lookup.corners(points, *BUFFERS)
    assert 0 <= rows.min() <= rows.max() < GRID.count
    assert torch.equal(shares.isnan().any(1), points.isnan().any(1))


@pytest.mark.parametrize("channels", [1, 3, 12])
@pytest.mark.parametrize("count", COUNTS)
@pytest.mark.parametrize("kind", [torch.int32, torch.int64])
def test_lookups_and_their_gradient(count, channels, kind):
    rows, shares = corners.reference(points_of(count, True), *BUFFERS)
    table, grad = torch.rand(GRID.count, channels) - 0.5, torch.randn(channels, count).T
    close(lookup.weighted(table, rows.to(kind), shares), weighted.reference(table, rows, shares), 8)
    found = lookup.scattered(rows.to(kind), shares, grad, table.shape, False)
    close(found, scattered.reference(rows, shares, grad, table.shape, False), 8 * max(count, 1))


@pytest.mark.parametrize(("rows", "channels"), [(1, 1), (3, 12), (1100, 1), (130, 12), (600, 2), (7, 1500)])
@pytest.mark.parametrize("rated", [False, True])
@pytest.mark.parametrize("sparse", [False, True])
def test_steps(rows, channels, rated, sparse):
    grad = torch.randn(rows, channels) * (torch.arange(rows)[:, None] % 3 > 0)
    grad[-1, :-1] = 0  # one number of a row is enough
    rates = torch.rand(rows, 1) if rated else None
    tables = torch.rand(rows, channels), torch.randn(rows, channels), torch.rand(rows, channels)
    ours, plain = [each.clone() for each in tables], [each.clone() for each in tables]
    for run, (table, *moments) in ((adam.step_table, ours), (step_table.reference, plain)):
        run(table, grad.to_sparse(1) if sparse else grad, *moments, rates, 3, 0.1, (0.9, 0.99), 1e-8)
    for found, expected, before in zip(ours, plain, tables, strict=True):
        close(found, expected, 12)
        assert torch.equal(found[grad.eq(0).all(1)], before[grad.eq(0).all(1)])


def test_tables_that_lie_otherwise_are_refused():
    table, whole = torch.rand(3, 4).T, torch.rand(4, 3)
    with pytest.raises(ValueError, match="not contiguous"):
        adam.step_table(table, whole, whole, whole, None, 1, 0.1, (0.9, 0.99), 1e-8)


def weights_and_gradient(run, depth: Tensor, ray_index: Tensor, rays: int) -> list[Tensor]:
    depth = depth.clone().requires_grad_()
    made = run(depth, ray_index, rays)
    torch.manual_seed(1)
    sum((each * torch.randn(each.shape)).sum() for each in made).backward()
    return [*(each.detach() for each in made), depth.grad]


@pytest.mark.parametrize("counts", [[], [0, 0], [1], [0, 63, 0, 64, 65, 200, 0], [3] * 40])
@pytest.mark.parametrize("solid", [False, True])
def test_weights(counts, solid):
    """Against float64 too; of one ray, of rays without samples and of several blocks of them."""
    ray_index = torch.arange(len(counts)).repeat_interleave(torch.tensor(counts, dtype=torch.long))
    depth = torch.rand(len(ray_index)) ** 4 * (torch.tensor([1.0, 1.0, 300.0])[torch.arange(len(ray_index)) % 3])
    depth = depth if solid else depth.clamp_max(0.05)
    found = weights_and_gradient(weights.VolumeWeights.apply, depth, ray_index, len(counts))
    exact = weights_and_gradient(volume_weights.reference, depth.double(), ray_index, len(counts)) if counts else found
    for ours, double in zip(found, exact, strict=True):
        assert ours.shape == double.shape
        torch.testing.assert_close(ours.double(), double.double(), atol=2e-6, rtol=2e-6)


def test_gradients_of_what_is_thin():
    """As in a field that has just begun: differences in float32 would be off by 8e-3."""
    depth, ray_index = 1e-6 * torch.rand(200), torch.zeros(200, dtype=torch.long)
    found = []
    for run, kind in ((weights.VolumeWeights.apply, torch.float32), (volume_weights.reference, torch.float64)):
        given = depth.to(kind).clone().requires_grad_()
        made, left = run(given, ray_index, 1)
        (made.sum() * (1 + 2**-16) + left.sum()).backward()
        found.append(given.grad.double())
    torch.testing.assert_close(found[0], found[1], rtol=1e-3, atol=0)


def test_depths_that_are_no_numbers_stay_so():
    made, _ = weights.VolumeWeights.apply(torch.tensor([0.1, math.nan, 0.1]), torch.zeros(3, dtype=torch.long), 1)
    assert made.isnan().tolist() == [False, True, True]


@pytest.mark.parametrize("rays", [0, 1, 23])
@pytest.mark.parametrize("contracted", [False, True])
@pytest.mark.parametrize("share", [0.0, 0.4, 1.0])
def test_samples(rays, contracted, share):
    """Some more or fewer only where rounding decides whose a point between two vertices is."""
    origins, directions = torch.rand(3, rays).T - 0.5, normalize(torch.rand(rays, 3) - 0.5, dim=1)
    counts = torch.arange(rays) * 7  # none, and more than a block
    occupancy = torch.rand(GRID.count) < share
    arguments = origins, directions, torch.rand(rays), counts, 0.021, occupancy, *BUFFERS, contracted
    found, plain = samples.occupied_samples(*arguments), occupied_samples.reference(*arguments)
    assert found[2].stride() == (1, len(found[0])) or len(found[0]) < 2
    ours, theirs = (
        {(int(ray), round(float(t), 4)) for t, ray in zip(*each[:2], strict=True)} for each in (found, plain)
    )
    assert len(ours) == len(found[0])
    every = occupied_samples.reference(*arguments[:5], torch.ones_like(occupancy), *arguments[6:])
    middle = ((((every[2] - BUFFERS[0]) * BUFFERS[1]).frac() - 0.5).abs().amin(1) < 1e-4).sum()
    assert len(ours ^ theirs) <= middle
    if ours == theirs:
        for one, other in zip(found, plain, strict=True):
            assert one.dtype == other.dtype
            torch.testing.assert_close(one, other, atol=2e-6, rtol=2e-6)


@pytest.mark.parametrize("features", [1, 2, 3])
@pytest.mark.parametrize("columns", [False, True])
@pytest.mark.parametrize("count", COUNTS)
def test_hash_grids(count, columns, features):
    grid, points = HashGrid(3, features, 256, 4, 16), points_of(count, columns) / 2.6 + 0.5
    table, at = torch.rand_like(grid.table), (points, grid.sides, grid.starts)
    with torch.no_grad():
        close(
            hash_grid.encoded(table, *at), encoded.reference(table, *at) if count else torch.empty(0, 3 * features), 128
        )
    grad = torch.randn(count, 3 * features)
    close(hash_grid.spread(grad, *at, table.shape), spread.reference(grad, *at, table.shape), 128 * max(count, 1))


@pytest.mark.parametrize("name", [name for name in SETTINGS if name not in ("needles", "discs", "specks")])
def test_splats(name, monkeypatch):
    monkeypatch.setattr(door, "may_launch", lambda given: given[1].dtype == torch.float32)
    rasterize(*trial.TRIALS["splats:rasterize"](CPU))  # the trial is past
    launched, launch = [], splats.launch
    monkeypatch.setattr(splats, "launch", lambda *given, **options: launched.append(None) or launch(*given, **options))
    of = SETTINGS[name]
    counts = certain(of.projected(), of.camera, 2e-3)
    found, expected = both_ways(of, counts)
    assert len(launched) == 2  # there and back
    splats_close(found, expected, counts, 2e-5)


def test_splats_behind_what_no_light_passes(monkeypatch):
    """A tile is left: its gradients are of what was laid, to two thousandths."""
    monkeypatch.setattr(door, "may_launch", lambda given: given[1].dtype == torch.float32)
    of = setting(300, width=20, height=20, sizes=(0.0, 0.0, 0.0), opacity=4.0)
    counts = certain(of.projected(), of.camera, 2e-3)
    gone_through = []

    def launched(kernel, *given, **options):
        kernels.launch(kernel, *given, **options)
        owner, starts, ends = given[3], given[4], given[7]
        gone_through.append(((ends - starts[:-1]).sum() / len(owner)).item())

    monkeypatch.setattr(splats, "launch", launched)
    splats_close(*both_ways(of, counts), counts, 2e-3)
    assert len(gone_through) == 2
    assert max(gone_through) < 0.5


@pytest.mark.parametrize("count", [0, 1, 200])
def test_lists_of_tiles(count):
    """Each Gaussian stands in the lists of the tiles that its box meets, front to back."""
    means, extents, depths = 60 * torch.rand(count, 2) - 10, 9 * torch.rand(count, 2) - 1, torch.rand(count)
    owner, starts = splats.tiled(means, extents, depths, 3, 2)
    corner = splats.TILE * torch.tensor([[x, y] for y in range(2) for x in range(3)])
    for tile, (low, first, last) in enumerate(zip(corner, starts[:-1], starts[1:], strict=True)):
        meets = (extents > 0).all(1) & (means + extents > low).all(1) & (means - extents < low + splats.TILE).all(1)
        expected = meets.nonzero().squeeze(1)
        assert torch.equal(owner[first:last], expected[depths[expected].argsort(stable=True)]), tile


# The trial, and the door.


@pytest.mark.parametrize("name", trial.TRIALS)
def test_a_kernel_that_does_passes(name):
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        run = door.named("gpu", name)
        assert trial.tried(name, lambda: run, KERNELS[name].reference, CPU) is run


def test_every_kernel_has_a_trial():
    assert KERNELS.keys() == trial.TRIALS.keys()
    assert hash_density  # which has none of its own


def raises(*_):
    raise RuntimeError("ptxas of another age\nno kernel image for this device")


WRONG = {
    "raises": (raises, r"does not run \(RuntimeError: no kernel image for this device\)"),
    "a little off": (lambda *given: weighted.reference(*given) * 1.0001, "off by 0.0001 of the largest"),
    "no number": (lambda *given: weighted.reference(*given) * math.nan, "off by inf"),
    "another shape": (lambda *given: weighted.reference(*given)[1:], "off by inf"),
    "changes what it is given": (lambda table, *at: weighted.reference(table.mul_(0.5), *at) * 2, "off by 0.5"),
}


@pytest.mark.parametrize("kind", WRONG)
def test_a_kernel_that_does_not_is_left_out(kind, monkeypatch):
    """With one warning a process, whatever is wrong with it, and no random numbers of the run's are used up."""
    monkeypatch.setattr(door, "registered", {})
    monkeypatch.setattr(lookup, "weighted", WRONG[kind][0])
    monkeypatch.setattr(door, "may_launch", lambda _: True)
    plain = []

    def reference(*given):
        plain.append(weighted.reference(*given))
        return plain[-1]

    call = door.looped("lookup:numbers_at", kernel="lookup:weighted")(reference)
    given, state = trial.TRIALS["lookup:weighted"](CPU), torch.get_rng_state()
    with pytest.warns(UserWarning, match=f"lookup:weighted is not used on cpu: .*{WRONG[kind][1]}.*plain torch runs"):
        assert call(*given) is plain[-1]
    assert torch.equal(torch.get_rng_state(), state)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert call(*given) is plain[-1]


def test_the_door_leads_to_kernels(monkeypatch):
    ran = []
    for module in (lookup, adam, weights, samples, hash_grid, splats):
        monkeypatch.setattr(
            module, "launch", lambda of, *given, **options: ran.append(of) or kernels.launch(of, *given, **options)
        )
    monkeypatch.setattr(door, "may_launch", lambda _: True)
    for name, call in KERNELS.items():
        given = trial.TRIALS[name](CPU)
        call(*given)
        ran.clear()  # the trial's
        call(*given)
        assert ran, f"{name} has not run"


def test_kernels_are_for_float32_on_one_gpu(monkeypatch):
    from torch._subclasses.fake_tensor import FakeTensorMode

    with FakeTensorMode():
        there, whole, double, here = (
            torch.empty(2, device=device, dtype=kind)
            for device, kind in (
                ("cuda", torch.float32),
                ("cuda", torch.int64),
                ("cuda", torch.float64),
                ("cpu", torch.float32),
            )
        )
    assert door.may_launch([there, [whole], 3, None])
    assert not door.may_launch([there, double])
    assert not door.may_launch([there, here])
    assert not door.may_launch([here])
    torch.use_deterministic_algorithms(True)
    try:
        assert not door.may_launch([there])
    finally:
        torch.use_deterministic_algorithms(False)
    monkeypatch.setattr(door, "_has_triton", lambda: False)
    assert not door.may_launch([there])


def test_the_benchmark(monkeypatch):
    subject = load("benchmarks/kernels.py")
    monkeypatch.setattr(torch.cuda, "synchronize", lambda: None)
    monkeypatch.setattr(subject, "TURNS", 1)
    monkeypatch.setattr(subject, "CALLS", 1)
    monkeypatch.setattr(door, "may_launch", lambda _: True)
    ran = set()
    for what, function, arguments, moved in subject.cases(CPU, side=8, rays=12, entries=256):
        assert min(subject.milliseconds(run, arguments) for run in (function, function.reference)) > 0
        assert moved > 0, what
        ran.add(function.kernel)
    assert ran == KERNELS.keys()
    assert [row[2] for row in subject.rows_of("sums", 0.5, 2.0, 1e6)] == ["0.5", "2", "4", "2"]
