"""An exposure and a white balance a picture."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from jaxtyping import Float
from torch import Tensor, nn

from ctm_plugin.appearance.exposure import Exposure, PixelPlaces
from ctm_plugin.appearance.settings import ExposureConfig
from ctm_plugin.scene.views import Views
from ctm_plugin.settings.setting import setting

MIN_DETERMINANT = 0.05
"""Least absolute determinant of an inverted matrix: flatter ones count as this flat."""


@dataclass(frozen=True, kw_only=True)
class AffineConfig(ExposureConfig):
    """How far colours may be mixed."""

    lr_colors: float = setting(2e-3, "learning rate of the colour matrices", above=0)
    identity: float = setting(0.1, "weight of the matrices' mean squared distance from the identity", least=0)


class Affine(Exposure):
    """An exposure and a white balance of each picture's own: ``y = g_i M_i x`` in picture i, on linear light.

    ``M_i = 1 + D_i - mean_j D_j``: the matrices' mean is the identity whatever is learned. ``identity`` weighs
    ``mean |M_i - 1|^2``. There is no offset: black stays black.
    """

    Config = AffineConfig

    def __init__(self, config: AffineConfig, views: Views):
        super().__init__(config, views)
        self.mix = nn.Parameter(torch.zeros(len(views), 3, 3))

    def mixes(self) -> Float[Tensor, "n 3 3"]:
        """All pictures' ``M_i - 1``; their mean is 0."""
        return self.mix - self.mix.mean(0)

    def matrices(self) -> Float[Tensor, "n 3 3"]:
        return self.mixes() + torch.eye(3, device=self.mix.device)

    def forward(self, light: Float[Tensor, "r 3"], place: PixelPlaces) -> Float[Tensor, "r 3"]:
        return super().forward(mixed(self.matrices().index_select(0, place.view), light), place)

    def undone(self, light: Float[Tensor, "r 3"], place: PixelPlaces) -> Float[Tensor, "r 3"]:
        return mixed(inverted(self.matrices()).index_select(0, place.view), super().undone(light, place))

    def regularisers(self) -> dict[str, Tensor]:
        return {"balance": self.config.identity * self.mixes().square().mean()} if self.config.identity else {}

    def groups(self) -> list[dict]:
        return [*super().groups(), {"params": [self.mix], "lr": self.config.lr_colors, "name": "balance"}]


def mixed(matrices: Float[Tensor, "r 3 3"], light: Float[Tensor, "r 3"]) -> Float[Tensor, "r 3"]:
    """Each row by its own matrix, ``M x``."""
    return (matrices * light[:, None, :]).sum(-1)


def inverted(matrices: Float[Tensor, "n 3 3"]) -> Float[Tensor, "n 3 3"]:
    """Inverses of matrices near the identity, in closed form: ``torch.linalg.inv`` takes one after another on a CPU and
    makes a GPU wait. Determinants below 0.05 count as 0.05.
    """
    a, b, c = matrices.unbind(-2)
    columns = torch.stack([torch.linalg.cross(b, c), torch.linalg.cross(c, a), torch.linalg.cross(a, b)], dim=-1)
    return columns / (a * columns[..., 0]).sum(-1).clamp(min=MIN_DETERMINANT)[..., None, None]
