"""Affine and bilateral appearances: at first nothing, the identity in the mean, undone exactly; what each can learn."""

import re

import pytest
import torch
from ctm_controls.affine import Affine, inverted
from ctm_controls.bilateral import Bilateral
from hypothesis import given
from hypothesis import strategies as st

from ctm_plugin.appearance.exposure import Exposure, PixelPlaces
from ctm_plugin.appearance.photographed import exposed
from ctm_plugin.color.srgb import linear_to_srgb, srgb_to_linear
from ctm_plugin.errors import ConfigError
from ctm_plugin.scene.views import Views

KINDS = [Affine, Bilateral]
COUNT, SIDE = 5, 6


def of(images: torch.Tensor) -> Views:
    """Pictures ``[N, H, W, 3]`` without cameras that matter."""
    count = len(images)
    return Views(images, torch.eye(4)[:3].repeat(count, 1, 1), torch.ones(count, 4), tuple(map(str, range(count))))


def made(kind: type, spread: float = 0.0, **settings) -> Exposure:
    """One with parameters from a normal distribution, of five dark pictures."""
    pictures = of(torch.arange(COUNT * 48, dtype=torch.uint8).view(COUNT, 4, 4, 3) % 40)
    found = kind(kind.Config(**{"start": "same"} | settings), pictures)
    draw = torch.Generator().manual_seed(0)
    for parameter in found.parameters():
        parameter.data += spread * torch.randn(parameter.shape, generator=draw)
    return found.requires_grad_(False)


def colors(rows: int = 300) -> torch.Tensor:
    return torch.rand(rows, 3, generator=torch.Generator().manual_seed(1))


def place(rendered: torch.Tensor) -> PixelPlaces:
    """Random pixels of the five pictures, with what is rendered there."""
    draw, rows = torch.Generator().manual_seed(0), len(rendered)
    return PixelPlaces(torch.randint(0, COUNT, (rows,), generator=draw), torch.rand(rows, 2, generator=draw), rendered)


@pytest.mark.parametrize("kind", KINDS)
def test_at_first_the_identity_and_always_undone(kind):
    found, light, there = made(kind, 0.1), colors() / 10, place(colors())
    assert torch.equal(made(kind)(light, there), light)
    changed = found(light, there)
    assert (changed - light).abs().max() > 0.01
    torch.testing.assert_close(found.undone(changed, there), light, atol=1e-5, rtol=1e-4)


def test_the_pictures_mean_is_the_identity_whatever_is_learned():
    torch.testing.assert_close(made(Affine, 2.0).matrices().mean(0), torch.eye(3), atol=1e-5, rtol=0)
    assert made(Bilateral, 2.0).grids().mean(0).abs().max() < 1e-5


def test_a_grid_is_looked_up_trilinearly_in_its_own_picture():
    """Against torch's grid_sample, a picture at a time."""
    found = made(Bilateral, 0.1, across=6, levels=3)
    there = place(colors() / 8)
    matrices, offsets = found.maps(there)
    shade = (there.rendered * found.luminance).sum(-1).clamp(0, 1)
    assert 0.1 < shade.quantile(0.25) < shade.quantile(0.75) < 1
    at = 2 * torch.cat([there.at, shade[:, None]], 1) - 1
    for picture, grid in enumerate(found.grids().view(COUNT, 3, 6, 6, 12)):
        mine = there.view == picture
        volume = grid.permute(3, 0, 1, 2)[None]
        sliced = torch.nn.functional.grid_sample(volume, at[mine].view(1, 1, 1, -1, 3), align_corners=True)
        expected = sliced.view(3, 4, -1).permute(2, 0, 1)
        torch.testing.assert_close(matrices[mine] - torch.eye(3), expected[..., :3], atol=1e-5, rtol=0)
        torch.testing.assert_close(offsets[mine], found.light * expected[..., 3], atol=1e-5, rtol=0)


