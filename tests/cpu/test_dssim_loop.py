"""D-SSIM and its gradient by loops against plain torch in float64."""

import pytest
import torch

from ctm_plugin.color.dssim import dssim


def pictures(channels: int, height: int, width: int) -> tuple[torch.Tensor, torch.Tensor]:
    generator = torch.Generator().manual_seed(height)
    target = torch.rand(channels, height, width, generator=generator)
    return (target + 0.3 * torch.randn(target.shape, generator=generator)), target


@pytest.mark.parametrize(("channels", "height", "width"), [(1, 11, 11), (3, 40, 27), (5, 12, 90)])
def test_value_and_gradient(channels, height, width):
    """Colours beyond [0, 1] too, as renderings have them."""
    found = []
    for run, dtype in ((dssim, torch.float32), (dssim.reference, torch.float64)):
        image, target = (each.to(dtype) for each in pictures(channels, height, width))
        loss = run(image.requires_grad_(), target)
        (3 * loss).backward()
        found.append((loss.detach().double(), image.grad.double()))
    (loss, grad), (expected, of_torch) = found
    assert loss.item() == pytest.approx(expected.item(), abs=1e-6)
    assert (grad - of_torch).abs().max() < 1e-5 * of_torch.abs().max()


def test_flat_dark_pictures():
    """Where variances are differences of nearly equal numbers, the constants decide."""
    found = []
    for run, dtype in ((dssim, torch.float32), (dssim.reference, torch.float64)):
        target = torch.full((3, 20, 20), 0.9, dtype=dtype)
        image = (target + 1e-3 * pictures(3, 20, 20)[1].to(dtype)).requires_grad_()
        run(image, target).backward()
        found.append(image.grad.double())
    assert (found[0] - found[1]).abs().max() < 0.02 * found[1].abs().max()


def test_the_target_is_constant_and_need_not_be_contiguous():
    image, target = pictures(3, 20, 16)
    turned = target.permute(1, 2, 0).contiguous().permute(2, 0, 1).requires_grad_()
    loss = dssim(image.requires_grad_(), turned)
    loss.backward()
    assert turned.grad is None
    assert torch.equal(loss.detach(), dssim(image.detach(), target))


@pytest.mark.parametrize("threads", [2, 3])
def test_any_number_of_threads(threads):
    found, before = [], torch.get_num_threads()
    for count in (1, threads):
        torch.set_num_threads(count)
        try:
            image, target = pictures(3, 50, 33)
            loss = dssim(image.requires_grad_(), target)
            loss.backward()
            found.append((loss.detach(), image.grad))
        finally:
            torch.set_num_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
