"""Tensors as pictures for people."""

from __future__ import annotations

from pathlib import Path

import matplotlib
import numpy as np
import torch
from jaxtyping import Float
from PIL import Image, ImageDraw
from torch import Tensor

from ctm_plugin.files import replacing
from ctm_plugin.rays.homography import patch_corners, sl3_exp, to_pixels, warp

OUTLINE_COLORS = ("#e6194b", "#42d4f4", "#f032e6", "#ffe119", "#3cb44b")
"""Colours of the patches' outlines."""


def depth_picture(depth: Float[Tensor, "h w"], near: float, far: float) -> Float[Tensor, "h w 3"]:
    """Picture of distances, from near (bright) to far (dark)."""
    scaled = ((far - depth) / (far - near)).clamp(0, 1)
    return torch.from_numpy(matplotlib.colormaps["inferno"](scaled.cpu().numpy())[..., :3]).float()


def error_picture(error: Float[Tensor, "h w"], largest: float) -> Float[Tensor, "h w 3"]:
    """Picture of errors, from 0 (dark) to ``largest`` (bright)."""
    scaled = (error / max(largest, 1e-12)).clamp(0, 1)
    return torch.from_numpy(matplotlib.colormaps["viridis"](scaled.cpu().numpy())[..., :3]).float()


def latent_picture(latent: Float[Tensor, "*n k"]) -> Float[Tensor, "*n 3"]:
    """Colours for latents: unchanged for k = 3, grey for 1, an empty blue for 2, three principal components else."""
    channels = latent.shape[-1]
    latent = latent.cpu()
    if channels == 1:
        return latent.expand(*latent.shape[:-1], 3)
    if channels == 2:
        return torch.cat([latent, torch.zeros_like(latent[..., :1])], dim=-1)
    if channels == 3:
        return latent
    flat = latent.flatten(0, -2).nan_to_num()
    centred = flat - flat.mean(0)
    _, vectors = torch.linalg.eigh(centred.T @ centred)
    components = centred @ vectors[:, -3:].flip(1)
    low, high = components.amin(0), components.amax(0)
    return ((components - low) / (high - low).clamp_min(1e-12)).reshape(*latent.shape[:-1], 3)


def beside(*pictures: Float[Tensor, "h w 3"], gap: int = 2) -> Float[Tensor, "h x 3"]:
    """Pictures of one height in a row, with a white gap."""
    white = torch.ones(pictures[0].shape[0], gap, 3)
    row = [part for picture in pictures for part in (white, picture.cpu())]
    return torch.cat(row[1:], dim=1)


def below(*pictures: Float[Tensor, "h w 3"], gap: int = 2) -> Float[Tensor, "x w 3"]:
    """Pictures of one width in a column, with a white gap."""
    return beside(*[picture.transpose(0, 1) for picture in pictures], gap=gap).transpose(0, 1)


def outlines(
    picture: Float[Tensor, "h w 3"], warps: Float[Tensor, "n 8"], true_warps: Float[Tensor, "n 8"], patch: int
) -> Float[Tensor, "h w 3"]:
    """A picture with the patches' quadrilaterals on it: true ones thin and white, estimated ones in colour."""
    height, width, _ = picture.shape
    canvas = Image.fromarray((picture.clamp(0, 1) * 255).round().byte().numpy())
    pen = ImageDraw.Draw(canvas)
    corners = patch_corners(height, width, patch)
    for of_all, colors, thick in ((true_warps, ["white"] * len(warps), 1), (warps, OUTLINE_COLORS, 3)):
        quads = to_pixels(warp(corners, sl3_exp(of_all)), height, width) - 0.5
        for quad, color in zip(quads.tolist(), colors, strict=True):
            pen.line([tuple(point) for point in [*quad, quad[0]]], fill=color, width=thick, joint="curve")
    return torch.from_numpy(np.array(canvas)).float() / 255


def write_png(path: Path, picture: Float[Tensor, "h w 3"]) -> None:
    """Save a picture in [0, 1] with 8 bits."""
    levels = (picture.clamp(0, 1) * 255).round().byte().cpu().numpy()
    path.parent.mkdir(parents=True, exist_ok=True)
    with replacing(path) as beside_path:
        Image.fromarray(levels).save(beside_path, "PNG")
