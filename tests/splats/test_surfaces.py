"""How far surfaces are from planes: closed forms of planes, folds and edges of the picture."""

import math

import pytest
import torch

from ctm_plugin.splats.render import EDGE_WIDTH, MIN_OPACITY, STRIDES, bends

HIGH, WIDE = 12, 20
FULL = torch.ones(HIGH, WIDE)
GREY = torch.full((HIGH, WIDE, 3), 0.5)
X, Y = torch.arange(WIDE).float().expand(HIGH, WIDE), torch.arange(HIGH).float()[:, None].expand(HIGH, WIDE)


@pytest.mark.parametrize("stopped", [1.0, 0.4])
def test_planes_do_not_bend(stopped):
    """Their inverse depth is linear across the picture, however much of the light they stop."""
    plane = 0.3 + 0.01 * X - 0.02 * Y
    assert bends(stopped * plane, stopped * FULL, GREY).item() == pytest.approx(0, abs=1e-5)


def test_a_fold():
    """Along a column: a stride sees it from as many pixels to its sides as it is wide."""
    fold = 0.2 + 0.01 * (X - 9).abs()
    expected = 0.0
    for stride in STRIDES:
        turned = [
            0.01 * (abs(x - stride - 9) - 2 * abs(x - 9) + abs(x + stride - 9)) for x in range(stride, WIDE - stride)
        ]
        expected += sum(turned) / len(turned) * WIDE / stride / len(STRIDES)
    assert bends(fold, FULL, GREY).item() == pytest.approx(expected, rel=1e-3)


def test_edges_of_the_picture_may_bend():
    colors = torch.where((X > 9)[..., None], 0.8, 0.2) * torch.ones(3)
    step = torch.where(X > 9, 0.5, 0.2)
    assert bends(step, FULL, colors) < 0.001 * bends(step, FULL, GREY)
    softer = torch.where((X > 9)[..., None], 0.5 + EDGE_WIDTH, 0.5) * torch.ones(3)
    found = bends(step, FULL, softer) / bends(step, FULL, GREY)
    assert found.item() == pytest.approx(math.exp(-1), rel=1e-4)


def test_gradients_are_of_the_depth_alone():
    inverse, stopped, colors = (0.2 + 0.01 * X * Y).requires_grad_(), (0.9 * FULL).requires_grad_(), GREY
    bends(inverse, stopped, colors).backward()
    assert inverse.grad.any()
    assert stopped.grad is None or not stopped.grad.any()


def test_where_next_to_nothing_is_nothing_blows_up():
    inverse = 1e-3 * torch.rand(HIGH, WIDE, generator=torch.Generator().manual_seed(0))
    found = bends(inverse, torch.zeros(HIGH, WIDE), GREY)
    assert found < 4e-3 / MIN_OPACITY * WIDE * 2


@pytest.mark.parametrize(("height", "width"), [(1, 1), (2, 9), (9, 2)])
def test_pictures_too_small_for_a_stride(height, width):
    found = bends(torch.rand(height, width), torch.ones(height, width), torch.rand(height, width, 3))
    assert found.isfinite()
