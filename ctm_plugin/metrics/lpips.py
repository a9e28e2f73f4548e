"""LPIPS v0.1 in plain torch: a perceptual distance from the features of AlexNet or VGG-16.

Source: Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", and its released
code. The networks are written out here, with torchvision's key names, so that torchvision is not needed; where their
weights come from is in :mod:`ctm_plugin.metrics.lpips_weights`.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ctm_plugin.errors import CTMError
from ctm_plugin.metrics.precision import full_float32

Net = Literal["alex", "vgg"]

# ImageNet's statistics for inputs in [-1, 1], as rounded in the released code.
SHIFT = (-0.030, -0.088, -0.188)
SCALE = (0.458, 0.448, 0.450)


class Architecture(NamedTuple):
    """A feature extractor: its blocks of convolutions of these channels, between which maps are pooled.

    The first kernels, strides and paddings are listed; the others are 3x3, 1 and 1.
    """

    blocks: tuple[tuple[int, ...], ...]
    first: tuple[tuple[int, int, int], ...]
    pool: int
    compared: tuple[int, ...]
    """Layers, by number, whose outputs are compared."""
    min_size: int
    """Smallest side of an image, in pixels."""

    def build(self) -> nn.Sequential:
        """The convolutions of torchvision's ``features``, same indices."""
        layers: list[nn.Module] = []
        shapes, channels = iter(self.first), 3
        for number, block in enumerate(self.blocks):
            if number:
                layers.append(nn.MaxPool2d(self.pool, stride=2))
            for width in block:
                layers += [nn.Conv2d(channels, width, *next(shapes, (3, 1, 1))), nn.ReLU()]
                channels = width
        return nn.Sequential(*layers)


ARCHITECTURES: dict[str, Architecture] = {
    "alex": Architecture(((64,), (192,), (384, 256, 256)), ((11, 4, 2), (5, 1, 2)), 3, (1, 4, 7, 9, 11), 31),
    "vgg": Architecture(((64,) * 2, (128,) * 2, (256,) * 3, (512,) * 3, (512,) * 3), (), 2, (3, 8, 15, 22, 29), 16),
}


class LPIPS(nn.Module):
    """LPIPS distance between images, frozen; lower is more alike.

    ``sum_l mean_hw sum_c w_lc (u_l(p) - u_l(t))^2_hwc``, where ``u_l`` are the features after the l-th compared ReLU,
    scaled to unit length over the channels, and ``w_l >= 0`` the learned heads.

    A new instance has random weights; :func:`ctm_plugin.metrics.lpips_weights.load_lpips` gives a usable one.

    Args:
        net: ``alex`` (the magnitudes papers on radiance fields report) or ``vgg``.

    Attributes:
        features: the network, torchvision's layer indices.
        heads: the five weights ``w_l``, each ``[1, C, 1, 1]``.
        min_size: smallest height and width the network can take, in pixels.
    """

    shift: Tensor
    scale: Tensor

    def __init__(self, net: Net = "alex"):
        super().__init__()
        architecture = ARCHITECTURES[net]
        self.net = net
        self.compared = architecture.compared
        self.min_size = architecture.min_size
        self.features = architecture.build()
        channels = [self.features[layer - 1].out_channels for layer in self.compared]
        self.heads = nn.ParameterList(torch.full((1, c, 1, 1), 1.0 / c) for c in channels)
        self.register_buffer("shift", torch.tensor(SHIFT).view(1, 3, 1, 1), persistent=False)
        self.register_buffer("scale", torch.tensor(SCALE).view(1, 3, 1, 1), persistent=False)
        self.requires_grad_(False)

    def fits(self, height: int, width: int) -> bool:
        """Whether the network can take an image of this size."""
        return min(height, width) >= self.min_size

    def forward(
        self, prediction: Float[Tensor, "*batch h w 3"], target: Float[Tensor, "*batch h w 3"]
    ) -> Float[Tensor, "*batch"]:
        """Distance of each pair of images.

        Computed in plain float32 whatever precision the run trains in.

        Args:
            prediction, target: ``[..., H, W, 3]`` in [0, 1], on any device.

        Returns:
            ``[...]`` on the module's device, >= 0, 0 for equal images.

        Raises:
            CTMError: the images are smaller than ``min_size``.
        """
        *batch, height, width, _ = target.shape
        if not self.fits(height, width):
            raise CTMError(
                f"LPIPS ({self.net}): found images of {height}x{width} pixels, expected at least {self.min_size} a side"
            )
        device = self.shift.device
        distance = torch.zeros(prediction.numel() // (height * width * 3), device=device)
        with full_float32(device):
            pairs = zip(self._unit_features(prediction), self._unit_features(target), self.heads, strict=True)
            for ours, theirs, head in pairs:
                distance = distance + (head * (ours - theirs).square()).sum(dim=1).mean(dim=(1, 2))
        return distance.reshape(batch)

    def _unit_features(self, image: Tensor) -> list[Tensor]:
        """``[..., H, W, 3]`` in [0, 1] -> the compared features, each ``[N, C, h, w]`` of unit length over C."""
        x = image.to(self.shift).reshape(-1, *image.shape[-3:]).permute(0, 3, 1, 2)
        x = (2.0 * x - 1.0 - self.shift) / self.scale
        compared = []
        for index, layer in enumerate(self.features):
            x = layer(x)
            if index in self.compared:
                compared.append(F.normalize(x, dim=1, eps=1e-10))
        return compared
