"""How far surfaces are from planes, and its gradient, by loops against plain torch in float64."""

import pytest
import torch
from torch import Tensor

from ctm_plugin.splats.render import bends


def surfaces(height: int, width: int, channels: int = 3) -> tuple[Tensor, Tensor, Tensor]:
    """Of colours that differ little enough for folds to count."""
    draws = torch.Generator().manual_seed(height)
    inverse, stopped = torch.rand(2, height, width, generator=draws)
    return inverse, stopped, 0.1 * torch.rand(channels, height, width, generator=draws).permute(1, 2, 0)


@pytest.mark.parametrize(("height", "width"), [(40, 27), (3, 12), (12, 3), (9, 8), (2, 2)])
@pytest.mark.parametrize("channels", [1, 3])
def test_value_and_gradient(height, width, channels):
    found = []
    for run, dtype in ((bends, torch.float32), (bends.reference, torch.float64)):
        inverse, *others = (each.to(dtype) for each in surfaces(height, width, channels))
        measured = run(inverse.requires_grad_(), *others)
        (3 * measured + 0 * inverse.sum()).backward()
        found.append((measured.detach().double(), inverse.grad.double()))
    (measured, grad), (expected, of_torch) = found
    assert measured.item() == pytest.approx(expected.item(), rel=1e-5)
    assert (grad - of_torch).abs().max() <= 1e-5 * of_torch.abs().max()


@pytest.mark.parametrize("threads", [2, 3])
def test_any_number_of_threads(threads):
    found, before = [], torch.get_num_threads()
    for count in (1, threads):
        torch.set_num_threads(count)
        try:
            inverse, *others = surfaces(50, 33)
            measured = bends(inverse.requires_grad_(), *others)
            measured.backward()
            found.append((measured.detach(), inverse.grad))
        finally:
            torch.set_num_threads(before)
    assert all(torch.equal(one, other) for one, other in zip(*found, strict=True))
