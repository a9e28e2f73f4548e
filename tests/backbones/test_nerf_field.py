"""NeRF's network against the paper's figure 7 written down layer by layer, in float64."""

import math

import pytest
import torch
import torch.nn.functional as F
from torch import Tensor

from ctm_plugin.backbones import nerf_sparse
from ctm_plugin.backbones.nerf_field import NeRFField, all_samples

SIZES = {"width": 16, "depth": 4, "skip": 2, "position_frequencies": 3, "direction_frequencies": 2}


def make_field(channels: int = 3, dtype: torch.dtype = torch.float64, **sizes) -> NeRFField:
    torch.manual_seed(0)
    field = NeRFField(channels, **SIZES | sizes).to(dtype)
    with torch.no_grad():
        for parameter in field.parameters():  # biases that matter
            if parameter.ndim == 1:
                parameter.normal_(std=0.3)
    return field


def make_samples(rays: int = 20, samples: int = 7, dtype: torch.dtype = torch.float64) -> tuple[Tensor, Tensor, Tensor]:
    random = torch.Generator().manual_seed(1)
    points, noise = torch.randn(rays, samples, 3, generator=random), torch.randn(rays, samples, generator=random)
    directions = F.normalize(torch.randn(rays, 3, generator=random), dim=1)
    return points.to(dtype), directions.to(dtype), noise.to(dtype)


def encode(x: Tensor, count: int) -> Tensor:
    waves = [wave(2**p * x) for wave in (torch.sin, torch.cos) for p in range(count)]
    return torch.cat([x, *waves], -1)


def reference(field: NeRFField, points: Tensor, directions: Tensor, noise: Tensor | None) -> tuple[Tensor, Tensor]:
    """Concatenations, every layer on its own, every sample."""
    position = encode(points, len(field.position_frequencies))
    direction = encode(directions, len(field.direction_frequencies))[:, None].expand(*points.shape[:2], -1)
    hidden = position
    for index, layer in enumerate(field.trunk):
        hidden = F.relu(layer(torch.cat([position, hidden], -1) if index == field.skip else hidden))
    density = field.density(hidden).squeeze(-1)
    seen = F.relu(field.view(torch.cat([field.feature(hidden), direction], -1)))
    return F.relu(density if noise is None else density + noise), torch.sigmoid(field.color(seen))


def every_sample(field: NeRFField, points: Tensor, directions: Tensor, noise: Tensor | None) -> tuple[Tensor, Tensor]:
    """The path of GPUs."""
    return all_samples(points, noise, field.position_frequencies, field.layers(directions), field.skip)


def gradients(field: NeRFField, density: Tensor, latent: Tensor) -> list[Tensor]:
    """Of a function in which, as in volume rendering, the latents of empty samples do not count."""
    loss = density.sin().sum() + (density[..., None] * latent).square().sum()
    return list(torch.autograd.grad(loss, list(field.parameters())))


def with_density(part: float, field: NeRFField, points: Tensor, directions: Tensor) -> None:
    """Shift the density so that this part of the samples has some."""
    with torch.no_grad():
        field.density.bias.fill_(1e3)
        raw = field(points, directions)[0].flatten() - 1e3
        field.density.bias.copy_(-raw.quantile(1 - part) + (1e-3 if part == 1 else -1e-3 if part == 0 else 0))


@pytest.mark.parametrize("part", [0.0, 0.3, 1.0])
@pytest.mark.parametrize("noisy", [False, True], ids=["", "noise"])
@pytest.mark.parametrize("path", [NeRFField.__call__, every_sample], ids=["cpu", "gpu"])
@pytest.mark.parametrize("sizes", [{}, {"depth": 2, "skip": 1}, {"width": 7, "depth": 5, "skip": 4}], ids=str)
def test_reference(monkeypatch, part, noisy, path, sizes):
    monkeypatch.setattr(nerf_sparse, "SAMPLE_BLOCK", 30)  # the last block is not full
    field = make_field(5, **sizes)
    points, directions, noise = make_samples()
    with_density(part, field, points, directions)
    noise = noise if noisy else None
    density, latent = path(field, points, directions, noise)
    expected = reference(field, points, directions, noise)
    active = expected[0] > 0
    assert noisy or active.double().mean().item() == pytest.approx(part, abs=0.02)
    assert (latent.shape, density.shape) == ((20, 7, 5), (20, 7))
    torch.testing.assert_close(density, expected[0], rtol=0, atol=1e-12)
    torch.testing.assert_close(latent[active], expected[1][active], rtol=0, atol=1e-12)
    for found, wanted in zip(gradients(field, density, latent), gradients(field, *expected), strict=True):
        torch.testing.assert_close(found, wanted, rtol=1e-9, atol=1e-11)


def test_size_of_the_paper():
    field = NeRFField(3)
    shapes = {name: tuple(value.shape) for name, value in field.named_parameters() if name.endswith("weight")}
    trunk = [(256, 63), *[(256, 256)] * 4, (256, 256 + 63), *[(256, 256)] * 2]
    assert [shapes[f"trunk.{index}.weight"] for index in range(8)] == trunk
    assert shapes["density.weight"] == (1, 256)
    assert shapes["feature.weight"] == (256, 256)
    assert shapes["view.weight"] == (128, 256 + 27)
    assert shapes["color.weight"] == (3, 128)
    assert sum(value.numel() for value in field.parameters()) == 595_844  # NeRF's, as is often quoted


def test_initialisation():
    """Uniform within sqrt(6 / (inputs + outputs)), biases 0, the density's 0.3."""
    torch.manual_seed(3)
    field = NeRFField(3)
    for name, value in field.named_parameters():
        if value.ndim == 1:
            assert (value == (0.3 if name == "density.bias" else 0.0)).all(), name
        else:
            bound = math.sqrt(6 / sum(value.shape))
            assert value.abs().max() <= bound, name
            assert value.std().item() == pytest.approx(bound / math.sqrt(3), rel=0.2), name


def test_no_network_starts_empty():
    torch.manual_seed(0)
    points, directions = 3 * torch.rand(32, 16, 3) - 1.5, F.normalize(torch.randn(32, 3), dim=1)
    for seed in range(20):
        torch.manual_seed(seed)
        density, _ = NeRFField(3, width=128, depth=4, skip=2)(points, directions)
        assert (density > 0).float().mean() > 0.01, seed


@pytest.mark.parametrize("path", [NeRFField.__call__, every_sample], ids=["cpu", "gpu"])
def test_half_precision_products(path):
    field = make_field(dtype=torch.float32)
    points, directions, _ = make_samples(dtype=torch.float32)
    density, latent = path(field, points, directions, None)
    exact = [density, density[..., None] * latent, *gradients(field, density, latent)]
    with torch.autocast("cpu", torch.bfloat16):
        density, latent = path(field, points, directions, None)
    rounded = [density, density[..., None] * latent, *gradients(field, density, latent)]
    for found, wanted in zip(rounded, exact, strict=True):
        assert found.dtype == torch.float32
        assert 0 < (found - wanted).norm() < 0.1 * wanted.norm()


def test_nothing_is_kept_without_gradients():
    """The results to the bit: the same products, of the same blocks."""
    field = make_field()
    points, directions, _ = make_samples()
    with torch.no_grad():
        density, latent = field(points, directions)
    assert density.grad_fn is latent.grad_fn is None
    again = field(points, directions)
    assert torch.equal(again[0], density)
    assert torch.equal(again[1], latent)
