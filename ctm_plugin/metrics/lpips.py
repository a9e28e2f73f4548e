"""LPIPS v0.1 in plain torch: a perceptual distance from the features of AlexNet or VGG-16.

Source: Zhang et al. 2018, "The Unreasonable Effectiveness of Deep Features as a Perceptual Metric", and its released
code. The networks are written out here, with torchvision's key names, so that torchvision is not needed; where their
weights come from is in :mod:`ctm_plugin.metrics.lpips_weights`.
"""

from __future__ import annotations

from typing import Literal

import torch
import torch.nn.functional as F
from jaxtyping import Float
from torch import Tensor, nn

from ctm_plugin.metrics.precision import full_float32

Net = Literal["alex", "vgg"]
# ImageNet's statistics for inputs in [-1, 1], as rounded in the released code.
SHIFT, SCALE = (-0.030, -0.088, -0.188), (0.458, 0.448, 0.450)
POOL_SIZE = {"alex": 3, "vgg": 2}
"""Pixels along the window of max pooling by network."""
CONVOLUTIONS = {
    "alex": [(64, 11, 4, 2), "pool", (192, 5, 1, 2), "pool", (384, 3, 1, 1), (256, 3, 1, 1), (256, 3, 1, 1)],
    "vgg": [
        each
        for block, (channels, depth) in enumerate([(64, 2), (128, 2), (256, 3), (512, 3), (512, 3)])
        for each in (["pool"] * (block > 0) + [(channels, 3, 1, 1)] * depth)
    ],
}
"""Channels, kernel, stride and padding; between them pooling with stride 2."""
COMPARED_LAYERS = {"alex": (1, 4, 7, 9, 11), "vgg": (3, 8, 15, 22, 29)}
"""Indices of the layers whose outputs are compared."""
MIN_SIDE = {"alex": 31, "vgg": 16}
"""Least side in pixels of a picture that the network takes."""


def feature_network(net: Net) -> nn.Sequential:
    """Build the convolutions of AlexNet or VGG-16, with the indices of torchvision's ``features``."""
    layers: list[nn.Module] = []
    channels = 3
    for each in CONVOLUTIONS[net]:
        if each == "pool":
            layers.append(nn.MaxPool2d(POOL_SIZE[net], stride=2))
        else:
            layers += [nn.Conv2d(channels, *each), nn.ReLU()]
            channels = each[0]
    return nn.Sequential(*layers)


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
        self.net, self.min_size = net, MIN_SIDE[net]
        self.features = feature_network(net)
        channels = [self.features[layer - 1].out_channels for layer in COMPARED_LAYERS[net]]
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
        """Distance of each pair of images, in plain float32 whatever precision the run trains in.

        Args:
            prediction, target: ``[..., H, W, 3]`` in [0, 1], on any device, at least ``min_size`` a side.

        Returns:
            ``[...]`` on the module's device, >= 0, 0 for equal images.
        """
        *batch, height, width, _ = target.shape
        distance = torch.zeros(prediction.numel() // (height * width * 3), device=self.shift.device)
        with full_float32(self.shift.device):
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
            if index in COMPARED_LAYERS[self.net]:
                compared.append(F.normalize(x, dim=1, eps=1e-10))
        return compared
