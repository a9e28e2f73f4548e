"""Which Gaussians get a twin, which are split, which go: each by its definition."""

import math

import pytest
import torch

from ctm_plugin.splats.gaussians import Gaussians, rotations
from ctm_plugin.splats.growth import GROW_SCALE3D, SPLIT_FACTOR, Change, along_curve, densify, shows

EXTENT = 5.0
SMALL, WIDE = math.log(0.5 * GROW_SCALE3D * EXTENT), math.log(2.0 * GROW_SCALE3D * EXTENT)


def some(count: int = 6, size: float = SMALL) -> Gaussians:
    """All of a size and well visible."""
    generator = torch.Generator().manual_seed(0)

    def normal(*shape: int) -> torch.Tensor:
        return torch.randn(*shape, generator=generator)

    scales = torch.full((count, 3), size) - torch.tensor([0.0, 0.3, 0.6])
    return Gaussians(
        normal(count, 3), scales, normal(count, 4), torch.zeros(count, 1), normal(count, 2), normal(count, 6)
    )


def grown(gaussians: Gaussians, push: list[float], threshold: float = 1.0, most: int = 100, **more) -> Change:
    drawn = {"normal": torch.randn(len(push), 6, generator=torch.Generator().manual_seed(1))} | more
    return densify(gaussians, torch.tensor(push, dtype=torch.float32), threshold, EXTENT, most, 0.005, **drawn)


def test_small_ones_get_a_twin():
    gaussians = some()
    change = grown(gaussians, [0, 2, 0, 0, 1.5, 1])
    assert change.kept.tolist() == [0, 1, 2, 3, 4, 5]
    for table, added in zip(gaussians, change.added, strict=True):
        assert torch.equal(added, table[[1, 4]])


def test_large_ones_are_split():
    """By one axis alone that is large; the halves lie where numbers from N(0, 1) put them, in its own axes."""
    gaussians = some(size=WIDE)
    normal = torch.randn(6, 6, generator=torch.Generator().manual_seed(1))
    change = grown(gaussians, [0, 2, 0, 0, 1.5, 0], normal=normal)
    assert change.kept.tolist() == [0, 2, 3, 5]
    halves = change.added
    assert len(halves.means) == 4
    for name in ("quats", "opacities", "sh0", "shN"):
        assert torch.equal(getattr(halves, name), getattr(gaussians, name)[[1, 4, 1, 4]])
    torch.testing.assert_close(halves.scales, gaussians.scales[[1, 4, 1, 4]] - math.log(SPLIT_FACTOR))
    for row, (each, part) in enumerate(((1, 0), (4, 0), (1, 1), (4, 1))):
        away = normal[each].view(2, 3)[part] * gaussians.scales[each].exp()
        expected = gaussians.means[each] + rotations(gaussians.quats)[each] @ away
        torch.testing.assert_close(halves.means[row], expected)


def test_what_goes_has_no_twin_and_no_halves():
    gaussians = some()
    gaussians.scales[3:] += WIDE - SMALL
    gaussians.opacities[[1, 4]] = -9.0
    change = grown(gaussians, [2, 2, 0, 0, 2, 0])
    assert change.kept.tolist() == [0, 2, 3, 5]
    assert torch.equal(change.added.sh0, gaussians.sh0[[0]])


@pytest.mark.parametrize("field", Gaussians._fields)
@pytest.mark.parametrize("value", [math.nan, math.inf])
def test_what_is_no_number_goes(field, value):
    gaussians = some()
    getattr(gaussians, field)[2, 0] = value
    assert shows(gaussians, 0.005).tolist() == [True, True, False, True, True, True]
    for push in (0.0, 2.0, math.nan):
        change = grown(gaussians, [0, 0, push, 0, 0, 0])
        assert change.kept.tolist() == [0, 1, 3, 4, 5]
        assert not len(change.added.means)


@pytest.mark.parametrize(
    ("most", "which"),
    [(100, [0, 1, 3, 4]), (10, [0, 1, 3, 4]), (9, [1, 3, 4]), (8, [1, 4]), (7, [4]), (6, []), (2, [])],
)
def test_a_cap_takes_those_pulled_at_hardest(most, which):
    gaussians = some()
    change = grown(gaussians, [2, 4, 0.5, 3, 5, 1], most=most)
    assert torch.equal(change.added.sh0, gaussians.sh0[which])
    assert len(change.kept) == 6


def test_a_split_one_takes_one_place_of_the_cap():
    change = grown(some(size=WIDE), [2, 4, 0, 3, 5, 0], most=8)
    assert change.kept.tolist() == [0, 2, 3, 5]
    assert len(change.kept) + len(change.added.means) == 8


def test_an_infinite_threshold_only_drops():
    gaussians = some()
    gaussians.opacities[3] = -9.0
    change = grown(gaussians, [math.inf, 1e30, 2, 3, 4, 5], threshold=math.inf)
    assert change.kept.tolist() == [0, 1, 2, 4, 5]
    assert not len(change.added.means)


def test_none_at_all():
    change = grown(some(0), [])
    assert not len(change.kept)
    assert [each.shape[1] for each in change.added] == [3, 3, 4, 1, 2, 6]


def test_some_stay_where_none_shows_enough():
    gaussians = some(3)._replace(opacities=torch.tensor([[-9.0], [-8.0], [math.nan]]))
    assert shows(gaussians, 0.005).tolist() == [True, True, False]


# Their order


def test_cubes_of_cells_lie_together():
    """A lattice in any order, stretched along an axis, one place far out: each half, quarter, eighth stays together."""
    side = torch.arange(8.0)
    lattice = torch.cartesian_prod(side, side, side)[torch.randperm(512, generator=torch.Generator().manual_seed(0))]
    places = lattice * torch.tensor([1.0, 1e3, 1e-3])
    places[lattice.sum(1) == 21] *= 100
    order = along_curve(places)
    assert order.sort().values.tolist() == list(range(512))
    for cube in (2, 4):
        spans = lattice[order].long().div(cube, rounding_mode="floor").split(cube**3)
        assert all((part == part[0]).all() for part in spans)


@pytest.mark.parametrize("count", [0, 1, 3])
def test_an_order_of_few(count):
    assert along_curve(torch.zeros(count, 3)).tolist() == list(range(count))
