"""LPIPS v0.1 in plain torch: a perceptual distance from the features of AlexNet or VGG-16.

Source: Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", and its released
code. The networks are written out here, with torchvision's key names, so that torchvision is not needed; where their
weights come from is in :mod:`ctm_plugin.metrics.lpips_weights`.
"""

from __future__ import annotations

from collections.abc import Callable
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
    """A feature extractor: how to build it, which layers are compared, their channels, and the smallest image side."""

    build: Callable[[], nn.Sequential]
    taps: tuple[int, ...]
    channels: tuple[int, ...]
    min_size: int


def alexnet() -> nn.Sequential:
    """The convolutions of torchvision's ``alexnet().features``, same indices."""
    return nn.Sequential(
        nn.Conv2d(3, 64, kernel_size=11, stride=4, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(64, 192, kernel_size=5, padding=2),
        nn.ReLU(),
        nn.MaxPool2d(kernel_size=3, stride=2),
        nn.Conv2d(192, 384, kernel_size=3, padding=1),
        nn.ReLU(),
        nn.Conv2d(384, 256, kernel_size=3, padding=1),
        nn.ReLU(),
        nn.Conv2d(256, 256, kernel_size=3, padding=1),
        nn.ReLU(),
    )


def vgg16() -> nn.Sequential:
    """The convolutions of torchvision's ``vgg16().features``, same indices."""
    layers: list[nn.Module] = []
    channels = 3
    for block, (width, depth) in enumerate(((64, 2), (128, 2), (256, 3), (512, 3), (512, 3))):
        if block:
            layers.append(nn.MaxPool2d(kernel_size=2, stride=2))
        for _ in range(depth):
            layers += [nn.Conv2d(channels, width, kernel_size=3, padding=1), nn.ReLU()]
            channels = width
    return nn.Sequential(*layers)


ARCHITECTURES: dict[str, Architecture] = {
    "alex": Architecture(alexnet, taps=(1, 4, 7, 9, 11), channels=(64, 192, 384, 256, 256), min_size=31),
    "vgg": Architecture(vgg16, taps=(3, 8, 15, 22, 29), channels=(64, 128, 256, 512, 512), min_size=16),
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
        self.taps = architecture.taps
        self.min_size = architecture.min_size
        self.features = architecture.build()
        self.heads = nn.ParameterList(torch.full((1, c, 1, 1), 1.0 / c) for c in architecture.channels)
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
            if index in self.taps:
                compared.append(F.normalize(x, dim=1, eps=1e-10))
        return compared
