"""Where Gaussians begin: at a reconstruction's points, at random places that cameras see, in the pictures' colours."""

import dataclasses
import math

import pytest
import torch
from gaussian_scenes import LENS, views_of
from torch import Tensor

from ctm_plugin.data.blender import BlenderConfig
from ctm_plugin.scene.frustum import projected, view_counts
from ctm_plugin.scene.views import Points, Scene
from ctm_plugin.splats.gaussians import colors_seen
from ctm_plugin.splats.start import MIN_POINTS, START_OPACITY, colors_of, first_gaussians, first_places, random_places

HIGH, WIDE = 8, 10


@pytest.fixture(scope="module")
def ball(ball) -> Scene:
    """Eight pictures with alpha of a ball of radius 0.8."""
    return BlenderConfig(root=ball).load()


@pytest.fixture(params=[None, LENS])
def row(request) -> Scene:
    """Five cameras in a row that look along -z, whose pictures are one colour each: the first's 0.1, the next 0.2."""
    c2w = torch.eye(3, 4).repeat(5, 1, 1)
    c2w[:, 0, 3] = torch.arange(5) - 2.0
    views = views_of(c2w, (9.0, 9.0, 5.0, 4.0), WIDE, HIGH, request.param)
    images = torch.arange(1, 6)[:, None, None, None] / 10 * torch.ones(5, HIGH, WIDE, 3)
    views = dataclasses.replace(views, images=images)
    return Scene("row", views, views, near=1.0, far=20.0, geometry="unbounded", background="black")


def with_points(scene: Scene, positions: Tensor, tracks: list[tuple[int, int]] = ()) -> Scene:
    pairs = torch.tensor(tracks, dtype=torch.int64).reshape(-1, 2)
    return dataclasses.replace(scene, points=Points(positions, pairs[:, 0], pairs[:, 1]))


# Places


def test_enough_points_are_all_there_is(row):
    positions = torch.randn(MIN_POINTS, 3, generator=torch.Generator().manual_seed(0)) - torch.tensor([0.0, 0.0, 5.0])
    places, colors = first_places(with_points(row, positions), 1000, 0)
    assert torch.equal(places, positions)
    assert colors.shape == (MIN_POINTS, 3)


def test_a_plane_sweep_is_asked_where_points_are_few(row, monkeypatch):
    one = torch.tensor([[0.0, 1.0, -7.0]])
    monkeypatch.setattr("ctm_plugin.splats.start.swept_places", lambda scene, seed: (one, one / 10))
    for count, asked in ((MIN_POINTS, False), (MIN_POINTS - 1, True), (0, True)):
        places, colors = first_places(with_points(row, torch.ones(count, 3)), 40, 0)
        assert len(places) == len(colors) == count + 41 * asked
        assert torch.equal(places[-1:], one) == torch.equal(colors[-1:], one / 10) == asked


def test_few_points_have_random_ones_beside_them(row):
    positions = torch.randn(MIN_POINTS - 1, 3, generator=torch.Generator().manual_seed(0)) - torch.tensor(
        [0.0, 0.0, 5.0]
    )
    places, _ = first_places(with_points(row, positions), 40, 0)
    assert torch.equal(places[: MIN_POINTS - 1], positions)
    assert torch.equal(places[MIN_POINTS - 1 :], random_places(row, 40, 0))
    assert len(places) == MIN_POINTS - 1 + 40
    assert torch.equal(first_places(row, 40, 0)[0], places[MIN_POINTS - 1 :])


@pytest.mark.parametrize("geometry", ["bounded", "unbounded"])
def test_random_places_are_seen_by_three(row, geometry):
    scene = dataclasses.replace(row, geometry=geometry)
    places = random_places(scene, 200, 0)
    assert len(places) == 200
    assert view_counts(places, scene.train, 0.0)[0].min() >= 3
    deep = -places[:, 2]
    assert deep.min() > 0.5
    assert deep.max() < 20
    # Evenly between near and far, or mostly close: half of what is even in the inverse lies before 2 / (1 + 1/20).
    assert (deep.median() > 8) == (geometry == "bounded")
    assert torch.equal(places, random_places(scene, 200, 0))
    assert not torch.equal(places, random_places(scene, 200, 1))


def test_random_places_of_an_object_lie_in_its_hull(ball):
    """Of a ball's pictures from above: where all that see it have it, and a pixel of 0.2 round it."""
    places = random_places(ball, 600, 0)
    assert len(places) == 600
    distance = places.norm(dim=1)
    assert (distance < 0.8 + 0.4).float().mean() > 0.8
    assert (distance < 0.8).float().mean() > 0.3
    assert distance.min() < 0.3
    shown = torch.zeros(600)
    for view in range(8):
        column, row, _, seen = projected(places, ball.train, view)
        at = (row.long().clamp(0, 11), column.long().clamp(0, 11))
        around = torch.nn.functional.max_pool2d((ball.train.images[view, None, ..., 3] > 0).float(), 5, 1, 2)[0]
        shown += (around[at] > 0) | ~seen
    assert (shown == 8).all()


