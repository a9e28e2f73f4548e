"""D-SSIM as a loss: one minus the SSIM that pictures are scored with."""

import pytest
import torch
from torch import Tensor

from ctm_plugin.color.dssim import WINDOW, dssim
from ctm_plugin.metrics.image import ssim


def pair(channels: int = 3, height: int = 23, width: int = 17, apart: float = 0.2) -> tuple[Tensor, Tensor]:
    """A smooth picture in [0, 1] and the same with noise."""
    generator = torch.Generator().manual_seed(channels)
    small = torch.rand(1, channels, 5, 5, generator=generator)
    smooth = torch.nn.functional.interpolate(small, (height, width), mode="bicubic").clamp(0, 1)[0]
    return (smooth + apart * torch.randn(smooth.shape, generator=generator)).clamp(0, 1), smooth


@pytest.mark.parametrize("run", [dssim, dssim.reference])
@pytest.mark.parametrize(("height", "width"), [(23, 17), (WINDOW, WINDOW), (11, 40)])
def test_it_is_one_less_the_metric(run, height, width):
    image, target = pair(height=height, width=width)
    expected = 1 - ssim(image.permute(1, 2, 0), target.permute(1, 2, 0))
    assert expected > 0.05
    torch.testing.assert_close(run(image, target), expected, atol=2e-6, rtol=0)


@pytest.mark.parametrize("run", [dssim, dssim.reference])
def test_equal_pictures_are_not_dissimilar(run):
    _, target = pair()
    image = target.clone().requires_grad_()
    found = run(image, target)
    found.backward()
    assert found.item() == pytest.approx(0, abs=1e-5)
    assert image.grad.abs().max() < 1e-5


@pytest.mark.parametrize("run", [dssim, dssim.reference])
@pytest.mark.parametrize(("height", "width"), [(10, 30), (30, 10), (1, 1)])
def test_pictures_without_room_for_a_window(run, height, width):
    image = torch.rand(3, height, width, requires_grad=True)
    found = run(image, torch.rand(3, height, width))
    found.backward()
    assert found.item() == 0
    assert not image.grad.any()


def test_the_gradient_by_differences():
    image, target = (each.double() for each in pair(1, 12, 11))
    assert torch.autograd.gradcheck(lambda of: dssim.reference(of, target), image.requires_grad_())
