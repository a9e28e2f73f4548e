"""Pictures of one small scene, exposed each in its own way, and a field that is a table of their pixels' latents."""

import torch
from torch import Tensor, nn

from ctm_plugin.appearance.exposure import PixelPlaces
from ctm_plugin.color.srgb import linear_to_srgb
from ctm_plugin.scene.views import Views

SIDE = 6


def views(images: Tensor, **given) -> Views:
    """Pictures ``[N, H, W, C]`` without cameras that matter."""
    count = len(images)
    names = tuple(f"p{index}" for index in range(count))
    return Views(images, torch.eye(4)[:3].repeat(count, 1, 1), torch.ones(count, 4), names, **given)


def place(count: int, rendered: Tensor | None = None, seed: int = 0) -> PixelPlaces:
    """All pixels of so many pictures, or random ones with what is ``rendered`` there, ``[R, 3]``."""
    if rendered is None:
        steps = (torch.arange(SIDE) + 0.5) / SIDE
        y, x = torch.meshgrid(steps, steps, indexing="ij")
        at = torch.stack([x, y], -1).flatten(0, 1).repeat(count, 1)
        return PixelPlaces(torch.arange(count).repeat_interleave(SIDE**2), at, torch.zeros(len(at), 3))
    draw = torch.Generator().manual_seed(seed)
    rows = len(rendered)
    return PixelPlaces(torch.randint(0, count, (rows,), generator=draw), torch.rand(rows, 2, generator=draw), rendered)


class Photographs:
    """``count`` pictures of one scene of SIDE x SIDE colours, of which picture i shows ``light @ matrices[i].T``."""

    def __init__(self, matrices: Tensor, brightest: float = 0.1, seed: int = 0):
        draw = torch.Generator().manual_seed(seed)
        self.light = brightest * torch.rand(SIDE**2, 3, generator=draw)
        self.rgb = linear_to_srgb(torch.einsum("nij,pj->npi", matrices, self.light).clamp(0, 1)).flatten(0, 1)
        self.views = views(self.rgb.view(len(matrices), SIDE, SIDE, 3).float())
        self.place = place(len(matrices))


class Table(nn.Module):
    """A field: the latent of each of the scene's points, the same in all pictures."""

    def __init__(self, channels: int = 3):
        super().__init__()
        self.raw = nn.Parameter(torch.full((SIDE**2, channels), -1.0))

    def forward(self, pictures: int) -> Tensor:
        return self.raw.sigmoid().repeat(pictures, 1)