def test_what_no_three_cameras_see_is_taken_all_the_same(row):
    """Two views are all there are; and cameras that look apart."""
    two = dataclasses.replace(row.train, **{
        name: getattr(row.train, name)[:2] for name in ("images", "c2w", "intrinsics", "names")
    }, distortion=None)  # fmt: skip
    places = random_places(dataclasses.replace(row, train=two), 50, 0)
    assert len(places) == 50
    assert view_counts(places, two, 0.0)[0].min() == 2
    apart = row.train.c2w.clone()
    apart[:, 0, 3] *= 1e4
    assert len(random_places(dataclasses.replace(row, train=dataclasses.replace(row.train, c2w=apart)), 50, 0)) == 50


# Colours


def test_colours_are_of_the_pictures_that_see_a_point(row):
    """By the tracks, where there are some; a point behind all cameras is grey."""
    positions = torch.tensor([[0.0, 0.0, -10.0]] * 3 + [[-2.0, 0.0, -2.0], [0.0, 0.0, 5.0]])
    tracks = [(0, 1), (0, 3), (1, 4), (3, 4), (3, 0)]
    scene = with_points(row, positions, tracks)
    found = colors_of(scene, positions, torch.tensor(tracks))
    # The third has no track: all five have it in their frame. The fourth's last one does not.
    expected = torch.tensor([(0.2 + 0.4) / 2, 0.5, 0.3, 0.1, 0.5])
    torch.testing.assert_close(found, expected[:, None].expand(5, 3))
    many = torch.cat([positions, torch.tensor([[0.0, 0.0, -10.0]]).repeat(MIN_POINTS, 1)])
    torch.testing.assert_close(first_places(with_points(row, many, tracks), 10, 0)[1][:5], found)


def test_a_pixel_is_looked_up_where_the_point_lies(row):
    column, line, _, _ = projected(torch.tensor([[0.5, 0.3, -4.0]]), row.train, 2)
    images = torch.zeros(5, HIGH, WIDE, 3)
    images[:, int(line), int(column)] = torch.tensor([1.0, 0.5, 0.25])
    scene = dataclasses.replace(row, train=dataclasses.replace(row.train, images=images))
    found = colors_of(scene, torch.tensor([[0.5, 0.3, -4.0]]), torch.tensor([[0, 2]]))
    torch.testing.assert_close(found, torch.tensor([[1.0, 0.5, 0.25]]))


def test_pixels_that_do_not_count_give_no_colour(row):
    place, mask = torch.tensor([[0.0, 0.0, -10.0]]), torch.ones(5, HIGH, WIDE, dtype=torch.bool)
    mask[3:] = False
    scene = dataclasses.replace(row, train=dataclasses.replace(row.train, mask=mask))
    found = colors_of(scene, place, torch.zeros(0, 2, dtype=torch.long))
    torch.testing.assert_close(found, torch.full((1, 3), 0.2))


@pytest.mark.parametrize(("background", "behind"), [("white", 1.0), ("random", 0.0)])
def test_transparent_pixels_lie_over_the_background_of_evaluation(ball, background, behind):
    place, views = torch.tensor([[0.6, -0.6, 0.8]]), ball.train
    seen = [[int(at) for at in projected(place, views, view)[:2]] for view in range(8)]
    alpha, colors = ([views.images[view, y, x, c].float() / 255 for view, (x, y) in enumerate(seen)]
                     for c in (3, slice(3)))  # fmt: skip
    assert min(alpha) == 0
    expected = torch.stack([a * c + (1 - a) * behind for a, c in zip(alpha, colors, strict=True)]).mean(0)
    found = colors_of(dataclasses.replace(ball, background=background), place, torch.zeros(0, 2).long())
    torch.testing.assert_close(found[0], expected)


# Gaussians


@pytest.mark.parametrize("degree", [0, 3])
def test_the_first_gaussians(degree):
    """Round, as large as the root mean square of the distances to three neighbours, in their colours from anywhere."""
    places = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 2, 0], [0, 0, 3], [9, 9, 9]])
    colors = torch.rand(5, 2, generator=torch.Generator().manual_seed(0))
    found = first_gaussians(places, colors, degree)
    assert torch.equal(found.means, places)
    assert found.scales[0, 0].exp().item() == pytest.approx(math.sqrt((1 + 4 + 9) / 3))
    assert found.scales[1, 2].exp().item() == pytest.approx(math.sqrt((1 + 5 + 10) / 3))
    assert (found.scales == found.scales[:, :1]).all()
    assert found.opacities.sigmoid().flatten().tolist() == pytest.approx([START_OPACITY] * 5)
    assert found.shN.shape == (5, 2 * ((degree + 1) ** 2 - 1))
    seen = colors_seen(found, torch.tensor([0.3, 0.4, 7.0]), degree + 1, 0.0)
    torch.testing.assert_close(seen, colors)


def test_places_that_are_the_same_have_a_size():
    found = first_gaussians(torch.zeros(5, 3), torch.zeros(5, 3), 0)
    assert found.scales.isfinite().all()
    assert first_gaussians(torch.zeros(1, 3), torch.zeros(1, 3), 0).scales.isfinite().all()