def test_what_regularises():
    """The distance from the identity; squared differences of neighbours along each side, none of a constant grid."""
    affine = made(Affine, 0.3, identity=2.0)
    expected = 2 * (affine.matrices() - torch.eye(3)).square().mean()
    torch.testing.assert_close(affine.regularisers()["balance"], expected)
    assert made(Affine, identity=0.0).regularisers() == made(Bilateral, smooth=0.0).regularisers() == {}
    grid = made(Bilateral, across=6, levels=3, smooth=2.0)
    grid.grid.data += torch.arange(COUNT)[:, None, None]
    assert float(grid.regularisers()["smooth"]) == 0
    levels = torch.arange(3.0)[:, None].expand(3, 36).flatten()
    grid.grid.data += 0.5 * levels[:, None]
    assert float(grid.regularisers()["smooth"]) == pytest.approx(2 * 0.25)


@given(st.integers(0, 10**6))
def test_inverses(seed):
    draw = torch.Generator().manual_seed(seed)
    matrices = torch.eye(3) + 0.2 * (torch.rand(4, 3, 3, generator=draw) - 0.5)
    torch.testing.assert_close(inverted(matrices) @ matrices, torch.eye(3).expand(4, 3, 3), atol=1e-5, rtol=0)
    assert inverted(0 * matrices).isfinite().all()  # flat ones, too


def error(kind: type, photographs: torch.Tensor, **settings) -> float:
    """How far photographs ``[N, P, 3]`` of one scene, sRGB, are from what is learned of them and of the scene."""
    count = len(photographs)
    steps = (torch.arange(SIDE) + 0.5) / SIDE
    at = torch.stack(torch.meshgrid(steps, steps, indexing="xy"), -1).flatten(0, 1).repeat(count, 1)
    view = torch.arange(count).repeat_interleave(SIDE**2)
    found = kind(kind.Config(start="same", **settings), of(photographs.view(count, SIDE, SIDE, 3)))
    raw = torch.full((SIDE**2, 3), -1.0, requires_grad=True)
    adams = [torch.optim.Adam([raw], 0.15), found.optimizer(120)[0]]
    for _ in range(120):
        rgb = raw.sigmoid().repeat(count, 1)
        apart = exposed(found, rgb, PixelPlaces(view, at, rgb.detach())) - photographs.flatten(0, 1)
        for adam in adams:
            adam.zero_grad()
        (100 * apart.square().mean() + sum(found.regularisers().values())).backward()
        for adam in adams:
            adam.step()
    return float(apart.detach().abs().mean())


def light(seed: int = 0) -> torch.Tensor:
    return 0.1 * torch.rand(SIDE**2, 3, generator=torch.Generator().manual_seed(seed))


def test_white_balance_is_found():
    mixes = 0.15 * torch.randn(4, 3, 3, generator=torch.Generator().manual_seed(1))
    gains = torch.tensor([0.5, 0.8, 1.25, 2.0])
    matrices = gains[:, None, None] * (torch.eye(3) + mixes - mixes.mean(0))
    photographs = linear_to_srgb(torch.einsum("nij,pj->npi", matrices, light()).clamp(0, 1))
    assert error(Affine, photographs, lr=0.03, lr_colors=0.02) < error(Exposure, photographs, lr=0.03) / 5


def test_a_vignette_is_found():
    """A bilateral grid has what changes across a picture; here each darkens another side, with the mean untouched."""
    x, y = torch.meshgrid(*[(torch.arange(SIDE) + 0.5) / SIDE - 0.5] * 2, indexing="xy")
    falls = torch.stack([x, -x, y, -y]).view(4, -1, 1)
    photographs = linear_to_srgb(srgb_to_linear(linear_to_srgb(light())) * (1 + 0.8 * falls))
    grid = {"across": 4, "levels": 2, "lr_grid": 0.03, "smooth": 0.01}
    assert error(Bilateral, photographs, **grid) < error(Affine, photographs) / 4


@pytest.mark.parametrize(
    ("kind", "settings", "message"),
    [
        (Affine, {"lr_colors": -1.0}, "appearance.lr_colors: found -1.0, expected a number > 0"),
        (Affine, {"identity": -1.0}, "appearance.identity: found -1.0, expected a number >= 0"),
        (Bilateral, {"across": 1}, "appearance.across: found 1, expected an integer, 2 to 256"),
        (Bilateral, {"lr_grid": 0.0}, "appearance.lr_grid: found 0.0, expected a number > 0"),
    ],
)
def test_settings_that_cannot_be(kind, settings, message):
    with pytest.raises(ConfigError, match=re.escape(message)):
        kind.Config(**settings)
